"""From the most probable point of cheap runs to that of the reference: its first runs, each where those before say it lies."""

from __future__ import annotations

import numpy as np

from lacli.base.arrays import FloatArray
from lacli.base.errors import LacliError
from lacli.calibration.sequential import descent
from lacli.calibration.sequential.evidence import Evidence
from lacli.calibration.sequential.fidelity.corrected import emulate
from lacli.calibration.sequential.fidelity.correction import LEAST
from lacli.calibration.sequential.laplace import Laplace
from lacli.calibration.sequential.search import Search

STAGE = "correction"
_TRIES, _STEPS = 4, 4
PAIR = 2  # runs of the reference at a time, which two workers make in the time of one


def bridge(search: Search, evidence: Evidence) -> Evidence:
    """The evidence of all runs, corrected. Raises LacliError where too few runs of the reference finish with derivatives."""
    row = evidence.best
    there = Laplace.at(evidence.z[row], evidence.residual[row], evidence.jacobian[row])
    rng = np.random.default_rng([search.settings.seed, 3])
    first = [evidence.z[row], *there.draw(_TRIES, 1.0, rng)]
    for count in (LEAST, *[1] * (_TRIES - 1)):
        if evidence.correction is None:
            evidence = search.refer(np.array(first[:count]), STAGE)
            first = first[count:]
    if evidence.correction is None:
        frame = search.told.frame(search.dear) if len(search.dear) else None
        said = "none was made" if frame is None else ", ".join(sorted({str(s) for s in frame["status"]}))
        raise LacliError(
            f"calibrate: {len(search.dear)} runs of the reference at the cheap runs' most probable point give no correction "
            f"({said}): fewer than {LEAST} finished with derivatives{', on one branch' if search.strays + search.torn else ''}. "
            f"Look at {search.told.path}, or let all runs be the scene's own (--cheap none)."
        )
    for _ in range(_STEPS):
        own = np.flatnonzero(evidence.own & evidence.told)
        best = own[int(np.argmin(evidence.misfit[own]))]
        components = emulate(evidence)
        z, misfit = min((descent.lowest(components, evidence.z[row]) for row in own), key=lambda found: found[1])
        if evidence.misfit[best] - misfit < descent.SETTLED or search.dear_left <= 2:
            break
        # beside it a draw of the posterior around, which tells the correction's slope
        evidence = search.refer(np.vstack([z, _around(evidence, z, PAIR - 1, rng)]), STAGE)
    return evidence


def _around(evidence: Evidence, z: FloatArray, count: int, rng: np.random.Generator) -> FloatArray:
    """(count, d): draws of the Gaussian posterior at z, as the reference's run nearest to it tells it."""
    own = np.flatnonzero(evidence.own & evidence.told)
    row = own[int(np.argmin(np.linalg.norm(evidence.z[own] - z, axis=1)))]
    near = Laplace.at(z, evidence.residual[row], evidence.jacobian[row])
    return Laplace(z, near.precision).draw(count, 1.0, rng)
