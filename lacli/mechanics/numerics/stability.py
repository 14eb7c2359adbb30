"""States that are no stable equilibria, where a run tells it: frames between end-diastole and end-systole, and of the conduit.

End-diastole and end-systole are checked in every run, a frame where its derivatives are asked for. Elsewhere the check would cost
a factorisation a frame: 3 % of the CPU time of a linear atrium of 8 mm cells with four frames, 6 - 16 % of a quadratic
one (tried once, outside the benchmarks).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from lacli.contracts.case import Case
from lacli.contracts.features import TIME_DIGITS
from lacli.mechanics.results import Results, unstable_modes

UNSTABLE_FRAMES = "unstable_frames"  # of features


def told(case: Case, results: Results) -> dict[str, Any]:
    """What features say of frames known to be unstable: ``unstable_frames``, unstable modes by time; nothing where none is."""
    # end-diastole and end-systole have features of their own
    times = {phase.file: phase.time_to for phase in case.plan.stretches() if phase.file not in ("ed", "es")}
    known = unstable_modes(results)
    names = sorted(times, key=lambda name: times[name])
    found = {f"{round(times[name], TIME_DIGITS):g}": known[name] for name in names if known.get(name, 0) > 0}
    return {UNSTABLE_FRAMES: found} if found else {}


def said_of(features: Mapping[str, Any]) -> str:
    """What a user is told of a run whose end-diastole, end-systole or frames are no stable equilibria; '' where none is known."""
    said = []
    if (modes := _count(features.get("ed_unstable_modes"))) > 0:
        said.append(
            f"The image's shape is no stable equilibrium under pressure alone: {modes} ways out of it, most of them where its "
            "outer surface is concave. Errors of discretisation may be twice those stated and more; end-systole and frames "
            "seldom hang on which way is taken. Springs on dents (pericardium.dents) hold them as neighbours would."
        )
    if (modes := _count(features.get("es_unstable_modes"))) > 0:
        said.append(f"End-systole is no stable equilibrium: {modes} ways out of it.")
    stated = features.get(UNSTABLE_FRAMES)
    if isinstance(stated, Mapping) and stated:
        ways = ", ".join(f"{modes} at {time} RR" for time, modes in stated.items())
        said.append(f"Frames that are no stable equilibria, with so many ways out of them: {ways}. The wall would leave them.")
    return " ".join(said)


def _count(modes: Any) -> int:
    return int(modes) if isinstance(modes, (int, float)) and math.isfinite(modes) else 0
