"""Where the simulator fails: learnt from runs that did, so that new ones are not wasted there."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lacli.base.arrays import FloatArray
from lacli.inference.box import Box
from lacli.inference.design import farthest

# fewer failures than this teach nothing about where they are
FEWEST_FAILURES = 3
# the cost grows as the cube of the runs: beyond these, runs spread over the box stand for all
_MOST_RUNS = 600


@dataclass(frozen=True)
class Feasibility:
    """Probability of a finished run by a Gaussian-process classifier (scikit-learn) on the unit cube.

    failed, runs: how many there were; used: how many it has learnt from.
    """

    box: Box
    classifier: Any
    failed: int
    runs: int
    used: int

    def probability(self, x: FloatArray) -> FloatArray:
        """Probability (m,) that a run at x (m, d) ends well."""
        return np.concatenate(
            [self.classifier.predict_proba(self.box.to_unit(part))[:, 1] for part in np.array_split(x, len(x) // 2000 + 1)]
        )

    def accept(self, x: FloatArray) -> NDArray[np.bool_]:
        """Whether a run at x (m, d) is worth trying: more likely to end than not."""
        return self.probability(x) > 0.5

    def describe(self) -> str:
        """What was learnt, in a sentence: the inputs whose values differ most between failed and finished runs."""
        part = f" (learnt from {self.used} of them, spread over the box)" if self.used < self.runs else ""
        return f"{self.failed} of {self.runs} runs failed{part}; new points are kept where a run is more likely to end than not."


def learn(box: Box, finished: FloatArray, failed: FloatArray) -> Feasibility | None:
    """A model from inputs of finished (n, d) and failed (f, d) runs; None where there is too little to learn from.

    Of more than 600 runs, those are used that are spread farthest over the box, of either kind at least as many as half of that.
    """
    if len(failed) < FEWEST_FAILURES or not len(finished):
        return None
    from sklearn.gaussian_process import GaussianProcessClassifier
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel

    good, bad = box.to_unit(finished), box.to_unit(failed)
    most = [max(_MOST_RUNS // 2, _MOST_RUNS - len(other)) for other in (bad, good)]
    good, bad = (u if len(u) <= m else u[farthest(u, m)] for u, m in zip((good, bad), most, strict=True))
    x = np.vstack([good, bad])
    y = np.r_[np.ones(len(good), int), np.zeros(len(bad), int)]
    kernel = ConstantKernel(10.0, (0.1, 1e3)) * RBF(0.5 * np.sqrt(box.d), (0.1, 20.0))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a length at its bound is no concern here
        classifier = GaussianProcessClassifier(kernel, random_state=0).fit(x, y)
    return Feasibility(box, classifier, len(failed), len(finished) + len(failed), len(x))
