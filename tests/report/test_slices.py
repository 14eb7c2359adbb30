"""Slices of a CT stand as they are read, the front above and the left on the right; the page says what its means are of."""

from __future__ import annotations

from importlib.resources import files

import numpy as np
import pytest

from lacli.report.segmentation_figures import turned

LEFT, BACK, HEAD = np.eye(3)  # along which coordinates grow


@pytest.mark.parametrize(
    ("right", "up", "expected"),
    [
        # axial: rows of the image go to the back, which is below; drawn from below they were upside down
        (LEFT, BACK, (False, True)),
        (-LEFT, -BACK, (True, False)),
        # coronal and sagittal: the head is above
        (LEFT, HEAD, (False, False)),
        (BACK, HEAD, (False, False)),
        (BACK, -HEAD, (False, True)),
        # a grid that is a little askew
        (np.array([0.99, 0.1, 0.0]), np.array([-0.1, 0.99, 0.05]), (False, True)),
    ],
)
def test_the_front_is_above_and_the_left_on_the_right(right: np.ndarray, up: np.ndarray, expected: tuple[bool, bool]) -> None:
    assert turned(right, up) == expected


def test_the_viewer_s_means_are_of_what_it_draws() -> None:
    """Tables have means over the endocardium, by area; these are over the outer surface's points."""
    text = files("lacli.report.page").joinpath("viewer.js").read_text(encoding="utf-8")
    assert "(mean over the points drawn)" in text
