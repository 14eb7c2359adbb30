"""A wall of less than two blurs' width is measured where half-maximum widths and counts are not."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter1d

from lacli.anatomy.segmentation import slab

FINE = 0.01


def blurred(steps: list[tuple[float, float]], last: float, blur: float) -> np.ndarray:
    """HU at slab.places() of tissues (up to where, HU) in a row and ``last`` after them, blurred on a fine line: no formula."""
    line = np.arange(-12.0, 20.0, FINE)
    hu = np.full(len(line), last)
    for end, value in reversed(steps):
        hu[line < end] = value
    return np.interp(slab.places(), line, gaussian_filter1d(hu, blur / FINE))


def fitted(profiles: np.ndarray, blur: float) -> tuple[slab.Slabs, slab.Slabs]:
    s = slab.places()
    guess = slab.first_guess(s, profiles, 350.0, 100.0)
    return guess, slab.fit(s, profiles, guess, 100.0, blur)


@pytest.mark.parametrize("thickness", [1.0, 1.5, 2.0, 4.0])
@pytest.mark.parametrize("outside", [-60.0, -100.0, -800.0])
def test_thickness_of_a_blurred_wall(thickness: float, outside: float) -> None:
    profile = blurred([(0.3, 350.0), (0.3 + thickness, 100.0)], outside, 0.55)[None]
    _, found = fitted(profile, 0.55)
    assert found.thickness[0] == pytest.approx(thickness, abs=0.02)
    assert found.edge[0] == pytest.approx(0.3, abs=0.02)
    assert found.outside[0] == pytest.approx(outside, abs=5.0)


def test_half_maximum_is_off_where_the_slab_is_not() -> None:
    """At .8 mm and a blur of .55 mm the wall never reaches its own HU: the half-maximum edges are more than .1 mm off."""
    guess, found = fitted(blurred([(0.0, 350.0), (0.8, 100.0)], -60.0, 0.55)[None], 0.55)
    assert abs(guess.thickness[0] - 0.8) > 0.1
    assert abs(found.thickness[0] - 0.8) < 0.02


def test_what_lies_farther_out_does_not_matter() -> None:
    """Fat of 3 mm, then another chamber's blood: the same thickness as with fat for ever."""
    _, found = fitted(blurred([(0.0, 350.0), (2.0, 100.0), (5.0, -100.0)], 350.0, 0.55)[None], 0.55)
    assert found.thickness[0] == pytest.approx(2.0, abs=0.03)


def test_the_blur_is_found() -> None:
    profiles = np.array([blurred([(0.0, 350.0), (t, 100.0)], -60.0, 0.6) for t in np.linspace(1.5, 3.0, 12)])
    s = slab.places()
    guess = slab.first_guess(s, profiles, 350.0, 100.0)
    assert slab.blur_of(s, profiles, guess, 100.0, np.ones(12, dtype=bool)) == pytest.approx(0.6, abs=0.05)


def test_noise_becomes_the_stated_error() -> None:
    """Independent noise of 10 HU: the thicknesses spread as 10 HU over the slope says, and are right in the mean."""
    rng = np.random.default_rng(3)
    profile = blurred([(0.0, 350.0), (1.5, 100.0)], -60.0, 0.55)
    _, found = fitted(profile + rng.normal(0.0, 10.0, (400, len(profile))), 0.55)
    stated = 10.0 / float(np.median(found.slope))
    assert found.thickness.std() == pytest.approx(stated, rel=0.25)
    assert abs(found.thickness.mean() - 1.5) < 3.0 * stated / np.sqrt(400) + 0.02


@settings(max_examples=40, deadline=None)
@given(st.lists(st.floats(-1000.0, 1500.0), min_size=4, max_size=4), st.floats(0.2, 1.5))
def test_any_profile_gives_finite_numbers_in_range(levels: list[float], blur: float) -> None:
    s = slab.places()
    profile = np.interp(s, np.linspace(s[0], s[-1], 4), levels)[None]
    guess = slab.first_guess(s, profile, 350.0, 100.0)
    found = slab.fit(s, profile, guess, 100.0, blur)
    for value in (found.edge, found.thickness, found.blood, found.outside, found.misfit, found.slope):
        assert np.isfinite(value).all()
    assert slab.LEAST_MM <= found.thickness[0] <= slab.MOST_MM
