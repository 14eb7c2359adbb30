"""Warm starts: a run may begin where another of the same mesh has ended, moved along that one's derivatives.

Equilibrium knows nothing of the way to it, so that a warm run's key is its scene's and its features are the cold one's to the
solver's tolerance; its manifest says from which run it started, and what of that was accepted. The deck (``solvers/freefem/
warm.idp``) refuses what Newton's method does not find in a few steps, what is not stable, and what is farther from the
prediction than the prediction from the other run; the load then goes the long way. Neither runs whose end-diastole or
end-systole had unstable modes are started from, nor is one that turns out to have them kept: there a wall has several
equilibria, and the way decides. What runs leave for others lies beside them in ``.states``, in a folder for each scene but for
the study's inputs; it may be removed at any time.
"""

from __future__ import annotations

import contextlib
import functools
import math
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from lacli.base.arrays import FloatArray
from lacli.base.files import replacing
from lacli.contracts.case import Case
from lacli.contracts.identity import content_hash, determinants, flatten
from lacli.contracts.parameters import QUANTITIES, STUDY
from lacli.contracts.scene import Scene
from lacli.mechanics import engine
from lacli.mechanics.results import EQUILIBRIA, Results
from lacli.mechanics.sensitivities import INPUTS

FOLDER = ".states"
# shares of the inputs' ranges: up to the first a state is moved along its derivatives, up to the second it is taken as it is
# (benchmarks/warm.py); farther away the long way is as short
PREDICTED, NEAR = 0.12, 0.3
_KEPT = 40  # states of a family; one of 25,000 quadratic nodes and two states takes 12 MB
_DAMAGED = (OSError, ValueError, KeyError, zipfile.BadZipFile)
_LEAST_MM = 0.1  # a solution as near as that to the prediction is on its branch, however short the prediction


@dataclass(frozen=True)
class Start:
    """Where a run starts from: the other run's key, the longest step of an input (share of its range), and by state of the deck
    the unknowns (n + 1,) to start from, mm and kPa, their last the distance (mm) within which the solution is theirs.

    Empty where no run is near.
    """

    key: str = ""
    share: float = math.nan
    states: Mapping[str, FloatArray] = field(default_factory=dict)


def family(scene: Scene) -> str:
    """What two scenes share whose runs may start from each other: all but the study's inputs. Raises AnatomyError."""
    free = {QUANTITIES[name].key for name in STUDY}
    return content_hash({key: value for key, value in flatten(determinants(scene)).items() if key not in free})


def lacking(scene: Scene) -> str:
    """Why no run of the scene starts warm, whatever has ended before, in words; '' where runs may."""
    numerics = scene.numerics
    if numerics.unloading != "prestrain":
        return 'warm starts need numerics.unloading = "prestrain"'
    if not scene.outputs.sensitivities:
        return "warm starts need the runs' derivatives; leave --no-sensitivities out"
    if numerics.rest_sweeps:
        return "warm starts need the runs' derivatives, which there are only with numerics.rest_sweeps = 0"
    if numerics.settle_ed:
        return "warm starts need runs whose end-diastole is the image's; set numerics.settle_ed to false"
    obstacle = engine.obstacle(numerics.engine)
    return f"warm starts need the compiled engine, and {obstacle}" if obstacle else ""


def inputs(scene: Scene) -> FloatArray:
    """The values of ``sensitivities.INPUTS`` in a scene, in the units of their names."""
    return np.array([functools.reduce(getattr, QUANTITIES[name].key.split("."), scene) for name in INPUTS], dtype=float)


def steps(start: FloatArray, end: FloatArray) -> tuple[FloatArray, FloatArray]:
    """From one vector of inputs to another: steps along the derivatives, those of logarithmic inputs as along their logarithm,
    and as shares of the study's ranges (infinite where an input is no one of the study's, or is switched on or off)."""
    along, shares = np.zeros(len(start)), np.zeros(len(start))
    for i, (name, a, b) in enumerate(zip(INPUTS, start.tolist(), end.tolist(), strict=True)):
        if a == b:
            continue
        quantity = QUANTITIES[name]
        if quantity.study is None or min(a, b) <= 0:
            shares[i] = math.inf
        elif quantity.log:
            along[i] = a * math.log(b / a)
            shares[i] = abs(math.log(b / a)) / math.log(quantity.study[1] / quantity.study[0])
        else:
            along[i] = b - a
            shares[i] = abs(b - a) / (quantity.study[1] - quantity.study[0])
    return along, shares


def nearest(case: Case, root: Path) -> Start:
    """The start from the nearest of the runs below ``root`` that have left their states; empty where none is near."""
    if not (case.plan.prestrain and case.plan.sensitivities):
        return Start()
    wanted = inputs(case.scene)
    best: tuple[float, float, Path] | None = None
    for file in sorted((root / FOLDER / family(case.scene)).glob("[!.]*.npz")):
        # another process may remove it meanwhile, a killed one cannot have left half of it
        with contextlib.suppress(*_DAMAGED), file.open("rb") as stream, np.load(stream) as kept:
            shares = steps(kept["inputs"], wanted)[1]
            found = (float(np.linalg.norm(shares)), float(shares.max()), file)
            best = found if best is None or found < best else best
    if best is None or best[1] > NEAR:
        return Start()
    with contextlib.suppress(*_DAMAGED), best[2].open("rb") as stream, np.load(stream) as kept:
        along = steps(kept["inputs"], wanted)[0]
        names = [name.removesuffix(_UNKNOWNS) for name in kept.files if name.endswith(_UNKNOWNS)]
        moved = {name: _moved(case, kept[name + _UNKNOWNS], kept[name + _RATES], along, best[1] <= PREDICTED) for name in names}
        return Start(best[2].stem, best[1], moved)
    return Start()


_UNKNOWNS, _RATES = "_unknowns", "_rates"


def _moved(case: Case, unknowns: FloatArray, rates: FloatArray, along: FloatArray, predict: bool) -> FloatArray:
    move = along @ rates.astype(float)
    longest = float(np.abs(move[: 3 * len(case.bundle.points)]).max())
    return np.append(unknowns + move if predict else unknowns, max(_LEAST_MM, longest if predict else 2.0 * longest))


def write(start: Start, folder: Path) -> None:
    """The deck's files."""
    for name, unknowns in start.states.items():
        unknowns.astype("<f8").tofile(folder / f"{name}.start")


def keep(case: Case, results: Results, folder: Path, root: Path) -> bool:
    """Keep the states that a deck has left in ``folder`` for other runs below ``root``; whether there were any to be kept.

    Those of a run with unstable modes, or of several equilibria, are not. Raises StorageError.
    """
    numbers = results.numbers
    stable = all(numbers.get(name, {}).get("unstable") == 0 for name in ("ed_modes", "es_modes"))
    several = numbers.get(EQUILIBRIA, {}).get("found", 1) != 1
    if not stable or several or case.scene.numerics.settle_ed or not (folder / "prestrain.state").is_file():
        return False
    units = np.array(list(INPUTS.values()))[:, None]
    content: dict[str, Any] = {"inputs": inputs(case.scene)}
    for name in ("prestrain", *(phase.file for phase in case.plan.stretches())):
        if not (folder / f"{name}.state").is_file():
            continue
        values = np.fromfile(folder / f"{name}.state", dtype="<f8").reshape(1 + len(INPUTS), -1)
        if not np.isfinite(values).all():
            return False
        # a prediction needs no more than single precision
        content |= {name + _UNKNOWNS: values[0], name + _RATES: (values[1:] * units).astype(np.float32)}
    place = root / FOLDER / family(case.scene)
    with replacing(place / f"{case.key}.npz") as file:
        np.savez(file, **content)
    for old in sorted(place.glob("[!.]*.npz"), key=_age)[:-_KEPT]:
        old.unlink(missing_ok=True)
    return True


def _age(file: Path) -> float:
    with contextlib.suppress(OSError):
        return file.stat().st_mtime
    return 0.0


def statement(start: Start, results: Results) -> dict[str, Any]:
    """What the manifest says of a start: ``way`` ``warm`` (any state accepted) or ``cold``, the other run, and by state whether
    it was accepted and the Newton steps that it took."""
    prefix = "warm_"
    tried = {key.removeprefix(prefix): value for key, value in results.numbers.items() if key.startswith(prefix)}
    states = {name: {"accepted": bool(said["accepted"]), "newton": int(said["newton"])} for name, said in tried.items()}
    way = "warm" if any(said["accepted"] for said in states.values()) else "cold"
    return {"way": way, **({"from": start.key, "share": round(start.share, 4), "states": states} if start.key else {})}
