"""What the correction of a cycle's drift adds to the errors of its frames.

Where the last frame is end-diastole again, what is left there, e_last, is spread over the cycle: a frame at time t errs by
e_t - t e_last, which has more variance than e_t, and goes along with all others.
"""

from __future__ import annotations

import numpy as np

from lacli.base.arrays import FloatArray


def frame_errors(times: FloatArray, closed: bool) -> tuple[FloatArray, FloatArray]:
    """Of frames at times (f,): the weight (f,) with which each has the error that all registrations share, and the covariance
    (f, f) of what is each one's own, both of variance 1 before the correction; ``closed``: whether the drift was corrected."""
    if not closed:
        return np.ones(len(times)), np.eye(len(times))
    return 1.0 - times, np.eye(len(times)) + np.outer(times, times)


def widened(at: FloatArray, closed: bool) -> FloatArray:
    """By how much the correction widens a standard deviation at times (m,), if nothing is shared: the most that it can."""
    return np.sqrt(1.0 + np.square(at)) if closed else np.ones_like(at)
