"""What the error of a tracked mitral annulus does to the features that are held against targets.

Simulations hold the annulus where tracking says. What is wrong there is wrong in all frames at once: it goes too far or aside,
is tilted or too wide (``motion.annulus.off_modes``). So a run with the annulus as tracked, and one for each of these ways to be
wrong by one standard deviation, tell how all features move with it: errors of the targets that have one sign for all.

The stated error of a point is shared equally between those ways. What varies faster along the ring is felt near it alone; the
ways have its share of the error too, which makes them rather too large.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lacli.base.documents import read_json
from lacli.base.errors import InputError, LacliError
from lacli.base.files import write_json
from lacli.contracts.motion import FILE as MOTION
from lacli.contracts.sections import ANNULUS_MODES
from lacli.contracts.targets import Targets

if TYPE_CHECKING:
    from lacli.calibration.simulator import SceneSimulator
    from lacli.contracts.scene import Scene
    from lacli.inference.box import Box

FILE = "annulus.json"
_DIGITS = 6  # of what is kept: more are the solver's rounding, which would make another calibration of the same runs


def known_share(scene: Scene) -> float:
    """The share of its way that the scene's tracked annulus is known to (a standard deviation); 0 where it is not tracked, or its
    error not known. Raises InputError for a damaged motion; of one that is missing the runs say so."""
    from lacli.motion.annulus import known_error

    if scene.motion.annulus != "bundle" or not (scene.anatomy.bundle / MOTION).is_file():
        return 0.0
    known = known_error(scene.anatomy.bundle)
    return 0.0 if known is None else known[1]


def left_out(share: float) -> str:
    """What is said where the error of the annulus is not in a posterior."""
    return f"the tracked annulus is known to {100 * share:.0f} % of its way, which is not in the posterior: it may be too narrow"


def annulus_effects(
    scene: Scene,
    run: Scene,
    box: Box,
    targets: Targets,
    simulator: Callable[[Scene], SceneSimulator],
    hear: Callable[[int, int], None] = lambda done, total: None,
) -> tuple[dict[str, list[float]], str]:
    """By target what one standard deviation of each way that the annulus can be wrong changes (its unit), and what is told of it
    in words; nothing where the scene's annulus is not tracked or its error not known.

    Of runs of ``run`` (the scene, or its cheap companion) in the box's middle, at the mean of what is known of an input.
    Where the scene has no answer there, the words say so. ``hear``: runs done, and in all. Raises LacliError where the machine
    ended one, InputError.
    """
    import pandas as pd

    from lacli.motion.annulus import known_error

    if not (share := known_share(scene)) or (known := known_error(scene.anatomy.bundle)) is None:
        return {}, ""
    middle = (box.lower + box.upper) / 2
    told = {prior.name: prior.mean for prior in targets.priors or () if np.isfinite(prior.mean)}
    at = [told.get(name, value) for name, value in zip(box.names, middle, strict=True)]
    row = pd.DataFrame([np.clip(at, box.lower, box.upper)], columns=list(box.names))
    found = []
    own = np.array(run.motion.annulus_off_mm or [0.0] * ANNULUS_MODES)
    for off in (0.0 * own, *np.eye(ANNULUS_MODES) * known[0] / math.sqrt(ANNULUS_MODES)):
        moved = run.motion.model_copy(update={"annulus_off_mm": tuple(map(float, own + off)) if (own + off).any() else ()})
        ((_, outcome),) = simulator(run.model_copy(update={"motion": moved}))(row)
        if outcome.lost:  # it says nothing of the scene: an answer without it would be kept for good
            raise LacliError(
                f"calibrate: a run that tells what the annulus's error changes was ended by the machine ({outcome.kind}): "
                f"{outcome.message} Call again."
            )
        if outcome.status != "done":
            return {}, f"{left_out(share)}. A run that would tell what this changes ended by {outcome.kind} ({outcome.message})"
        found.append(outcome.outputs)
        hear(len(found), 1 + ANNULUS_MODES)
    as_tracked, *others = found
    there = [name for name in targets.names if all(name in outputs for outputs in found)]
    effects = {name: [float(f"{one[name] - as_tracked[name]:.{_DIGITS}g}") for one in others] for name in there}
    shares = {name: math.hypot(*effects[name]) / targets.sd[targets.names.index(name)] for name in there}
    most = max(shares, key=lambda name: shares[name], default="")
    if not most:
        return {}, ""
    return effects, (
        f"a point of the tracked annulus is known to {known[0]:.2g} mm, {100 * share:.0f} % of its way: that it goes too far or "
        f"aside, is tilted or too wide is in the targets' errors, most in {most} ({shares[most]:.1f} sd of its own)"
    )


def with_annulus(targets: Targets, effects: Mapping[str, Sequence[float]]) -> Targets:
    """The targets with errors that each move all by these effects (their units) at once."""
    ways = max(map(len, effects.values()), default=0)
    moves = np.array([effects.get(name, [0.0] * ways) for name in targets.names]).reshape(len(targets.names), ways)
    sd = np.linalg.norm(moves, axis=1)
    if not sd.any():
        return targets
    unit = moves / np.where(sd > 0.0, sd, 1.0)[:, None]
    return targets.widened(dict(zip(targets.names, map(float, sd), strict=True)), unit @ unit.T)


def write_effects(folder: Path, effects: Mapping[str, Sequence[float]]) -> None:
    """Beside a calibration what its targets were widened by; nothing of an earlier one stays where there is none."""
    if effects:
        write_json(folder / FILE, dict(effects))
    else:
        (folder / FILE).unlink(missing_ok=True)


def read_effects(folder: Path) -> dict[str, list[float]]:
    """What ``write_effects`` left. Raises InputError where it is damaged."""
    if not (folder / FILE).is_file():
        return {}
    told = read_json(folder / FILE, error=InputError)
    rows: list[list[float]] = [row for row in told.values() if _numbers(row)] if isinstance(told, dict) else []
    if not rows or len(rows) < len(told) or len(set(map(len, rows))) > 1:
        raise InputError(
            f"{folder / FILE}: not the effects of an annulus's error, as many finite numbers for each target. Calibrate again."
        )
    return dict(zip(map(str, told), rows, strict=True))


def _numbers(row: object) -> bool:
    numbers = row if isinstance(row, list) and row else [None]
    return all(isinstance(one, (int, float)) and not isinstance(one, bool) and math.isfinite(one) for one in numbers)
