"""Calibration that seeks the posterior: Gauss-Newton to the most probable point, runs around it, sampling through an emulator
with derivatives, further runs where its error matters, and a check of the whole box.

Every run is in the log; what is run next follows from the runs there are and the seed: started again after an interruption, the
calibration goes the same way, finding its runs done.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import qmc

from lacli.base.arrays import FloatArray
from lacli.base.errors import LacliError, UsageError
from lacli.base.files import write_json
from lacli.base.threads import single_threaded
from lacli.calibration.calibration import obstacle
from lacli.calibration.sequential import change, descent, modes
from lacli.calibration.sequential.chain import sample
from lacli.calibration.sequential.descent import Incumbent
from lacli.calibration.sequential.emulator import Components, fit
from lacli.calibration.sequential.evidence import Evidence, gather
from lacli.calibration.sequential.laplace import Laplace, spread_out
from lacli.calibration.sequential.scale import Scale
from lacli.calibration.sequential.verdict import unlearned, verdict
from lacli.contracts.identity import Identity, identify, write_identity
from lacli.contracts.targets import Targets
from lacli.inference.box import Box
from lacli.inference.runs import RunLog, Simulator
from lacli.inference.sampling import posterior as mcmc

FILE = "calibration.json"
_MODE = 25.0  # excess of chi^2 up to which a second minimum has a share in the posterior
_LOCAL = 12.0  # Mahalanobis distance up to which a run takes part in the local emulator
_DESCENT_ROUNDS = 24


@dataclass(frozen=True)
class Settings:
    """How far the search goes.

    starts of the search (>= 4); first_runs around the most probable point, drawn from a Gaussian ``widening`` times as wide
    as the posterior's, then ``batch`` at a time; end when the emulator's error moves the posterior's mean by less than
    ``share`` of its sd in every input, or at max_runs. mode_runs: at most so many to rule out other modes.
    """

    starts: int = 4
    first_runs: int = 12
    widening: float = 1.6
    batch: int = 4
    share: float = 0.1
    mode_runs: int = 12
    max_runs: int = 60
    seed: int = 0
    mcmc: mcmc.Settings = field(default_factory=mcmc.Settings)


@dataclass(frozen=True)
class Status:
    """Where a calibration stands: its stage, runs done of those asked for, and the runs so far in all."""

    stage: str
    done: int
    total: int
    runs: int


Monitor = Callable[[Status], None]


@dataclass(frozen=True)
class Sequential:
    """The result. map_x (d,) and its chi^2; runs by stage, ``map_runs`` until the most probable point was found; table: summary
    by input; change (d,): how far the emulator's error may still move the posterior's mean, in its sds; minima
    (k, d): the modes found, the best first; sweep: what the check of the box says; notes: what a user must know."""

    box: Box
    targets: Targets
    map_x: FloatArray
    misfit: float
    map_runs: int
    stages: dict[str, int]
    failed: int
    table: list[dict[str, float | str]]
    change: FloatArray
    minima: FloatArray
    sweep: modes.Sweep
    chain: mcmc.Chain
    fit: list[dict[str, float | str]]
    held_out: float
    stopped: str
    refused: str
    notes: tuple[str, ...]
    x: FloatArray
    cpu_s: float

    @property
    def runs(self) -> int:
        """All runs asked for."""
        return len(self.x)


class _Search:
    """The runs so far, with what asks for more."""

    def __init__(
        self, simulator: Simulator, box: Box, targets: Targets, settings: Settings, log: RunLog, monitor: Monitor
    ) -> None:
        self.simulator, self.box, self.targets, self.settings = simulator, box, targets, settings
        self.log, self.monitor = log, monitor
        self.scale = Scale.of(box)
        self.x = np.empty((0, box.d))
        self.stages: dict[str, int] = {}
        self.notes: list[str] = []

    def run(self, z: FloatArray, stage: str) -> Evidence:
        """Run the points z (k, d) that the budget allows; the evidence of all runs."""
        x = self.scale.to_x(z)
        x = x[self.box.contains(x)][: max(0, self.settings.max_runs - len(self.x))]
        if len(x):
            before = len(self.x)
            self.log.run(self.simulator, x, lambda done, total: self.monitor(Status(stage, done, total, before + done)))
            self.x = _joined(self.x, x)
            self.stages[stage] = self.stages.get(stage, 0) + len(self.x) - before
        return self.evidence()

    def evidence(self) -> Evidence:
        """Of all runs so far."""
        return gather(self.log, self.x, self.targets, self.scale)

    @property
    def left(self) -> int:
        """Runs that the budget still allows."""
        return self.settings.max_runs - len(self.x)

    def say(self, stage: str) -> None:
        """Tell the monitor of a stage without runs."""
        self.monitor(Status(stage, 0, 0, len(self.x)))


def _joined(x: FloatArray, more: FloatArray) -> FloatArray:
    """Both, each point once, in order."""
    return np.array(list(dict.fromkeys(tuple(row) for row in np.vstack([x, more]).tolist())))


@single_threaded
def calibrate_sequentially(
    simulator: Simulator,
    box: Box,
    targets: Targets,
    settings: Settings,
    folder: Path,
    log: RunLog,
    monitor: Monitor = lambda status: None,
    notes: Sequence[str] = (),
) -> Sequential:
    """Calibrate against the targets; ``log`` holds the runs, which must tell derivatives; ``notes`` go into the result.

    Raises LacliError where runs tell none or too few finish, UsageError where the folder holds another calibration.
    """
    if settings.starts < 4 or settings.max_runs < settings.starts + 2 * box.d:
        raise UsageError(f"calibrate: at least 4 starts and {4 + 2 * box.d} runs are needed (--max-runs).")
    if len(targets.names) < 1:
        raise UsageError("calibrate: no targets.")
    if targets.priors:
        raise UsageError(
            "calibrate: --method sequential knows uniform priors only, and the targets file has [priors]. "
            "Remove them, or use --method published."
        )
    folder.mkdir(parents=True, exist_ok=True)
    identity = sequential_identity(box, targets, settings, log.identity)
    if words := obstacle(folder, identity):
        raise UsageError(f"{folder} {words}. Choose another --out.")
    write_identity(folder / FILE, identity)
    search = _Search(simulator, box, targets, settings, log, monitor)
    search.notes.extend(notes)
    evidence = _start(search)
    evidence, components = _descend(search, evidence)
    map_runs = len(search.x)
    known = [_best(evidence)]
    evidence, known, components, swept = _other_modes(
        search, evidence, known, components, "other starts", settings.mode_runs // 2
    )
    evidence = _around(search, evidence, known)
    chain, evidence, moved, local, stopped = _refine(search, evidence, known, folder)
    evidence, known_after, components, swept = _other_modes(
        search, evidence, known, components, "check of the box", settings.mode_runs // 2
    )
    if len(known_after) > len(known):  # a mode that the first look missed: around it too
        known = known_after
        evidence = _around(search, evidence, known)
        chain, evidence, moved, local, stopped = _refine(search, evidence, known, folder)
    answer, _ = descent.lowest(local, evidence.z[int(np.argmin(evidence.misfit))])
    evidence = search.run(answer[None], "at the most probable point")
    result = _result(search, evidence, known, local, components, chain, moved, swept, map_runs, stopped)
    write_json(folder / "result.json", {"identity": identity.digest, **document(result)})
    return result


def sequential_identity(box: Box, targets: Targets, settings: Settings, runs: Any) -> Identity:
    """What determines the calibration: box, targets, settings but for budgets, its runs."""
    chosen = {k: v for k, v in asdict(settings).items() if k not in ("max_runs", "share", "mcmc")}
    sampling = {k: v for k, v in asdict(settings.mcmc).items() if k not in mcmc.STOPPING}
    return identify("calibration", way="sequential", runs=runs, box=box, targets=targets, settings=chosen, sampling=sampling)


def _start(search: _Search) -> Evidence:
    """The middle of the box and low-discrepancy points; more while fewer than two runs finish with derivatives."""
    d = search.box.d
    sobol = qmc.Sobol(d, rng=np.random.default_rng(search.settings.seed)).random(64)
    z = np.vstack([np.full((1, d), 0.5), 0.1 + 0.8 * sobol])
    evidence = search.run(z[: search.settings.starts], "starts")
    at = search.settings.starts
    while evidence.told.sum() < 2 and at < min(len(z), search.settings.starts + 16):
        evidence = search.run(z[at : at + 4], "starts")
        at += 4
    if not evidence.told.any():
        why = "none finished" if not len(evidence.z) else "those that finished tell no derivatives"
        raise LacliError(
            f"calibrate: of {len(search.x)} runs over the box {why}; the sequential method needs them. Look at "
            f"{search.log.path}, or use --method published. (Derivatives need the compiled engine and "
            "numerics.unloading = prestrain.)"
        )
    return evidence


def _descend(search: _Search, evidence: Evidence) -> tuple[Evidence, Components | None]:
    incumbents = [Incumbent(z) for z in evidence.z[evidence.told]]
    components = descent.emulate(evidence, None)
    for _ in range(_DESCENT_ROUNDS):
        tried = descent.trials(evidence, incumbents, components)
        if not tried or search.left <= 0:
            return evidence, components
        before = len(search.x)
        evidence = search.run(np.array([trial.z for trial in tried]), "to the most probable point")
        incumbents = descent.advance(evidence, incumbents, tried)
        components = descent.emulate(evidence, components)
        if len(search.x) == before and max(i.radius for i in incumbents) < 0.01:
            break
    search.notes.append("the search for the most probable point was ended before it settled.")
    return evidence, components


def _best(evidence: Evidence) -> Laplace:
    told = np.flatnonzero(evidence.told)
    row = told[int(np.argmin(evidence.misfit[told]))]
    return Laplace.at(evidence.z[row], evidence.residual[row], evidence.jacobian[row])


def _other_modes(
    search: _Search, evidence: Evidence, known: list[Laplace], components: Components | None, stage: str, budget: int
) -> tuple[Evidence, list[Laplace], Components, modes.Sweep]:
    """Run where another mode may be, until nothing is left or the budget is used; modes found are added."""
    known = list(known)
    used = 0
    while True:
        search.say("emulators")
        components = fit(evidence.z, evidence.residual, evidence.jacobian, components)
        best = float(evidence.misfit.min())
        found = modes.sweep(components, known, best, search.settings.seed)
        count = min(2, budget - used, search.left - 1)
        if not len(found.candidates) or count <= 0:
            return evidence, known, components, found
        before = len(search.x)
        evidence = search.run(found.candidates[:count], stage)
        if len(search.x) == before:
            return evidence, known, components, found
        used += len(search.x) - before
        components = fit(evidence.z, evidence.residual, evidence.jacobian, components)
        for z in found.candidates[:count]:
            row = descent.at(evidence, z)
            ran = np.abs(evidence.z[row] - z).max() < 1e-6 and evidence.told[row]
            as_good = evidence.misfit[row] < evidence.misfit.min() + _MODE
            if ran and as_good and modes.same_valley(components, known, evidence.z[row]) is not None:
                known.append(Laplace.at(evidence.z[row], evidence.residual[row], evidence.jacobian[row]))


def _around(search: _Search, evidence: Evidence, known: list[Laplace]) -> Evidence:
    rng = np.random.default_rng([search.settings.seed, 1])
    each = max(4, search.settings.first_runs // len(known))
    for mode in known:
        near = evidence.z[mode.distance(evidence.z) < 2.0 * search.settings.widening * np.sqrt(search.box.d)]
        drawn = mode.draw(400, search.settings.widening, rng)
        evidence = search.run(spread_out(drawn, each, mode, near), "around it")
    return evidence


def _local(search: _Search, evidence: Evidence, known: list[Laplace]) -> Evidence:
    """The runs that the local emulator learns from."""
    distance = np.min([mode.distance(evidence.z) for mode in known], axis=0)
    wanted = max(int((distance < _LOCAL).sum()), min(len(distance), search.box.d + 6))
    return evidence.take(np.sort(np.argsort(distance)[:wanted]).tolist())


def _refine(
    search: _Search, evidence: Evidence, known: list[Laplace], folder: Path
) -> tuple[mcmc.Chain, Evidence, FloatArray, Components, str]:
    """Sample; run where the emulator's error matters; until that is small beside the posterior."""
    settings = search.settings
    components: Components | None = None
    quick = replace(settings.mcmc, ess=min(400.0, settings.mcmc.ess), rhat=max(1.05, settings.mcmc.rhat), max_steps=1500)
    reserve = 1 + (settings.mode_runs // 2 if search.left > settings.mode_runs else 0)  # for the box, and for the answer
    round_ = 0
    while True:
        round_ += 1
        near = _local(search, evidence, known)
        components = fit(near.z, near.residual, near.jacobian, components)
        rng = np.random.default_rng([settings.seed, 2, round_])
        start = search.scale.to_x(np.vstack([mode.draw(1000, 1.3, rng) for mode in known]))
        search.say("posterior")
        chain = sample(components, search.scale, replace(quick, seed=settings.seed), start, None)
        draws = search.scale.to_z(chain.flat())
        moved = change.expected_change(components, draws, rng)
        if moved.max() < settings.share:
            stopped = f"the emulator's error moves the posterior's mean by less than {settings.share:g} of its sd in every input"
            break
        count = min(settings.batch, search.left - reserve)
        if count <= 0:
            stopped = f"{settings.max_runs} runs were allowed"
            worst = int(np.argmax(moved))
            search.notes.append(
                f"the emulator's error may still move the mean of {search.box.names[worst]} by {moved[worst]:.2f} of its sd "
                f"(asked: {settings.share:g}); more runs (--max-runs) would settle it."
            )
            break
        before = len(search.x)
        evidence = search.run(change.most_telling(components, draws, count, rng), "where the emulator matters")
        if len(search.x) == before:
            stopped = "no further run would tell more"
            break
    search.say("posterior")
    chain = sample(components, search.scale, replace(settings.mcmc, seed=settings.seed), start, folder / "chain.npz")
    return chain, evidence, moved, components, stopped


def _result(
    search: _Search,
    evidence: Evidence,
    known: list[Laplace],
    local: Components,
    whole: Components,
    chain: mcmc.Chain,
    moved: FloatArray,
    swept: modes.Sweep,
    map_runs: int,
    stopped: str,
) -> Sequential:
    box, targets = search.box, search.targets
    row = int(np.argmin(evidence.misfit))  # the run at the answer, but for the emulator's error there
    misfit, map_x = float(evidence.misfit[row]), evidence.x[row]
    frame = search.log.frame(evidence.x[row][None])
    nearest = frame[list(targets.names)].to_numpy(float)[0]
    fitted: list[dict[str, float | str]] = [
        {"feature": name, "target": float(t), "sd": float(s), "simulated": float(y), "misfit_sd": float((y - t) / s)}
        for name, t, s, y in zip(targets.names, targets.mean, targets.sd, nearest, strict=True)
    ]
    freedom = max(1, len(targets.names) - box.d)
    refused = verdict(evidence, whole, targets, misfit, freedom)
    notes = list(dict.fromkeys(search.notes))
    notes.append(swept.words())
    notes += unlearned(box, chain)
    if local.held_out > 2.0:
        notes.append(
            f"runs left out of the emulator miss it by {np.sqrt(local.held_out):.1f} times what it says of itself; its variance "
            "was widened by that."
        )
    if not chain.converged:
        notes.append("the chain has not converged (R-hat or effective samples are not those asked for).")
    used = search.log.frame(search.x)
    return Sequential(
        box, targets, map_x, misfit, map_runs, dict(search.stages), len(evidence.failed), mcmc.summary(chain, map_x, box, None),
        moved,
        search.scale.to_x(np.array([mode.centre for mode in known])), swept, chain, fitted, local.held_out, stopped, refused,
        tuple(notes), search.x, float(used["cpu_s"].sum()),
    )  # fmt: skip


def document(result: Sequential) -> dict[str, Any]:
    """The result as plain values."""
    return {
        "method": "sequential", "stopped": result.stopped, "refused": result.refused, "notes": list(result.notes),
        "runs": result.runs, "runs_to_map": result.map_runs, "runs_by_stage": result.stages, "failed": result.failed,
        "cpu_s": result.cpu_s if np.isfinite(result.cpu_s) else None,
        "chi2": result.misfit, "targets": len(result.targets.names), "posterior": result.table,
        "emulator_change_sd": dict(zip(result.box.names, result.change.tolist(), strict=True)),
        "modes": [dict(zip(result.box.names, row, strict=True)) for row in result.minima.tolist()],
        "box_not_ruled_out_elsewhere": result.sweep.elsewhere, "converged": result.chain.converged,
        "samples": len(result.chain.flat()), "fit": result.fit, "held_out": result.held_out,
    }  # fmt: skip
