"""Inference in one call each: emulate a table of runs, rank its inputs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from lacli.api.progress import Cancel, OnProgress, Progress, Stage, check
from lacli.base.errors import LacliError, UsageError

if TYPE_CHECKING:
    from lacli.base.arrays import FloatArray
    from lacli.contracts.identity import Identity
    from lacli.contracts.tables.table import RunTable
    from lacli.contracts.targets import Targets
    from lacli.inference.box import Box
    from lacli.inference.emulation.emulator_set import AnyEmulators
    from lacli.inference.emulation.validation import Scores
    from lacli.inference.matching.matching import Match, Region
    from lacli.inference.sensitivity import Sobol


@dataclass(frozen=True)
class Emulation:
    """Emulators of a table's outputs, in its order, the scores of their cross-validation, and what they were made from."""

    emulators: AnyEmulators
    scores: tuple[Scores, ...]
    identity: Identity


@dataclass(frozen=True)
class Sensitivity:
    """Sobol' indices of the emulators' outputs (p) to their inputs (d) over the box, with the box.

    outside: the share of the box's ranges where no run has been or can be (where an input that must be below another is not);
    warning: that in words where it is more than next to nothing, and which outputs the emulators know too little of for their
    intervals to be believed; empty where there is nothing to say.
    """

    indices: Sobol
    box: Box
    outside: float
    warning: str


@dataclass(frozen=True)
class Matching:
    """The region that history matching leaves, its measure and sample, and the runs proposed for the next wave (k, d).

    outside: the share of what was open to this wave where no run has been; warnings: what a user must know of it.
    """

    region: Region
    match: Match
    next_runs: FloatArray
    outside: float
    warnings: tuple[str, ...]


class NothingLeft(LacliError):
    """No point of the box reaches the targets; ``warnings`` say how far its nearest point is from each."""

    def __init__(self, message: str, warnings: tuple[str, ...]) -> None:
        super().__init__(message)
        self.warnings = warnings


# held-out R2 below which an emulator does not know what it does not know: of Ishigami's function by 60 runs (R2 .37 to .74),
# 23 of 30 exact total effects lay in their 95 % intervals; by 100 runs 30 of 30
_LEARNT = 0.8


def _unlearned(emulators: AnyEmulators) -> str:
    """Which outputs the emulators explain too little of, in words; '' where there is none."""
    known = zip(emulators.outputs, emulators.held_out_r2.tolist(), strict=True)
    poor = [f"{name} (held-out R2 {r2:.2f})" for name, r2 in known if r2 < _LEARNT]
    if not poor:
        return ""
    return (
        f"the emulators explain too little of {', '.join(poor[:6])}{' and others' if len(poor) > 6 else ''}: the intervals of"
        " these indices are a lower bound of what is not known. Add runs."
    )


def emulate(
    table: RunTable,
    *,
    box: Box | None = None,
    linear: Sequence[str] = (),
    folds: int = 5,
    starts: int = 3,
    seed: int = 0,
    gradients: bool = True,
    progress: OnProgress | None = None,
    cancel: Cancel | None = None,
) -> Emulation:
    """One Gaussian-process emulator per output of the table, cross-validated over ``folds`` folds.

    Emulators take inputs and give outputs in the table's units. box: where they will be used (default: where the runs
    are); an input that reaches 0 there, or is named in ``linear``, is never taken as its logarithm. starts: starting
    points of each fit. gradients: learn from the table's derivatives too, where it has any (then without ``starts``).
    Raises UsageError, Cancelled.
    """
    from lacli.base.threads import one_thread
    from lacli.inference.emulation.emulator import fit_emulators
    from lacli.inference.emulation.emulator_set import EmulatorSet, emulators_identity
    from lacli.inference.emulation.gradient_gp import fit_gradient_emulators
    from lacli.inference.emulation.validation import cross_validate, cross_validate_gradients
    from lacli.inference.given import logarithmic

    if folds < 2 or starts < 1:
        raise UsageError(f"emulate: folds {folds}, starts {starts}; at least 2 and 1.")
    options: dict[str, Any] = {"starts": starts, "seed": seed, "may_log": logarithmic(table, box, linear)}
    if gradients and table.gradients is not None:
        learnt: dict[str, Any] = {"may_log": options["may_log"], "seed": seed}
        with one_thread():
            stage = Stage("cross-validation", folds, progress, cancel).begin()
            scores = cross_validate_gradients(table, count=folds, tick=stage.step, **learnt)
            stage = Stage("emulators", 1, progress, cancel).begin()
            with_gradients = fit_gradient_emulators(table, **learnt)
            stage.step()
        return Emulation(with_gradients, tuple(scores), emulators_identity(table, gradients=True, **learnt))
    with one_thread():
        stage = Stage("cross-validation", len(table.outputs) * folds, progress, cancel).begin()
        scores = cross_validate(table, count=folds, tick=stage.step, **options)
        stage = Stage("emulators", len(table.outputs), progress, cancel).begin()
        emulators = EmulatorSet(table.inputs, tuple(fit_emulators(table, tick=stage.step, **options)))
    return Emulation(emulators, tuple(scores), emulators_identity(table, **options))


def fit(
    table: RunTable, *, box: Box | None = None, seed: int = 0, progress: OnProgress | None = None, cancel: Cancel | None = None
) -> AnyEmulators:
    """Emulators of the table's outputs without cross-validation; arguments and errors as ``emulate``."""
    from lacli.inference.emulation.emulator import fit_emulators
    from lacli.inference.emulation.emulator_set import EmulatorSet
    from lacli.inference.emulation.gradient_gp import fit_gradient_emulators
    from lacli.inference.given import logarithmic

    may_log = logarithmic(table, box)
    stage = Stage("emulators", len(table.outputs), progress, cancel).begin()
    if table.gradients is not None:
        return fit_gradient_emulators(table, tick=stage.step, may_log=may_log)
    return EmulatorSet(table.inputs, tuple(fit_emulators(table, seed=seed, tick=stage.step, may_log=may_log)))


def sensitivity(
    emulators: AnyEmulators,
    *,
    box: Box | None = None,
    count: int = 1024,
    draws: int = 32,
    seed: int = 1,
    progress: OnProgress | None = None,
    cancel: Cancel | None = None,
) -> Sensitivity:
    """First-order, total and second-order Sobol' indices of each output (p) to each input (d), without units.

    box: ranges of the inputs, in their units (default: published ranges of known inputs, the runs' ranges of others);
    count: base points, a power of two; draws: functions drawn from each emulator for its own uncertainty.
    Inputs are independent for them: points of the ranges that break an ordering of the box count. Raises UsageError, LacliError
    where next to no run lies in the box, Cancelled.
    """
    import numpy as np

    from lacli.inference.box import table_box
    from lacli.inference.given import check_logarithms
    from lacli.inference.sampling.coverage import WORTH_SAYING, check_coverage
    from lacli.inference.sensitivity import emulator_indices

    check_count(count)
    if box is None:
        box = table_box(emulators.inputs, np.vstack(emulators.range()))
    elif box.names != emulators.inputs:
        raise UsageError(f"sensitivity: the box must hold exactly the inputs {', '.join(emulators.inputs)}, in this order.")
    check_logarithms(emulators, box)
    covered, broken = check_coverage(box, emulators.training_inputs()), 1.0 - box.share_in_order()
    disordered = ""
    if broken > WORTH_SAYING:
        pairs = " and ".join(f"{box.names[i]} is not below {box.names[j]}" for i, j in box.ordered)
        disordered = (
            f"in {broken:.1%} of these ranges {pairs}, where no simulation can be: indices are of independent inputs and count"
            " it. Give ranges that do not overlap."
        )
    stage = Stage("Sobol' indices", len(emulators.outputs), progress, cancel).begin()
    indices = emulator_indices(emulators, box.lower, box.upper, count, draws=draws, seed=seed, tick=stage.step)
    words = " ".join(filter(None, [covered.words(), disordered, _unlearned(emulators)]))
    return Sensitivity(indices, box, broken + (1.0 - broken) * covered.share, words)


def check_count(count: int) -> None:
    """Raises UsageError where a number of base points is no power of two."""
    if count < 2 or count & (count - 1):
        raise UsageError(f"-n {count}: must be a power of two (a Sobol' sequence is balanced only there).")


def match(
    emulators: AnyEmulators,
    targets: Targets,
    *,
    box: Box | None = None,
    earlier: Sequence[AnyEmulators] = (),
    threshold: float | None = None,
    earlier_threshold: float | None = None,
    count: int = 10_000,
    following: int = 100,
    runs: FloatArray | None = None,
    seed: int = 0,
    progress: OnProgress | None = None,
    cancel: Cancel | None = None,
) -> Matching:
    """What history matching leaves of the box: its share, ``count`` points sampled uniformly from it, ``following`` next runs.

    Emulators and targets are in the same units; targets of outputs without an emulator are left out. earlier: emulators of
    the earlier waves, in order, of the same inputs and outputs; threshold, earlier_threshold: implausibilities (in standard
    deviations) from which a point is ruled out by this wave, and by all earlier ones (None: as a calibration, 3.5 in the first
    wave and 3.0 after); runs (n, d): those done (default: the emulators').
    Raises NothingLeft, UsageError, LacliError where next to no run lies in the box, Cancelled.
    """
    import numpy as np

    from lacli.inference.box import table_box
    from lacli.inference.given import check_logarithms
    from lacli.inference.matching.matching import Region, Wave, next_runs, ruled_out_by
    from lacli.inference.matching.matching import match as measure
    from lacli.inference.matching.nroy import EmptyRegionError
    from lacli.inference.sampling.coverage import check_coverage
    from lacli.inference.sampling.verdict import judge

    targets = targets.select(emulators.outputs)
    if box is None:
        box = table_box(emulators.inputs, np.vstack(emulators.range()))
    elif box.names != emulators.inputs:
        raise UsageError(f"match: the box must hold exactly the inputs {', '.join(emulators.inputs)}, in this order.")
    for before in earlier:
        if before.inputs != emulators.inputs or before.outputs != emulators.outputs:
            raise UsageError(
                "match: the emulators of an earlier wave must have the inputs and outputs of this wave, in its order."
            )
    for each in (*earlier, emulators):
        check_logarithms(each, box)
    *before_it, own = _thresholds(len(earlier), threshold, earlier_threshold)
    waves = tuple(Wave(before, targets, bound) for before, bound in zip(earlier, before_it, strict=True))
    wave = Wave(emulators, targets, own)
    region = Region(box, (*waves, wave))
    runs = emulators.training_inputs() if runs is None else runs
    candidates = None  # the whole box, or what the earlier waves have not ruled out
    if waves:
        candidates = box.uniform(1 << 15, np.random.default_rng(0))
        candidates = candidates[Region(box, waves).contains(candidates)]
    covered = check_coverage(box, runs, candidates)
    check(cancel, "matching")

    def tick(level: float) -> None:
        if progress is not None:
            progress(Progress(f"matching (level {level:.3g}; 1 is the region)", min(1.0, 1.0 / level) if level > 0 else 1.0, 1.0))
        check(cancel, "matching")

    said = tuple(filter(None, [covered.words()]))
    try:
        found = measure(region, count, seed=seed, tick=tick)
    except EmptyRegionError as error:
        raise NothingLeft(
            "nothing is left: at the nearest point of the box, " + ruled_out_by(wave, error.best[None])
            + ". Check the targets' units and standard deviations, or widen the box.",
            (*said, *judge(emulators, wave.targets, box, error.best, wave.threshold).warnings()),
        ) from error  # fmt: skip
    proposed = next_runs(found.sample, following, runs) if following else np.empty((0, box.d))
    return Matching(region, found, proposed, covered.share, said)


def _thresholds(earlier: int, own: float | None, of_earlier: float | None) -> list[float]:
    """The threshold of each earlier wave and of this one; where none is said, that of a calibration's wave of that number."""
    from lacli.calibration.calibration import Settings

    usual = Settings().thresholds
    found = [usual[min(number, len(usual) - 1)] for number in range(earlier + 1)]
    if of_earlier is not None:
        found[:-1] = [of_earlier] * earlier
    return found if own is None else [*found[:-1], own]
