"""Runs where a model of a comparison is likely and the calibration made none.

A calibration makes its runs where its own posterior is. Another model's may lie elsewhere (one stiffness for all regions, say,
stiffer than any region's): what the emulators say there is extrapolation, and so is its evidence. So a few runs more are made
with the calibration's own numerics at those draws of that model's posterior which tell most, until the emulator's error in its
log evidence is small beside what decides. They are kept beside the calibration's, and change nothing of it. Where that does not
come about, early frames are left out: soft walls have several states there, that runs at all but the same inputs may take, and no
smooth emulator follows them; end-systole forgets which it was.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lacli.base.arrays import FloatArray
from lacli.base.errors import LacliError
from lacli.calibration.sequential.branches import without
from lacli.calibration.sequential.change import most_telling
from lacli.calibration.sequential.fidelity.bridge import PAIR
from lacli.calibration.sequential.outputs import CHEAP, LOG, SIMULATED, SIMULATED_CHEAP, Features, Told, features_from
from lacli.calibration.simulator import SceneSimulator, times_of
from lacli.contracts.identity import Identity, beside, conflict, read_identity
from lacli.contracts.scene import load_scene
from lacli.contracts.tables.table import STATUS
from lacli.contracts.targets import Targets
from lacli.inference.box import Box
from lacli.inference.runs import RunLog, Simulator, obstacle, runs_identity

COMPARED, COMPARED_CHEAP = "compared.csv", "compared_cheap.csv"
ENOUGH = 0.5  # of a log evidence, a standard deviation: a sixth of what a strong preference is
TOO_VAGUE = 3.0  # and one beyond which early frames are left out: as much as a strong preference
MOST_RUNS = 16  # of a comparison and a calibration
BATCH = 4  # runs at a time; where they are cheap, the scene's own numerics are run at one of them, or at a pair

Hear = Callable[[int, int], None]


@dataclass(frozen=True)
class Doubt:
    """How far a model's log evidence hangs on the emulator: its standard deviation over what that may err in, of the runs'
    emulator and of the correction alone; whether (nearly) all its posterior is where no run has been; its draws (m, d)."""

    se: float
    of_runs: float
    of_correction: float
    beyond: bool
    draws: FloatArray


@dataclass(frozen=True)
class Informed:
    """The emulators by model; how many runs were made for them, and how many of the scene's own beside cheap ones; what is to be
    said."""

    emulators: Mapping[str, Features]
    runs: int = 0
    reference_runs: int = 0
    words: str = ""


@dataclass
class Kind:
    """Runs of one kind: who makes them, the log that holds the calibration's and these, and the points (n, d) that count, the
    first ``before`` of them the calibration's."""

    simulator: Simulator
    log: RunLog
    x: FloatArray
    before: int

    def told(self, further: bool) -> Told:
        """What emulators learn from, with or without further runs."""
        return Told(self.log, self.x if further else self.x[: self.before])

    def run(self, x: FloatArray, hear: Hear) -> None:
        """Have the points x (m, d) among them."""
        self.log.run(self.simulator, x, hear)
        self.x = np.array(list(dict.fromkeys(map(tuple, np.vstack([self.x, x]).tolist()))))


@dataclass
class Further:
    """The runs of a calibration, and more of them: the scene's own, and cheap ones where it had them.

    left: how many more may be made, cheap ones where there are such; made: how many were, own_made: of the scene's own beside
    cheap ones.
    """

    own: Kind
    cheap: Kind | None
    box: Box
    targets: Targets
    left: int
    made: int = 0
    own_made: int = 0

    def features(self, outputs: Sequence[str], further: bool = True) -> Features:
        """The emulator of all runs so far, or of the calibration's alone, of those outputs that are still targets."""
        cheap = None if self.cheap is None else self.cheap.told(further)
        made = features_from(self.own.told(further), cheap, self.box, self.targets)
        return made.select([name for name in outputs if name in self.targets.names])

    def leave_out_a_frame(self) -> float | None:
        """Leave out the targets of the earliest frame; its time. None where there is but one left."""
        times, names = times_of(self.targets.names), self.targets.names
        if not times or all(times_of([name]) == times for name in names):
            return None
        self.targets = without(self.targets, times[:1])
        return times[0]

    def add(self, features: Features, doubt: Doubt, rng: np.random.Generator, hear: Hear) -> None:
        """Runs at those of a model's draws that tell its emulator most."""
        z, count = features.scale.to_z(doubt.draws), min(BATCH, self.left)
        wanted = PAIR if doubt.of_correction > doubt.of_runs else 1
        pairs = 0 if self.cheap is None else min(count, wanted)
        chosen = most_telling(features.components, z, pairs, rng, "correction") if pairs else np.empty((0, z.shape[1]))
        if count > pairs:
            chosen = np.vstack([chosen, most_telling(features.components, z, count - pairs, rng)])
        x = features.scale.to_x(np.clip(chosen, 0.0, 1.0))
        self.left -= count
        if self.cheap is None:
            self.own.run(x, hear)
            self.made += len(x)
            return
        self.cheap.run(x, lambda done, total: hear(done, total + pairs))
        self.made += len(x)
        done = self.cheap.log.frame(x[:pairs])[STATUS] == "done"
        if done.any():
            self.own.run(x[:pairs][done.to_numpy()], lambda done, total: hear(len(x) + done, len(x) + total))
            self.own_made += int(done.sum())


def further(
    folder: Path, box: Box, targets: Targets, most: int, store: Path, workers: int | None = None, scheduler: str | None = None
) -> Further | str:
    """Of the folder of a calibration by the sequential method; or why no run can be added to it, in words.

    targets: as it was held against them. most: runs at most. Raises InputError, TableError.
    """
    kinds = [_kind(folder, (LOG, SIMULATED, COMPARED), box, targets, store, workers, scheduler)]
    if (folder / CHEAP).is_file():
        kinds.append(_kind(folder, (CHEAP, SIMULATED_CHEAP, COMPARED_CHEAP), box, targets, store, workers, scheduler))
    for kind in kinds:
        if isinstance(kind, str):
            return kind
    own, *cheap = (kind for kind in kinds if isinstance(kind, Kind))
    return Further(own, cheap[0] if cheap else None, box, targets, most)


def _kind(
    folder: Path, names: tuple[str, str, str], box: Box, targets: Targets, store: Path, workers: int | None, scheduler: str | None
) -> Kind | str:
    table, scene, compared = (folder / name for name in names)
    made = read_identity(beside(table))
    if not scene.is_file() or made is None:
        return f"{folder} holds no {scene.name}: calibrate again with the same options (what is done is found again)"
    try:
        simulator = SceneSimulator(load_scene(scene), store, workers, scheduler)
        identity = runs_identity(simulator, box.names, made.content["outputs"])
    except LacliError as error:
        return f"{scene}: {str(error).rstrip('.')}"
    if identity != made:
        return f"{table} {conflict(made, identity, 'runs').rstrip('.')}"
    log, x = _joined(table, compared, box, targets, identity)
    return Kind(simulator, log, x, len(x))


def _joined(table: Path, compared: Path, box: Box, targets: Targets, identity: Identity) -> tuple[RunLog, FloatArray]:
    """A log that goes on in ``compared`` and knows the calibration's rows; the points of these."""
    before = RunLog(table, box.names, targets.names, None)
    if obstacle(compared, identity):
        compared.unlink()  # of another calibration that was here: its simulations are in the store
    log = RunLog(compared, box.names, tuple(identity.content["outputs"]), identity)
    log.rows = before.rows | log.rows
    log.attempts = before.attempts | log.attempts
    return log, np.array(list(before.rows))


def informed(
    make: Callable[[], Further | str],
    emulators: Mapping[str, Features],
    doubts: Callable[[Mapping[str, Features]], Mapping[str, Doubt]],
    seed: int,
    hear: Callable[[str, int, int], None],
) -> Informed:
    """The models' emulators, with runs added until no log evidence hangs on their error by more than ``ENOUGH``.

    make: what makes runs, or why none can be made; called where there is need. emulators: by model, and doubts of them. Models
    that are not in question keep theirs: runs that were made for another, where features may bend or jump otherwise, would count
    in the error everywhere. Where one still hangs on it by more than ``TOO_VAGUE``, frames are left out for all, the earliest
    first. hear: told what is being done, and of how many runs how many are.
    """
    learnt = dict(emulators)
    found = _in_question(doubts(learnt))
    if not found:
        return Informed(learnt)
    runs = make()
    if isinstance(runs, str):
        whose = " and ".join(f"{name} (± {doubt.se:.2g})" for name, doubt in found.items())
        return Informed(learnt, words=f"the log evidence of {whose} hangs on the emulators, and no run is added: {runs}.")
    asked = set(found)  # who had further runs
    for round_ in itertools.count(1):
        if not found or runs.left <= 0:
            break
        worst = max(found, key=lambda name: found[name].se)
        runs.add(learnt[worst], found[worst], np.random.default_rng([seed, 7, round_]), functools.partial(hear, _stage(worst)))
        learnt |= dict.fromkeys(found, runs.features(learnt[worst].outputs))
        found = _in_question(doubts({name: learnt[name] for name in found}))
    if not runs.made:
        return Informed(learnt)
    fewer = _without_frames(runs, learnt, asked, {name: doubt for name, doubt in found.items() if doubt.se > TOO_VAGUE}, doubts)
    return Informed(fewer.emulators, runs.made, runs.own_made, fewer.words)


def _without_frames(
    runs: Further,
    learnt: Mapping[str, Features],
    asked: Collection[str],
    vague: Mapping[str, Doubt],
    doubts: Callable[[Mapping[str, Features]], Mapping[str, Doubt]],
) -> Informed:
    """The emulators without as many early frames as no log evidence hangs on by more than ``TOO_VAGUE``; as they are, where none
    does that.

    asked: the models that had further runs, vague: those of them that hang on the emulator so.
    """
    left_out: list[float] = []
    made, still = dict(learnt), dict(vague)
    while still:
        if (time := runs.leave_out_a_frame()) is None:
            whose = " and ".join(f"{name} to ± {doubt.se:.2g}" for name, doubt in vague.items())
            return Informed(learnt, words=f"the log evidence of {whose} alone is known: no emulator follows the runs there.")
        left_out.append(time)
        outputs = next(iter(learnt.values())).outputs
        both = {further: runs.features(outputs, further) for further in {name in asked for name in learnt}}
        made = {name: both[name in asked] for name in learnt}
        still = {name: doubt for name, doubt in doubts({n: made[n] for n in still}).items() if doubt.se > TOO_VAGUE}
    words = (
        f"targets of the frames at {', '.join(f'{time:g}' for time in left_out)} are held against no model: where"
        f" {' and '.join(vague)} is likely no emulator follows them (several states of a soft wall?)."
    )
    return Informed(made, words=words if left_out else "")


def _in_question(doubts: Mapping[str, Doubt]) -> dict[str, Doubt]:
    return {name: doubt for name, doubt in doubts.items() if doubt.se > ENOUGH or doubt.beyond}


def _stage(model: str) -> str:
    return f"runs where {model} is likely"
