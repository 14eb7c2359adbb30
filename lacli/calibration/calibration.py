"""Calibration of one patient: waves of runs, the posterior, and the simulation at its most probable point.

Everything a step leaves behind is a file in the calibration's folder; a step whose files exist is not done again, and
all random numbers come from the seed and the step's number: an interrupted calibration, started again, ends the same.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from lacli.base.arrays import FloatArray
from lacli.base.errors import LacliError, UsageError
from lacli.base.files import write_json
from lacli.base.schema import Array, array_file
from lacli.contracts.identity import Identity, conflict, flatten, identify, parse_identity, read_identity, write_identity
from lacli.contracts.priors import check_priors
from lacli.contracts.tables.table import RunTable
from lacli.contracts.targets import Targets
from lacli.inference.box import Box
from lacli.inference.design import design
from lacli.inference.emulation.emulator import fit_emulators
from lacli.inference.emulation.emulator_set import AnyEmulators, EmulatorSet, emulators_identity, load_emulators, save_emulators
from lacli.inference.emulation.feasibility import learn
from lacli.inference.emulation.gradient_gp import fit_gradient_emulators
from lacli.inference.given import logarithmic
from lacli.inference.matching.file import load_match, save_match
from lacli.inference.matching.matching import Match, Region, Wave, match, next_runs, ruled_out_by
from lacli.inference.matching.nroy import EmptyRegionError, RegionSample
from lacli.inference.runs import RunLog, Simulator
from lacli.inference.sampling import posterior as mcmc
from lacli.inference.sampling.coverage import Extrapolation, check_coverage, extrapolation
from lacli.inference.sampling.likelihood import Density
from lacli.inference.sampling.verdict import Verdict, judge

FILE = "calibration.json"  # the identity of the calibration in a folder
# settings that say how far to go, not where: with others a calibration goes on
BUDGETS = frozenset({"max_waves", "max_runs", "hours", *(f"mcmc.{name}" for name in mcmc.STOPPING)})


@dataclass(frozen=True)
class Settings:
    """Runs, stops and random numbers of a calibration: first_runs, then wave_runs for each wave; thresholds of the waves (the
    last one goes on); stop when the region's share changes by less than ``tolerance``, after max_waves, max_runs or when
    another wave would exceed ``hours``."""

    first_runs: int = 200
    wave_runs: int = 100
    max_waves: int = 5
    thresholds: tuple[float, ...] = (3.5, 3.0)
    tolerance: float = 0.01
    max_runs: int = 10_000
    hours: float = float("inf")
    draws: int = 8
    starts: int = 2
    prior: str = "nroy"
    seed: int = 0
    mcmc: mcmc.Settings = field(default_factory=mcmc.Settings)


@dataclass(frozen=True)
class WaveReport:
    """One wave, as recorded: runs used and failed, held-out R2 by output and the share of runs within two standard deviations
    when left out (ise), share of the box left with standard error, change: the part of it that better emulators removed (NaN
    in the first wave)."""

    wave: int
    runs: int
    failed: int
    threshold: float
    r2: dict[str, float]
    share: float
    share_sd: float
    change: float
    notes: list[str]
    ise: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Status:
    """Where a calibration stands, for a dashboard."""

    stage: str
    wave: int
    done: int
    total: int
    waves: tuple[WaveReport, ...] = ()


Monitor = Callable[[Status], None]


def _ticker(monitor: Monitor, stage: str, wave: int, reports: list[WaveReport]) -> Callable[[int, int], None]:
    """A function of (done, total) that tells the monitor."""
    waves = tuple(reports)
    return lambda done, total: monitor(Status(stage, wave, done, total, waves))


def _quiet(status: Status) -> None:
    del status


@dataclass(frozen=True)
class Calibration:
    """The result. map_x (d,); table: summary by input; fit: predicted against target by feature at the most probable
    point; rmse_mm over the displacements (None without runs); draws: features of runs at posterior draws (k, p); beyond: how
    much lies where no run of a table from elsewhere has been (None of waves, whose runs are made for the box)."""

    waves: tuple[WaveReport, ...]
    region: Region
    emulators: AnyEmulators
    samples: tuple[RegionSample, ...]
    chain: mcmc.Chain
    map_x: FloatArray
    table: list[dict[str, float | str]]
    fit: list[dict[str, float | str]]
    rmse_mm: float | None
    draws: FloatArray
    stopped: str
    x: FloatArray
    verdict: Verdict
    beyond: Extrapolation | None = None


def calibrate(
    simulator: Simulator | None,
    box: Box,
    targets: Targets,
    settings: Settings,
    folder: Path,
    log: RunLog,
    given: FloatArray | None = None,
    monitor: Monitor = _quiet,
    said: Sequence[str] = (),
) -> Calibration:
    """Calibrate against the targets; ``log`` holds the runs.

    given (n, d): points already in the log, used as the first wave in place of a design. simulator None: no run is made;
    one wave on the given runs, learnt with their derivatives where the table tells any, then the posterior (``--from-table``);
    said: what was met before, for the first wave's notes. Raises LacliError with the target that no point of the box reaches,
    if that is so, UsageError where next to no given run lies in the box.
    """  # fmt: skip
    if simulator is not None and settings.first_runs > settings.max_runs:
        raise UsageError(
            f"calibrate: the first wave's {settings.first_runs} runs are more than the {settings.max_runs} allowed;"
            " lower --first-runs or raise --max-runs."
        )
    check_priors(targets.priors, box.names, box.lower, box.upper)  # before a run is spent
    begin = time.monotonic()
    folder.mkdir(parents=True, exist_ok=True)
    identity = calibration_identity(
        box, targets, settings, given_runs(log, given, targets) if given is not None else log.identity
    )
    if words := obstacle(folder, identity):
        raise UsageError(f"{folder} {words}. Choose another --out.")
    x = given if given is not None else design(box, settings.first_runs, "sobol", settings.seed)
    covered = None  # waves make their runs for the box
    region, stopped = Region(box), ""
    reports: list[WaveReport] = []
    samples: list[RegionSample] = []
    emulators: AnyEmulators | None = None
    found: Match | None = None
    number = 0
    while not stopped:
        number += 1
        if simulator is not None:
            log.run(simulator, x, _ticker(monitor, "runs", number, reports))
        place = folder / f"wave_{number}"
        tick = _ticker(monitor, "emulators", number, reports)
        emulators, notes, finished_x, failed_x = _emulators(log, x, box, targets, settings, place, tick)
        if number == 1:
            notes = [*said, *notes]
        if simulator is None:
            covered = check_coverage(box, finished_x)
        wave = Wave(emulators, targets, settings.thresholds[min(number, len(settings.thresholds)) - 1])
        region = region.add(wave)
        monitor(Status("matching", number, 0, 1, tuple(reports)))
        try:
            found = _match(region, settings, number, place, found)
        except EmptyRegionError as error:
            raise LacliError(
                "calibrate: no point of the box agrees with all targets: at the nearest one, "
                + ruled_out_by(wave, error.best[None])
                + ". Check the targets' units and standard deviations, or widen the box."
                + (f" {words}" if covered is not None and (words := covered.words()) else "")
            ) from error
        if number == 1:  # not sooner: targets or a box that leave nothing may be put right and tried again here
            write_identity(folder / FILE, identity)
        samples.append(found.sample)
        r2 = dict(zip(emulators.outputs, emulators.held_out_r2.tolist(), strict=True))
        ise = (
            dict(zip(emulators.outputs, emulators.left_out_ise().tolist(), strict=True))
            if isinstance(emulators, EmulatorSet)
            else {}
        )
        counts = (len(finished_x), len(failed_x))
        reports.append(WaveReport(number, *counts, wave.threshold, r2, found.share, found.share_sd, found.change, notes, ise))
        monitor(Status("wave done", number, 1, 1, tuple(reports)))
        last_threshold = number >= len(settings.thresholds)
        elapsed = (time.monotonic() - begin) / 3600.0
        if simulator is None:
            stopped = "runs from a table"
        elif last_threshold and number > 1 and found.change < settings.tolerance:
            stopped = f"the region changed by less than {settings.tolerance:.0%}"
        elif number >= settings.max_waves:
            stopped = f"{settings.max_waves} waves were allowed"
        elif len(x) + settings.wave_runs > settings.max_runs:
            stopped = f"{settings.max_runs} runs were allowed"
        elif elapsed * (len(x) + settings.wave_runs) / len(x) > settings.hours:
            stopped = f"another wave would exceed {settings.hours:g} hours"
        else:
            x = np.vstack([x, _next(box, found.sample, settings, x, finished_x, failed_x, notes)])
    assert emulators is not None
    density = Density(emulators, region.waves[-1].targets, region if settings.prior == "nroy" else Region(box))
    chain = _sample(density, settings, samples[-1], folder / "chain.npz", monitor, number, tuple(reports))
    map_x, _ = mcmc.maximum(density, chain)
    table = mcmc.summary(chain, map_x, density.region.box, density.targets.priors)
    verdict = judge(emulators, density.targets, box, map_x, region.waves[-1].threshold, chain.flat())
    beyond = extrapolation(covered, chain.flat(), finished_x) if covered is not None else None
    draws = np.empty((0, len(targets.names)))
    fit, rmse = _fit(emulators, targets, map_x, None), None
    if simulator is not None:
        pick = np.random.default_rng(settings.seed).choice(len(chain.flat()), settings.draws, replace=False)
        last = np.vstack([map_x, chain.flat()[pick]])
        log.run(
            simulator, last, lambda done, total: monitor(Status("simulations at the answer", number, done, total, tuple(reports)))
        )
        simulated = log.frame(last)[list(targets.names)].to_numpy(float)
        draws = simulated[1:]
        fit = _fit(emulators, targets, map_x, simulated[0])
        off = [float(r["simulated"]) - float(r["target"]) for r in fit if str(r["feature"]).endswith("_mm")]
        rmse = float(np.sqrt(np.mean(np.square(off)))) if off else None
    result = Calibration(
        tuple(reports), region, emulators, tuple(samples), chain, map_x, table, fit, rmse, draws, stopped, x, verdict, beyond
    )  # fmt: skip
    write_json(folder / "result.json", {"identity": identity.digest, **document(result)})
    return result


def document(result: Calibration) -> dict[str, Any]:
    """The result as plain values."""
    return _finite(
        {
            "stopped": result.stopped,
            "waves": [asdict(report) for report in result.waves],
            "posterior": result.table,
            "converged": result.chain.converged,
            "samples": len(result.chain.flat()),
            "acceptance": result.chain.acceptance,
            "fit": result.fit,
            "verdict": result.verdict.document(),
            **({"outside_runs": {"box": beyond.box, "posterior": beyond.posterior}} if (beyond := result.beyond) else {}),
            "rmse_mm": result.rmse_mm,
            "draws": result.draws.tolist(),
        }
    )


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _finite(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(v) for v in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


def calibration_identity(box: Box, targets: Targets, settings: Settings, runs: Any, **more: Any) -> Identity:
    """What determines a calibration: box, targets, settings but for budgets (those may change and it goes on), its runs.

    runs: the identity of its log, or the numbers of a table given.
    """
    chosen = {key: value for key, value in flatten(settings).items() if key not in BUDGETS}
    return identify("calibration", runs=runs, box=box, targets=targets, settings=chosen, **more)


def given_runs(log: RunLog, x: FloatArray, targets: Targets) -> dict[str, Any]:
    """What determines a calibration on the rows x (n, d) of a table from elsewhere: all that the table says of them."""
    table = log.table(x, targets.names)
    return {f.name: getattr(table, f.name) for f in fields(table) if f.name != "notes"}


def obstacle(folder: Path, identity: Identity) -> str:
    """Why the folder cannot take the calibration, in words; '' where it is free or holds the same."""
    file = folder / FILE
    return conflict(read_identity(file), identity, "a calibration") if file.exists() else ""


def _emulators(
    log: RunLog, x: FloatArray, box: Box, targets: Targets, settings: Settings, place: Path, tick: Callable[[int, int], None]
) -> tuple[AnyEmulators, list[str], FloatArray, FloatArray]:
    table = log.table(x, targets.names)
    missing = [name for name in targets.names if name not in table.outputs]
    if missing or table.inputs != log.inputs:
        raise LacliError(
            "calibrate: " + " ".join(table.notes) + " Remove what never varies from the targets or the box, or add runs."
        )
    table = table.select(targets.names)
    file = place / "emulators.npz"
    # they are asked all over the box: no logarithm of an input that reaches 0 there, though no run does
    options: dict[str, Any] = {"seed": settings.seed, "may_log": logarithmic(table, box)}
    # a table from elsewhere is learnt as everywhere; waves are those published, of values alone
    slopes = log.identity is None and table.gradients is not None
    options |= {"gradients": True} if slopes else {"starts": settings.starts}
    identity = emulators_identity(table, **options)
    # whatever of a wave is not made from what there is now is made again: it costs no runs
    if not _kept(file, identity):
        done = itertools.count(1)
        save_emulators(file, _learn(table, lambda: tick(next(done), len(targets.names)), options), identity)
    return load_emulators(file), list(table.notes), table.x, table.failed_x


def _learn(table: RunTable, tick: Callable[[], None], options: dict[str, Any]) -> AnyEmulators:
    if "gradients" in options:
        return fit_gradient_emulators(table, tick=tick, seed=options["seed"], may_log=options["may_log"])
    return EmulatorSet(table.inputs, tuple(fit_emulators(table, tick=tick, **options)))


def _kept(file: Path, identity: Identity) -> bool:
    """Whether the .npz file was made from the same. Raises InputError where it is damaged."""
    if not file.is_file():
        return False
    with array_file(file, "a wave's result", "Remove it to make it anew.", sealed=True) as arrays:
        found = arrays.read({"identity": Array("text")}, optional=("identity",))
        return "identity" in found and parse_identity(str(found["identity"])) == identity


def _match(region: Region, settings: Settings, number: int, place: Path, previous: Match | None) -> Match:
    file = place / "region.npz"
    identity = identify("region", region=region, seed=settings.seed)
    if not _kept(file, identity):
        save_match(file, match(region, seed=settings.seed + number, previous=previous), identity.text())
    return load_match(file, region.box)


def _next(
    box: Box, sample: RegionSample, settings: Settings, x: FloatArray, finished: FloatArray, failed: FloatArray, notes: list[str]
) -> FloatArray:
    feasibility = learn(box, finished, failed)
    if feasibility is None:
        return next_runs(sample, settings.wave_runs, x)
    likely = feasibility.accept(sample.points)
    if likely.sum() < settings.wave_runs:  # the answer lies where runs fail: say so, and try all the same
        notes.append(f"{feasibility.describe()} Hardly any point left to match is of that kind: they are tried all the same.")
        return next_runs(sample, settings.wave_runs, x)
    notes.append(feasibility.describe())
    return next_runs(replace(sample, points=sample.points[likely]), settings.wave_runs, x)


def _sample(
    density: Density,
    settings: Settings,
    sample: RegionSample,
    file: Path,
    monitor: Monitor,
    number: int,
    reports: tuple[WaveReport, ...],
) -> mcmc.Chain:
    options = replace(settings.mcmc, seed=settings.seed)
    previous = mcmc.load_chain(file) if file.is_file() else None
    if previous is not None and parse_identity(previous.key) != mcmc.chain_identity(density, options):
        previous = None  # of fewer waves (a changed budget): it costs no runs, and is sampled anew

    def keep(chain: mcmc.Chain) -> None:
        mcmc.save_chain(file, chain)
        monitor(Status("posterior", number, chain.steps, max(chain.steps, 500), reports))

    start = sample.points if settings.prior == "nroy" else None
    return mcmc.sample_posterior(density, options, start, previous, keep)


def _fit(emulators: AnyEmulators, targets: Targets, x: FloatArray, simulated: FloatArray | None) -> list[dict[str, float | str]]:
    mean, variance = emulators.predict(x[None])
    rows: list[dict[str, float | str]] = []
    for j, name in enumerate(targets.names):
        row: dict[str, float | str] = {
            "feature": name, "target": float(targets.mean[j]), "sd": float(targets.sd[j]), "own_sd": float(targets.own_sd[j]),
            "emulated": float(mean[0, j]), "emulator_sd": float(np.sqrt(variance[0, j])),
        }  # fmt: skip
        if simulated is not None:
            row["simulated"] = float(simulated[j])
        rows.append(row)
    return rows
