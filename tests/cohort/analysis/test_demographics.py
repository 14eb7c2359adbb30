"""Who the participants are, over all."""

from __future__ import annotations

import numpy as np
import pandas as pd

from lacli.cohort.analysis.demographics import demographics


def test_numbers_have_mean_spread_and_range_words_are_counted() -> None:
    people = pd.DataFrame({
        "participant_id": ["a", "b", "c"], "age": [60.0, 70.0, np.nan], "sex": ["F", "M", "F"], "af": [1, 0, 1],
        "note": ["x", "y", "z"], "frames": [10, 20, 10],
    })  # fmt: skip
    assert demographics(people, ("participant_id",)) == [
        ("age", "2", "65 ± 7.07", "60 to 70", ""),
        ("sex", "3", "", "", "F: 2, M: 1"),
        ("af", "3", "", "", "1: 2, 0: 1"),
        ("frames", "3", "13.33 ± 5.77", "10 to 20", ""),
    ]
