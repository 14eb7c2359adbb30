"""A tracked motion between its frames, with its errors."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from lacli.motion.errors.courses import course

TIME = np.arange(10) / 10


def test_a_course_goes_through_its_frames_and_its_error_opens_from_end_diastole() -> None:
    moved = 4.0 * np.sin(np.pi * TIME) ** 2
    frame = pd.DataFrame({"time": TIME, "d_roof_mm": moved, "volume_ml": 100.0 + moved})
    info = {"sd": {"d_roof_mm": 0.3, "volume_ml": 2.0}, "shrinkage": {"d": {"share": -0.03, "sd": 0.1}}}
    at = np.array([0.0, 0.05, 0.3, 0.55, 0.95])
    value, sd = course(frame, info, "d_roof_mm", at)
    assert value == pytest.approx(4.0 * np.sin(np.pi * at) ** 2, abs=5e-3), "periodic between the last frame and the first"
    # half way to the first frame half of the error; what registration may have lost is a tenth of the motion, of 97 % of it
    whole = np.hypot(0.3, 0.1 * value) / 0.97
    assert sd == pytest.approx(whole * [0.0, 0.5, 1.0, 1.0, 0.5])
    assert course(frame, info, "volume_ml", at)[1] == pytest.approx(np.full(5, 2.0)), "a volume errs at end-diastole too"
