"""Priors of inputs in a targets file: read, refused, and their densities by hand."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import lognorm, norm

from lacli.base.errors import TableError, UsageError
from lacli.contracts.priors import Prior, check_priors, log_prior, prior_sd, read_prior_file
from lacli.contracts.targets import read_targets, write_targets

TARGET = "[targets.esv_ml]\nmean = 92.0\nsd = 4.6\n"


def read(tmp_path: Path, text: str):
    file = tmp_path / "targets.toml"
    file.write_text(TARGET + text, encoding="utf-8")
    return read_targets(file)


def test_priors_stand_beside_the_targets_and_go_with_a_choice_of_them(tmp_path: Path) -> None:
    text = """
        [priors.edp_mmhg]
        mean = 8.0
        sd = 1.5
        lower = 4.0
        [priors.k]
        distribution = "lognormal"
        mean = 1e-3
        sd = 5e-4
        [priors.pth]
        lower = 0.6
        upper = 0.9
    """
    targets = read(tmp_path, text)
    assert targets.priors == (
        Prior("edp_mmhg", "normal", 8.0, 1.5, 4.0),
        Prior("k", "lognormal", 1e-3, 5e-4),
        targets.priors[2],
    )
    assert (targets.priors[2].distribution, targets.priors[2].lower, targets.priors[2].upper) == ("uniform", 0.6, 0.9)
    assert targets.select(["esv_ml"]).priors == targets.priors
    assert read(tmp_path, "").priors is None


def test_priors_are_written_as_they_are_read(tmp_path: Path) -> None:
    text = "[priors.edp_mmhg]\nmean = 8.0\nsd = 1.5\nlower = 4.0\n[priors.pth]\nlower = 0.6\nupper = 0.9\n"
    first = read(tmp_path, text)
    write_targets(tmp_path / "again.toml", first)
    again = read_targets(tmp_path / "again.toml").priors
    assert first.priors is not None and again is not None
    assert [prior.table() for prior in again] == [prior.table() for prior in first.priors]
    assert again[1].table() == {"distribution": "uniform", "lower": 0.6, "upper": 0.9}
    assert (again[0].mean, again[0].sd, again[0].lower) == (8.0, 1.5, 4.0)


@pytest.mark.parametrize(
    "text, words",
    [
        ("", "no prior in it"),
        ("[priors.a]\nmean = 3.0", "finite number for sd"),
        ("[a]\nmean = 3.0\nsd = 1.0", "a is no table of priors"),
    ],
)
def test_a_file_of_priors_that_is_none_is_one_message(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "p.toml").write_text(text)
    with pytest.raises(TableError, match=words):
        read_prior_file(tmp_path / "p.toml")


@pytest.mark.parametrize(
    "text, words",
    [
        ("[priors.a]\nmean = 3.0", "finite number for sd"),
        ("[priors.a]\nmean = 3.0\nsd = 0.0", "sd must be positive"),
        ("[priors.a]\nmean = 3.0\nsd = nan", "finite number for sd"),
        ("[priors.a]\nmean = -3.0\nsd = 1.0\ndistribution = 'lognormal'", "mean of a lognormal"),
        ("[priors.a]\nlower = 3.0", "finite number for upper"),
        ("[priors.a]\nlower = 3.0\nupper = 2.0", "must be below"),
        ("[priors.a]\nmean = 3.0\nsd = 1.0\ndistribution = 'gamma'", "there are normal, lognormal, uniform"),
        ("[priors.a]\nmean = 3.0\nsd = 1.0\nwidth = 2.0", "key width"),
        ("[priors.a]\nmean = 3.0\nsd = 0.1\nlower = 8.0", "next to nothing"),
        ("[priors]\na = 3.0", "needs a table for each input"),
    ],
)
def test_a_prior_that_is_none_is_one_message(tmp_path: Path, text: str, words: str) -> None:
    with pytest.raises(TableError, match=words):
        read(tmp_path, text)


@given(st.floats(0.1, 50), st.floats(0.05, 2.0))
def test_a_lognormal_prior_has_the_mean_and_sd_it_is_given(mean: float, relative: float) -> None:
    prior = Prior("a", "lognormal", mean, relative * mean)
    spread = np.sqrt(np.log1p(relative**2))
    exact = lognorm(spread, scale=mean * np.exp(-0.5 * spread**2))
    assert (exact.mean(), exact.std()) == pytest.approx((mean, relative * mean))
    x = mean * np.array([0.4, 1.0, 2.2])
    assert np.diff(prior.log_density(x)) == pytest.approx(np.diff(exact.logpdf(x)))
    assert prior.share(0.5 * mean, mean) == pytest.approx(float(np.diff(exact.cdf([0.5 * mean, mean]))[0]), abs=1e-9)


def test_densities_and_widths_within_a_box() -> None:
    """A normal prior far from the ends keeps its sd; one cut at its mean is a half-normal, sd sqrt(1 - 2 / pi); uniform:
    width / sqrt(12)."""
    names, lower, upper = ("a", "b", "c"), np.array([-10.0, 0.0, 0.0]), np.array([10.0, 10.0, 6.0])
    priors = (Prior("a", "normal", 1.0, 0.5), Prior("b", "normal", 0.0, 1.0))
    assert prior_sd(priors, names, lower, upper) == pytest.approx([0.5, np.sqrt(1 - 2 / np.pi), 6 / np.sqrt(12)], rel=1e-3)
    x = np.array([[1.0, 2.0, 3.0], [2.0, 1.0, 5.0]])
    by_hand = norm.logpdf(x[:, 0], 1.0, 0.5) + norm.logpdf(x[:, 1])
    assert np.diff(log_prior(priors, names, x)) == pytest.approx(np.diff(by_hand))
    assert np.isneginf(log_prior((Prior("a", "normal", 1.0, 0.5, upper=1.5),), names, x)).tolist() == [False, True]


def test_priors_that_the_box_does_not_hold_are_refused() -> None:
    box = (("edp_mmhg",), np.array([1.0]), np.array([12.0]))
    check_priors((Prior("edp_mmhg", "normal", 8.0, 1.5),), *box)
    with pytest.raises(UsageError, match="no input of the box"):
        check_priors((Prior("esp_mmhg", "normal", 8.0, 1.5),), *box)
    with pytest.raises(UsageError, match="within the box, 1 to 12"):
        check_priors((Prior("edp_mmhg", "normal", 60.0, 1.5),), *box)  # Pa/133, or a slip of the pen
