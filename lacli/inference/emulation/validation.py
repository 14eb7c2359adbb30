"""How good an emulator is: cross-validated R2, share within two standard deviations, log density."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from lacli.base.arrays import BoolArray, FloatArray
from lacli.contracts.tables.table import RunTable
from lacli.inference.emulation.emulator import fit_emulator, folds
from lacli.inference.emulation.gradient_gp import fit_gradient_emulators
from lacli.inference.emulation.scales import may_be_logarithmic


@dataclass(frozen=True)
class Scores:
    """Five-fold scores of one output; mean, sd (n,): held-out predictions in the output's units.

    r2 = 1 - RSS / TSS; ise = share of runs with |error| < 2 sd; nlpd = mean negative log predictive density of the
    output divided by its standard deviation over the runs; train_cpu_s: CPU seconds of one fit on all runs.
    """

    output: str
    r2: float
    ise: float
    nlpd: float
    train_cpu_s: float
    mean: FloatArray
    sd: FloatArray


def score(y: FloatArray, mean: FloatArray, variance: FloatArray) -> tuple[float, float, float]:
    """R2, ISE and NLPD of predictions (n,) of y (n,)."""
    error = y - mean
    total = float(((y - y.mean()) ** 2).sum())
    r2 = 1.0 - float((error**2).sum()) / total
    # a printed definition without the absolute value counts every overprediction as a success
    ise = float((np.abs(error) < 2.0 * np.sqrt(variance)).mean())
    standard = variance / y.var()
    nlpd = float(np.mean(0.5 * np.log(2.0 * np.pi * standard) + 0.5 * error**2 / variance))
    return r2, ise, nlpd


def cross_validate(
    table: RunTable,
    *,
    count: int = 5,
    starts: int = 3,
    seed: int = 0,
    tick: Callable[[], None] | None = None,
    may_log: BoolArray | None = None,
) -> list[Scores]:
    """Scores of every output over ``count`` folds; scales, hyperparameters and calibration are refitted in each fold;
    may_log as in ``fit_emulator``."""
    # by all runs: a fold that lacks the run at 0 would take a logarithm there
    may_log = may_be_logarithmic(table.x) if may_log is None else may_log
    options: dict[str, Any] = {"starts": starts, "seed": seed, "may_log": may_log}
    parts = folds(table.runs, count, np.random.default_rng(seed))
    result = []
    for j, output in enumerate(table.outputs):
        mean, variance = np.empty(table.runs), np.empty(table.runs)
        for part in parts:
            rest = np.setdiff1d(np.arange(table.runs), part)
            emulator = fit_emulator(table.x[rest], table.y[rest, j], output, table.error_sd[rest, j], **options)
            mean[part], variance[part] = emulator.predict(table.x[part])
            if tick is not None:
                tick()
        variance += table.error_sd[:, j] ** 2  # a run's own discretisation error is part of what is compared with
        begin = time.process_time()
        fit_emulator(table.x, table.y[:, j], output, table.error_sd[:, j], **options)
        cpu = time.process_time() - begin
        r2, ise, nlpd = score(table.y[:, j], mean, variance)
        result.append(Scores(output, r2, ise, nlpd, cpu, mean, np.sqrt(variance)))
    return result


def cross_validate_gradients(
    table: RunTable, *, count: int = 5, seed: int = 0, tick: Callable[[], None] | None = None, may_log: BoolArray | None = None
) -> list[Scores]:
    """Scores of every output over ``count`` folds, emulators learning from gradients too and fitted anew in each fold;
    train_cpu_s: an output's share of one fit. may_log as in ``fit_gradient_emulators``, which says what it raises."""
    may_log = may_be_logarithmic(table.x) if may_log is None else may_log
    mean, variance = np.empty_like(table.y), np.empty_like(table.y)
    begin = time.process_time()
    parts = folds(table.runs, count, np.random.default_rng(seed))
    for part in parts:
        fitted = fit_gradient_emulators(table.rows(np.setdiff1d(np.arange(table.runs), part)), seed=seed, may_log=may_log)
        mean[part], variance[part] = fitted.predict(table.x[part])
        if tick is not None:
            tick()
    cpu = (time.process_time() - begin) / len(parts) / len(table.outputs)
    variance += table.error_sd**2
    return [
        Scores(name, *score(table.y[:, j], mean[:, j], variance[:, j]), cpu, mean[:, j], np.sqrt(variance[:, j]))
        for j, name in enumerate(table.outputs)
    ]
