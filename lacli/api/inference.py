"""Inference in one call each: emulate a table of runs, rank its inputs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from lacli.api.progress import Cancel, OnProgress, Stage
from lacli.base.errors import UsageError

if TYPE_CHECKING:
    from lacli.base.arrays import BoolArray
    from lacli.contracts.identity import Identity
    from lacli.contracts.table import RunTable
    from lacli.inference.box import Box
    from lacli.inference.emulation.emulator_set import EmulatorSet
    from lacli.inference.emulation.validation import Scores
    from lacli.inference.sensitivity import Sobol


@dataclass(frozen=True)
class Emulation:
    """Emulators of a table's outputs, in its order, the scores of their cross-validation, and what they were made from."""

    emulators: EmulatorSet
    scores: tuple[Scores, ...]
    identity: Identity


@dataclass(frozen=True)
class Sensitivity:
    """Sobol' indices of the emulators' outputs (p) to their inputs (d) over the box, with the box.

    outside: the share of the box where no run has been; warning: that in words, empty where it is next to nothing.
    """

    indices: Sobol
    box: Box
    outside: float
    warning: str


def emulate(
    table: RunTable,
    *,
    box: Box | None = None,
    linear: Sequence[str] = (),
    folds: int = 5,
    starts: int = 3,
    seed: int = 0,
    progress: OnProgress | None = None,
    cancel: Cancel | None = None,
) -> Emulation:
    """One Gaussian-process emulator per output of the table, cross-validated over ``folds`` folds.

    Emulators take inputs and give outputs in the table's units. box: where they will be used (default: where the runs
    are); an input that reaches 0 there, or is named in ``linear``, is never taken as its logarithm. starts: starting
    points of each fit. Raises UsageError, Cancelled.
    """
    from lacli.base.threads import one_thread
    from lacli.inference.emulation.emulator import fit_emulators
    from lacli.inference.emulation.emulator_set import EmulatorSet, emulators_identity
    from lacli.inference.emulation.validation import cross_validate

    if folds < 2 or starts < 1:
        raise UsageError(f"emulate: folds {folds}, starts {starts}; at least 2 and 1.")
    options: dict[str, Any] = {"starts": starts, "seed": seed, "may_log": logarithmic(table, box, linear)}
    with one_thread():
        stage = Stage("cross-validation", len(table.outputs) * folds, progress, cancel).begin()
        scores = cross_validate(table, count=folds, tick=stage.step, **options)
        stage = Stage("emulators", len(table.outputs), progress, cancel).begin()
        emulators = EmulatorSet(table.inputs, tuple(fit_emulators(table, tick=stage.step, **options)))
    return Emulation(emulators, tuple(scores), emulators_identity(table, **options))


def sensitivity(
    emulators: EmulatorSet,
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
    Raises UsageError, LacliError where next to no run lies in the box, Cancelled.
    """
    import numpy as np

    from lacli.inference.box import table_box
    from lacli.inference.coverage import check_coverage
    from lacli.inference.sensitivity import emulator_indices

    check_count(count)
    if box is None:
        box = table_box(emulators.inputs, np.vstack(emulators.range()))
    elif box.names != emulators.inputs:
        raise UsageError(f"sensitivity: the box must hold exactly the inputs {', '.join(emulators.inputs)}, in this order.")
    covered = check_coverage(box, emulators.training_inputs())
    stage = Stage("Sobol' indices", len(emulators.outputs), progress, cancel).begin()
    indices = emulator_indices(emulators, box.lower, box.upper, count, draws=draws, seed=seed, tick=stage.step)
    return Sensitivity(indices, box, covered.share, covered.words())


def check_count(count: int) -> None:
    """Raises UsageError where a number of base points is no power of two."""
    if count < 2 or count & (count - 1):
        raise UsageError(f"-n {count}: must be a power of two (a Sobol' sequence is balanced only there).")


def logarithmic(table: RunTable, box: Box | None, linear: Sequence[str]) -> BoolArray:
    """Inputs that may be taken as logarithms (d,): positive in the runs and in the box, and not named ``linear``.

    Raises UsageError for a name that is no input, and for a box of other inputs.
    """
    import numpy as np

    from lacli.inference.emulation.scales import may_be_logarithmic

    unknown = [name for name in linear if name not in table.inputs]
    if unknown:
        raise UsageError(f"--linear {', '.join(unknown)}: no input of the table; its inputs are {', '.join(table.inputs)}.")
    found: BoolArray = may_be_logarithmic(table.x)
    if box is not None:
        if box.names != table.inputs:
            raise UsageError(f"emulate: the box must hold exactly the inputs {', '.join(table.inputs)}, in this order.")
        found = found & may_be_logarithmic(np.vstack([table.x, box.lower, box.upper]))
    found &= np.array([name not in linear for name in table.inputs])
    return found
