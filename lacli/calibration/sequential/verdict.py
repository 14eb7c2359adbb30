"""Whether the answer is one: the misfit of the best run, targets that no parameter reaches, inputs not learnt."""

from __future__ import annotations

import numpy as np
from scipy.stats import chi2, qmc

from lacli.calibration.sequential.emulator import Components
from lacli.calibration.sequential.evidence import Evidence, factor
from lacli.contracts.targets import Targets

_REJECTED = 1e-4  # of a chi-square in the targets less the inputs: a misfit as improbable is no answer
_REACH, _SWEEP = 3.0, 1 << 12  # standard deviations within which a target is reached, somewhere of so many points


def verdict(evidence: Evidence, components: Components, targets: Targets, misfit: float, freedom: int, best: int) -> str:
    """Why the answer is none, in words; '' where it is one. ``components``: the emulator of all runs over the box; best: the row
    of the run whose misfit it is."""
    if misfit <= float(chi2.isf(_REJECTED, freedom)):
        return ""
    off = f"chi^2 is {misfit:.0f} where {freedom} is expected"
    # each target alone, in its own sds: residuals taken back from L and from the components' axes
    alone = (factor(targets) / targets.sd[:, None]) @ components.rotation[: evidence.targets]
    z = qmc.Sobol(components.z.shape[1], rng=np.random.default_rng(0)).random(_SWEEP)
    mean, variance = components.predict(np.vstack([z, evidence.z]))
    least = np.maximum(np.abs(mean @ alone.T) - _REACH * np.sqrt(variance @ (alone**2).T), 0.0).min(0)
    if (out := np.flatnonzero(least > _REACH)).size:
        names = ", ".join(targets.names[j] for j in out[:5])
        return (
            f"{off}: nowhere in the box does the model come within {_REACH:g} standard deviations of {names}. "
            "No parameter reaches these targets: check their units and standard deviations, or widen the box."
        )
    told = (evidence.residual[best, : evidence.targets] @ factor(targets).T) / targets.sd
    worst = np.argsort(-np.abs(told))[:3]
    names = ", ".join(f"{targets.names[j]} ({told[j]:+.1f} sd)" for j in worst)
    return (
        f"{off}: the targets contradict each other or the model. Farthest from the best run: {names}. "
        "The posterior beside it is too narrow to be believed."
    )


def unlearned(table: list[dict[str, float | str]]) -> list[str]:
    """Inputs whose posterior is as wide as the prior, by the rows of ``posterior.summary``."""
    names = [str(row["input"]) for row in table if float(row["contraction"]) < 0.1]
    return [f"{', '.join(names)}: the posterior is as wide as the prior; the targets tell nothing of it."] if names else []
