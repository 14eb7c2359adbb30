"""Calibration that seeks the posterior: Gauss-Newton to the most probable point, runs where the emulated posterior is until the
emulator's error no longer moves it, sampling, and a check of the whole box.

Every run is in the log; what is run next follows from the runs there are and the seed: started again after an interruption, the
calibration goes the same way, finding its runs done.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
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
from lacli.calibration.sequential.descent import Incumbent
from lacli.calibration.sequential.draw.chain import sample
from lacli.calibration.sequential.draw.draws import LEAST_EFFECTIVE, draw
from lacli.calibration.sequential.draw.information import Forecast, forecast
from lacli.calibration.sequential.emulator import Components, Part
from lacli.calibration.sequential.evidence import Evidence
from lacli.calibration.sequential.fidelity.bridge import PAIR, bridge
from lacli.calibration.sequential.fidelity.corrected import emulate
from lacli.calibration.sequential.laplace import Laplace
from lacli.calibration.sequential.result import Sequential, document, result_of
from lacli.calibration.sequential.search import Monitor, Reference, Search, Settings
from lacli.contracts.identity import Identity, identify, write_identity
from lacli.contracts.targets import Targets
from lacli.inference.box import Box
from lacli.inference.runs import RunLog, Simulator
from lacli.inference.sampling import posterior as mcmc

FILE, RESULT = "calibration.json", "result.json"
_MODE = 25.0  # excess of chi^2 up to which a second minimum has a share in the posterior
_LOCAL = 12.0  # Mahalanobis distance up to which a run takes part in the local emulator
_DESCENT_ROUNDS = 24
_LEAST_OF_REFERENCE = 3  # of its runs, before it is believed what they correct
_BUDGETS = ("max_runs", "reference_runs", "share", "correction_share", "mcmc")
PARTS: tuple[Part, Part] = ("emulator", "correction")
_AT_ONCE = 3  # runs of the check of the box between two looks
_LEAST_BUDGET = 4  # runs of the reference without which there is no correction to rely on
LAST = "at the most probable point"


@dataclass(frozen=True)
class _Found:
    """A posterior and the check of the box, of the same targets: modes known, emulators around them and of the whole box."""

    evidence: Evidence
    targets: Targets
    known: list[Laplace]
    local: Components
    whole: Components
    chain: mcmc.Chain
    moved: FloatArray
    swept: modes.Sweep
    stopped: str


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
    first: FloatArray | None = None,
    reference: Reference | None = None,
) -> Sequential:
    """Calibrate against the targets; ``log`` holds the runs, which must tell derivatives; ``notes`` go into the result. first
    (k, d): inputs to start from in place of points over the box (k >= 4), such as those of runs there are. reference: the
    simulations that the answer is of, where ``simulator`` is a cheap companion of theirs: few of its runs correct the others.

    Raises LacliError where runs tell none or too few finish, UsageError where the folder holds another calibration.
    """
    if settings.starts < 4 or settings.max_runs < settings.starts + 2 * box.d:
        raise UsageError(f"calibrate: at least 4 starts and {4 + 2 * box.d} runs are needed (--max-runs).")
    if len(targets.names) < 1:
        raise UsageError("calibrate: no targets.")
    if reference is not None and settings.reference_runs < _LEAST_BUDGET:
        raise UsageError(f"calibrate: at least {_LEAST_BUDGET} runs of the reference are needed (--reference-runs).")
    folder.mkdir(parents=True, exist_ok=True)
    identity = sequential_identity(box, targets, settings, log.identity, None if reference is None else reference.log.identity)
    if words := obstacle(folder, identity):
        raise UsageError(f"{folder} {words}. Choose another --out.")
    write_identity(folder / FILE, identity)
    search = Search(simulator, box, targets, settings, log, monitor, reference)
    search.notes.extend(notes)
    evidence = _start(search, None if first is None else search.scale.to_z(first))
    evidence, components = _descend(search, evidence)
    if reference is not None:
        evidence, components = bridge(search, evidence), None
    map_runs = len(search.x) + len(search.dear)
    evidence = search.infer_errors(evidence)
    if search.error_factor is not None and search.error_factor.value > 1.0:
        components = None  # they are of residuals in other standard deviations
    known = [_best(evidence)]
    evidence, known, components, _ = _other_modes(search, evidence, known, components, "other starts", settings.mode_runs // 2)
    found = _concluded(search, evidence, known, components, folder, settings.mode_runs // 2)
    answer, misfit = descent.lowest(found.local, found.evidence.z[int(np.argmin(found.evidence.misfit))])
    evidence = found.evidence
    if reference is None:
        evidence = search.run(answer[None], LAST)
    elif evidence.misfit[evidence.own].min() - misfit > descent.SETTLED:
        evidence = search.refer(answer[None], LAST)
    if search.targets.names != found.targets.names:  # that run told of a frame that its states are several: without it once more
        found = _concluded(search, evidence, found.known, None, folder, 0)
        evidence = found.evidence
    result = result_of(
        search, evidence, found.known, found.local, found.whole, found.chain, found.moved, found.swept, map_runs, found.stopped
    )
    write_json(folder / RESULT, {"identity": identity.digest, **document(result)})
    return result


@single_threaded
def forecast_sequentially(
    simulator: Simulator,
    box: Box,
    targets: Targets,
    settings: Settings,
    folder: Path,
    log: RunLog,
    monitor: Monitor = lambda status: None,
    reference: Reference | None = None,
) -> Forecast:
    """What the targets can teach, from the runs that the calibration begins with (they are in the log for it); reference: that
    of the calibration, of which nothing is run.

    Raises as ``calibrate_sequentially``.
    """
    folder.mkdir(parents=True, exist_ok=True)
    identity = sequential_identity(box, targets, settings, log.identity, None if reference is None else reference.log.identity)
    write_identity(folder / FILE, identity)
    search = Search(simulator, box, targets, settings, log, monitor)
    _start(search, None)
    return forecast(log, search.x, search.targets, search.scale)


def sequential_identity(box: Box, targets: Targets, settings: Settings, runs: Any, reference: Any = None) -> Identity:
    """What determines the calibration: box, targets, settings but for budgets, its runs, and those of the reference if the runs
    are cheap ones."""
    chosen = {k: v for k, v in asdict(settings).items() if k not in _BUDGETS}
    sampling = {k: v for k, v in asdict(settings.mcmc).items() if k not in mcmc.STOPPING}
    dear = {} if reference is None else {"reference": reference}
    return identify(
        "calibration", way="sequential", runs=runs, box=box, targets=targets, settings=chosen, sampling=sampling, **dear
    )


def _start(search: Search, first: FloatArray | None) -> Evidence:
    """The middle of the box and low-discrepancy points, or those given; more while fewer than two finish with derivatives."""
    d = search.box.d
    if first is not None:
        search.run(first, "given")
    sobol = qmc.Sobol(d, rng=np.random.default_rng(search.settings.seed)).random(64)
    z = np.vstack([np.full((1, d), 0.5), 0.1 + 0.8 * sobol])
    evidence = search.run(z[: search.settings.starts if first is None else 0], "starts")
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


def _descend(search: Search, evidence: Evidence) -> tuple[Evidence, Components | None]:
    incumbents = [Incumbent(z) for z in evidence.z[evidence.told]]
    components = descent.emulate(evidence, None)
    # a correction needs cheap runs beside those of the reference
    kept = 0 if search.reference is None else _LEAST_BUDGET
    for _ in range(_DESCENT_ROUNDS):
        tried = descent.trials(evidence, incumbents, components)
        if not tried:
            return evidence, components
        tried = tried[: max(0, search.left - kept)]
        if not tried:
            break
        before = len(search.x)
        evidence = search.run(np.array([trial.z for trial in tried]), "to the most probable point")
        incumbents = descent.advance(evidence, descent.kept(evidence, incumbents), tried)
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
    search: Search,
    evidence: Evidence,
    known: list[Laplace],
    components: Components | None,
    stage: str,
    budget: int,
    rule_out: bool = False,
) -> tuple[Evidence, list[Laplace], Components, modes.Sweep]:
    """Run where another mode may be, until nothing is left or the budget is used; modes found are added. rule_out: also where the
    box is not ruled out, though nothing speaks for it."""
    known = list(known)
    used = 0
    while True:
        search.say("emulators")
        components = emulate(evidence, components)
        found = modes.sweep(components, known, float(evidence.misfit.min()), search.settings.seed)
        count = min(_AT_ONCE, budget - used, search.left - 1)
        where = found.candidates if len(found.candidates) or not rule_out or found.settled else found.doubtful
        if not len(where) or count <= 0:
            return evidence, known, components, found
        before, dear = len(search.x), len(search.dear)
        evidence = _looked_at(search, evidence, where[:count], stage, bool(len(found.candidates)))
        if len(search.x) == before and len(search.dear) == dear:
            return evidence, known, components, found
        used += len(search.x) - before
        components = emulate(evidence, components)
        for z in where[:count]:
            if _another(evidence, components, known, z) and search.dear_left > 1 and not evidence.own[descent.at(evidence, z)]:
                evidence = search.refer(z[None], stage)  # of a valley the answer is of, the reference must have its say
                components = emulate(evidence, components)
            if _another(evidence, components, known, z):
                row = descent.at(evidence, z)
                known.append(Laplace.at(evidence.z[row], evidence.residual[row], evidence.jacobian[row]))


def _looked_at(search: Search, evidence: Evidence, where: FloatArray, stage: str, valleys: bool) -> Evidence:
    """The points run; of valleys that come again beside a cheap run, what is not known is the correction: the reference there."""
    again = np.array([np.abs(evidence.z - z).max(1).min() < modes.APART for z in where])
    again &= valleys and search.dear_left > 1
    if not again.all():
        evidence = search.run(where[~again], stage)
    return search.refer(where[again][: min(PAIR, search.dear_left - 1)], stage) if again.any() else evidence


def _another(evidence: Evidence, components: Components, known: list[Laplace], z: FloatArray) -> bool:
    """Whether the run at z tells a valley that is as good as the best and not known."""
    row = descent.at(evidence, z)
    ran = np.abs(evidence.z[row] - z).max() < 1e-6 and evidence.told[row]
    as_good = evidence.misfit[row] < evidence.misfit.min() + _MODE
    return bool(ran and as_good and modes.same_valley(components, known, evidence.z[row]) is not None)


def _concluded(
    search: Search,
    evidence: Evidence,
    known: list[Laplace],
    components: Components | None,
    folder: Path,
    budget: int,
) -> _Found:
    """The posterior, and the check of the box by up to so many runs; again where that finds a mode, or that the states of a frame
    are several: what is told of all must be of the same targets."""
    while True:
        before = search.targets.names
        chain, evidence, moved, local, stopped = _refine(search, evidence, known, folder)
        held = search.targets
        if held.names != before:
            known = _renewed(evidence, known)
        evidence, after, whole, swept = _other_modes(
            search, evidence, known, components, "check of the box", budget, rule_out=True
        )
        if len(after) == len(known) and search.targets.names == held.names:
            return _Found(evidence, held, known, local, whole, chain, moved, swept, stopped)
        known, components, budget = _renewed(evidence, after), None, 0


def _renewed(evidence: Evidence, known: list[Laplace]) -> list[Laplace]:
    """The modes at the best runs near each: what is held against the targets may have changed."""
    told = np.flatnonzero(evidence.told)
    nearest = np.argmin([mode.distance(evidence.z[told]) for mode in known], axis=0)
    best = [told[rows][int(np.argmin(evidence.misfit[told[rows]]))] for k in range(len(known)) if (rows := nearest == k).any()]
    return [Laplace.at(evidence.z[row], evidence.residual[row], evidence.jacobian[row]) for row in best]


def _local(search: Search, evidence: Evidence, known: list[Laplace]) -> Evidence:
    """The runs that the local emulator learns from."""
    distance = np.min([mode.distance(evidence.z) for mode in known], axis=0)
    wanted = max(int((distance < _LOCAL).sum()), min(len(distance), search.box.d + 6))
    return evidence.take(np.sort(np.argsort(distance)[:wanted]).tolist())


def _refine(
    search: Search, evidence: Evidence, known: list[Laplace], folder: Path
) -> tuple[mcmc.Chain, Evidence, FloatArray, Components, str]:
    """Run where the emulator's error matters to the posterior, until that is small beside it; then sample."""
    settings = search.settings
    components: Components | None = None
    reserve = 1 + (settings.mode_runs // 2 if search.left > settings.mode_runs else 0)  # for the box, and for the answer
    round_ = 0
    while True:
        round_ += 1
        search.say("posterior")
        known = _renewed(evidence, known)
        near = _local(search, evidence, known)
        components = emulate(near, components)
        rng = np.random.default_rng([settings.seed, 2, round_])
        points, effective = draw(components, search.scale, known, settings.seed + round_)
        moved = change.expected_change(components, points, rng)
        of_runs, of_correction, enough = moved, np.zeros(1), True
        if search.reference is not None:
            of_runs, of_correction = (change.expected_change(components, points, rng, part) for part in PARTS)
            enough = int(evidence.own.sum()) >= _LEAST_OF_REFERENCE and of_correction.max() < settings.correction_share
        if of_runs.max() < settings.share and effective > LEAST_EFFECTIVE and enough:
            stopped = f"the emulator's error moves the posterior's mean by less than {settings.share:g} of its sd in every input"
            if search.reference is not None:
                stopped += f", the correction's by less than {settings.correction_share:g}"
            break
        before = len(search.x) + len(search.dear)
        # each part of the error by the runs that lessen it; each of the reference takes a cheap one beside it
        dear = max(0, min(0 if enough else PAIR, search.dear_left - 1, search.left - reserve))
        count = min(settings.first_runs if round_ == 1 else settings.batch, search.left - reserve - dear)
        if round_ > 1 and of_runs.max() < settings.share and effective > LEAST_EFFECTIVE:
            count = 0
        if max(count, dear) <= 0:
            stopped = f"{settings.max_runs} runs were allowed"
            if search.reference is not None:
                stopped += f", {settings.reference_runs} of the reference"
            worst = int(np.argmax(moved))
            short = search.left <= reserve or of_runs.max() > of_correction.max()
            more = "--max-runs" if short else "--reference-runs"
            search.notes.append(
                f"the emulator's error may still move the mean of {search.box.names[worst]} by {moved[worst]:.2f} of its sd "
                f"(asked: {settings.share:g}); more runs ({more}) would settle it."
            )
            break
        if count > 0:
            evidence = search.run(change.most_telling(components, points, count, rng), "where the emulator matters")
        if dear > 0:
            where = change.most_telling(components, points, dear, rng, "correction")
            evidence = search.refer(where, "where the correction matters")
        if len(search.x) + len(search.dear) == before:
            stopped = "no further run would tell more"
            break
    search.say("sampling")
    chain = sample(
        components, search.scale, replace(settings.mcmc, seed=settings.seed), search.scale.to_x(points), folder / "chain.npz"
    )
    return chain, evidence, moved, components, stopped
