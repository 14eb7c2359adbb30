"""Features of a tracked motion between its frames, with what they may err by."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd
from scipy.interpolate import CubicSpline

from lacli.base.arrays import FloatArray
from lacli.motion.errors.drift import widened
from lacli.motion.errors.shrinkage import spread


def course(frame: pd.DataFrame, info: Mapping[str, Any], key: str, at: FloatArray) -> tuple[FloatArray, FloatArray]:
    """A feature of a tracked motion at times (m,) and its standard deviation (m,), in its unit: a periodic cubic through the
    frames. frame, info: of the motion's transients.csv and tracking.json.

    At end-diastole a displacement has no error by definition, so that it grows from there to the first frame.
    """
    time = np.append(frame["time"].to_numpy(float), 1.0)
    value = np.append(frame[key].to_numpy(float), frame[key].iloc[0])
    line = CubicSpline(time, value, bc_type="periodic")(at)
    closed = info.get("closure_mm") is not None
    sd = spread(key, info["sd"][key] * widened(at, closed), line - value[0], info.get("shrinkage"))
    if key != "volume_ml":
        sd = sd * np.clip(np.minimum(at, 1.0 - at) / max(time[1], 1e-3), 0.0, 1.0)
    return np.asarray(line), np.asarray(sd)
