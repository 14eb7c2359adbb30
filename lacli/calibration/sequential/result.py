"""What a calibration that sought the posterior found, and what a user must know of it."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from lacli.base.arrays import FloatArray
from lacli.calibration.sequential import branches, modes
from lacli.calibration.sequential.draw.information import by_group
from lacli.calibration.sequential.emulator import Components
from lacli.calibration.sequential.evidence import Evidence, factor
from lacli.calibration.sequential.fidelity.error_factor import ErrorFactor
from lacli.calibration.sequential.laplace import Laplace
from lacli.calibration.sequential.outputs import Features
from lacli.calibration.sequential.search import Search
from lacli.calibration.sequential.verdict import unlearned, verdict
from lacli.contracts.targets import Targets
from lacli.inference.box import Box
from lacli.inference.sampling import posterior as mcmc

_LARGER = 1.2  # times the stated errors: below it nothing is said


@dataclass(frozen=True)
class Correcting:
    """runs of the reference, CPU seconds of them and of the cheap ones; rho; by target: what is added to the cheap features at
    the most probable point, in standard deviations of the target's error, and how surely."""

    runs: int
    cpu_s: float
    cheap_cpu_s: float
    rho: float
    added_sd: dict[str, float]
    error_sd: dict[str, float]

    def words(self) -> str:
        """What a user must know of it."""
        name = max(self.added_sd, key=lambda key: abs(self.added_sd[key]))
        return (
            f"{self.runs} runs of the scene's own numerics correct the cheap ones: at the most probable point by up to "
            f"{abs(self.added_sd[name]):.1f} standard deviations of a target's error ({name}), which the correction tells within "
            f"{max(self.error_sd.values()):.2f}."
        )


@dataclass(frozen=True)
class Sequential:
    """The result. map_x (d,) and its chi^2; runs by stage, ``map_runs`` until the most probable point was found; table: summary
    by input; change (d,): how far the emulator's error may still move the posterior's mean, in its sds; minima
    (k, d): the modes found, the best first; sweep: what the check of the box says; notes: what a user must know; left_out:
    targets that the runs cannot tell (targets: the others); rmse_mm: of the displacements at the most probable point, None
    where no target is one; information: by group of targets, what it told at the best run; scores: by target, R2 and ISE of the
    local emulator at runs left out; error_factor: of the errors added to the targets', None where none were."""

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
    left_out: tuple[str, ...]
    rmse_mm: float | None
    information: list[dict[str, float | str]]
    scores: dict[str, dict[str, float]]
    fidelity: Correcting | None = None
    error_factor: ErrorFactor | None = None

    @property
    def runs(self) -> int:
        """All runs asked for."""
        return len(self.x) + (self.fidelity.runs if self.fidelity else 0)


def result_of(
    search: Search,
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
    """The result, with its verdict and notes."""
    box, targets = search.box, search.targets
    # the run at the answer, but for the emulator's error there
    row = int(np.argmin(np.where(evidence.own, evidence.misfit, np.inf)))
    misfit, map_x = float(evidence.chi2[row]), evidence.x[row]
    told = evidence.best
    by_z = factor(targets) @ evidence.jacobian[told, : evidence.targets]  # where it tells none itself, as corrected
    slopes = by_z / search.scale.slope(evidence.x[told][None])
    frame = search.told.frame(evidence.x[row][None])
    nearest = frame[list(targets.names)].to_numpy(float)[0]
    features = Features(local, search.scale, targets, targets.names)
    mean, variance = features.predict(map_x[None])
    scores = {
        name: {"r2": float(r2), "ise": float(ise)}
        for name, r2, ise in zip(targets.names, *features.left_out(), strict=True)
        if np.isfinite(r2)
    }
    fitted: list[dict[str, float | str]] = [
        {
            "feature": name, "target": float(t), "sd": float(s), "own_sd": float(o), "emulated": float(e),
            "emulator_sd": float(np.sqrt(v)), "simulated": float(y), "misfit_sd": float((y - t) / s),
        }
        for name, t, s, o, e, v, y in zip(
            targets.names, targets.mean, targets.sd, targets.own_sd, mean[0], variance[0], nearest, strict=True
        )
    ]  # fmt: skip
    lengths = [name.partition("@")[0].endswith("_mm") for name in targets.names]
    rmse = float(np.sqrt(np.mean((nearest - targets.mean)[lengths] ** 2))) if any(lengths) else None
    freedom = max(1, len(targets.names) - box.d)
    refused = verdict(evidence, whole, targets, misfit, freedom, row)
    notes = list(dict.fromkeys(search.notes))
    fidelity = _correcting(search, evidence, map_x)
    if fidelity is not None:
        notes.append(fidelity.words())
    notes.append(swept.words())
    if (larger := search.error_factor) is not None and larger.value > _LARGER:
        notes.append(
            "the best run's misfit is what errors of the model (of discretisation, and discrepancies stated) "
            f"{larger.value:.1f} times as large as stated would leave (95 %: {larger.low:.1f} - {larger.high:.1f}): they were "
            "taken for so large, and the posterior is wider for it. Finer numerics (quadratic cells) would tell more."
        )
    table = mcmc.summary(chain, map_x, box, targets.priors)
    notes += unlearned(table)
    if search.left_out:
        times = sorted({name.partition("@")[2] for name in search.left_out})
        notes.append(
            f"{len(search.left_out)} targets are left out, all of the frames at {', '.join(times)}: runs at all but the same "
            "parameters end in different states there (the end-diastolic wall has unstable modes: it does not hold itself), so "
            "the model says nothing of them."
        )
    if search.strays:
        notes.append(f"{search.strays} runs lie on another branch than their neighbours and are left out.")
    notes += _several(search.torn, evidence.spread[row], targets)
    if local.held_out > 2.0:
        notes.append(
            f"runs left out of the emulator miss it by {np.sqrt(local.held_out):.1f} times what it says of itself; its variance "
            "was widened by that."
        )
    if not chain.converged:
        notes.append("the chain has not converged (R-hat or effective samples are not those asked for).")
    used = search.log.frame(search.x)
    return Sequential(
        box, targets, map_x, misfit, map_runs, dict(search.stages), len(evidence.failed), table,
        moved,
        search.scale.to_x(np.array([mode.centre for mode in known])), swept, chain, fitted, local.held_out, stopped, refused,
        tuple(notes), search.x, float(used["cpu_s"].sum()) + (fidelity.cpu_s if fidelity else 0.0), search.left_out, rmse,
        by_group(targets, slopes, search.box), scores, fidelity, search.error_factor,
    )  # fmt: skip


def _several(torn: int, spread: FloatArray, targets: Targets) -> list[str]:
    """What is said of runs with two equilibria: ``torn`` were left out; spread (p,): of the best run, in the targets' sd."""
    said = []
    if torn:
        said.append(
            f"{torn} runs have two equilibria that are apart by more than a target's standard deviation; they are left out, and "
            "the posterior does not know of them."
        )
    if (most := float(spread.max(initial=0.0))) > branches.APART:
        said.append(
            f"the best run itself has two equilibria, {most:.1f} standard deviations apart in "
            f"{targets.names[int(spread.argmax())]}; it counts with the one of less energy."
        )
    return said


def _correcting(search: Search, evidence: Evidence, x: FloatArray) -> Correcting | None:
    """What the correction does at x (d,)."""
    if (correction := evidence.correction) is None:
        return None
    names = search.targets.names
    own = factor(search.targets) / search.targets.sd[:, None]  # decorrelated -> each target in its own standard deviations
    z = search.scale.to_z(x[None])
    pair = [log.frame(x[None])[list(names)].to_numpy(float)[0] for log in (search.log, search.told)]
    error = np.sqrt(correction.delta.predict(z)[1] @ ((own @ correction.delta.rotation) ** 2).T)[0]
    added = (pair[1] - pair[0]) / search.targets.sd
    cpu = [float(log.frame(at)["cpu_s"].sum()) for log, at in ((search.told, search.dear), (search.log, search.x))]
    return Correcting(
        len(search.dear), cpu[0], cpu[1], correction.rho, dict(zip(names, added.tolist(), strict=True)),
        dict(zip(names, error.tolist(), strict=True)),
    )  # fmt: skip


def document(result: Sequential) -> dict[str, Any]:
    """The result as plain values."""
    return {
        "method": "sequential", "stopped": result.stopped, "refused": result.refused, "notes": list(result.notes),
        "runs": result.runs, "runs_to_map": result.map_runs, "runs_by_stage": result.stages, "failed": result.failed,
        "cpu_s": result.cpu_s if np.isfinite(result.cpu_s) else None,
        "chi2": result.misfit, "targets": len(result.targets.names), "targets_left_out": list(result.left_out),
        "posterior": result.table,
        "information": result.information, "emulators": result.scores,
        "emulator_change_sd": dict(zip(result.box.names, result.change.tolist(), strict=True)),
        "modes": [dict(zip(result.box.names, row, strict=True)) for row in result.minima.tolist()],
        "probability_elsewhere": result.sweep.elsewhere, "box_not_ruled_out": result.sweep.open_,
        "converged": result.chain.converged,
        "samples": len(result.chain.flat()), "acceptance": result.chain.acceptance, "fit": result.fit,
        "fidelity": asdict(result.fidelity) if result.fidelity else None,
        "error_factor": asdict(result.error_factor) if result.error_factor else None,
        "rmse_mm": result.rmse_mm, "held_out": result.held_out,
        "verdict": {"plausible": not result.refused, "warnings": [*filter(None, [result.refused]), *result.notes]},
    }  # fmt: skip
