"""A study in one call each: statistics over many patients."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from lacli.cohort.statistics import Statistics


def stats(
    table: Path,
    response: str,
    predictors: Sequence[str] = (),
    *,
    draws: Path | None = None,
    targets: Path | None = None,
    patient: str = "participant_id",
    region: str = "region",
    seed: int = 0,
) -> Statistics:
    """Paired tests of the response between regions, and its mixed model with each predictor, plain and carried.

    table: a row for each patient and region; ``<column>_sd`` beside a column is its posterior's standard deviation, or
    ``draws`` holds joint draws of it. targets: a file of targets that the stiffness was calibrated to. Raises TableError,
    InputError, UsageError before anything is computed.
    """
    from lacli.base.threads import one_thread
    from lacli.cohort.observations import read_observations
    from lacli.cohort.statistics import statistics
    from lacli.contracts.targets import read_targets

    observed = read_observations(table, [response, *predictors], patient, region, draws)
    names = read_targets(targets).names if targets is not None else None
    with one_thread():
        return statistics(observed, response, predictors, names, seed)
