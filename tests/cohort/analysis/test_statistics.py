"""Statistics of a cohort: against other ways to the same number, and against truths that are known."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy import stats as scipy_stats
from scipy.linalg import block_diag

from lacli.base.errors import InputError, LacliError, TableError, UsageError
from lacli.cohort.analysis import journal
from lacli.cohort.analysis.errors_in_variables import _f_of_ratio, _Model, _ratio_of_f, structural_slope
from lacli.cohort.analysis.mixed import MIXED, OTHER_REML, SQUARES, known_error, normal_draws, published, rubin
from lacli.cohort.analysis.observations import Observations, read_observations
from lacli.cohort.analysis.paired import holm, paired_tests
from lacli.cohort.analysis.statistics import statistics

REGIONS = ("anterior", "posterior", "septum", "lateral", "roof")


def cohort(seed: int, beta: float, patients: int = 10, intercept: float = 0.7) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    shape = (patients, len(REGIONS))
    x = rng.normal(0, 0.5, 5) + rng.normal(0, 0.6, (patients, 1)) + rng.normal(0, 0.8, shape)
    y = rng.normal(0, 1, 5) + beta * x + rng.normal(0, intercept, (patients, 1)) + rng.normal(0, 0.7, shape)
    return x, y


def observed(errors: dict[str, np.ndarray] | None = None, **values: np.ndarray) -> Observations:
    patients = next(iter(values.values())).shape[0]
    return Observations(tuple(f"sub-{i}" for i in range(patients)), REGIONS, values, errors or {}, {}, "table")


def tidy(**values: np.ndarray) -> pd.DataFrame:
    patients = next(iter(values.values())).shape[0]
    frame = pd.DataFrame({"participant_id": np.repeat([f"sub-{i}" for i in range(patients)], 5), "region": REGIONS * patients})
    return frame.assign(**{name: grid.ravel() for name, grid in values.items()})


def test_paired_tests_are_scipy_s_with_both_corrections() -> None:
    _, y = cohort(1, 0.5)
    found = paired_tests(observed(d_mm=y), "d_mm")
    assert len(found) == 10
    by_scipy = [scipy_stats.ttest_rel(y[:, REGIONS.index(t.first)], y[:, REGIONS.index(t.second)]) for t in found]
    assert [t.t for t in found] == pytest.approx([s.statistic for s in by_scipy])
    assert [t.p for t in found] == pytest.approx([s.pvalue for s in by_scipy])
    assert all(t.bonferroni == pytest.approx(min(1, 10 * t.p)) and t.p <= t.holm <= t.bonferroni + 1e-15 for t in found)


def test_holm_steps_down() -> None:
    # sorted .01, .02, .04: .01 x 3 = .03, .02 x 2 = .04, .04 x 1 = .04; the order of the table stays
    assert holm(np.array([0.04, 0.01, 0.02])) == pytest.approx([0.04, 0.03, 0.04])


def test_a_difference_without_spread_is_no_test() -> None:
    _, y = cohort(2, 0.0)
    y[:, 1] = y[:, 0] + 1
    found = statistics(observed(d_mm=y), "d_mm", [])
    assert math.isnan(found.pairs[0].p)
    assert math.isnan(found.pairs[0].bonferroni) and math.isnan(found.pairs[0].holm), "and no p of 1"
    assert journal.p_words(found.pairs[0].p) == "-"
    assert any("anterior - posterior" in words for words in found.warnings)


def test_without_error_all_methods_agree() -> None:
    x, y = cohort(3, 0.5)
    fit = published(observed(d_mm=y, x=x), "d_mm", "x")
    none = np.zeros((10, 5, 5))
    exact, intercept, _ = known_error(y, x, none)
    assert exact.estimate == pytest.approx(fit.of("x").estimate, rel=1e-3)
    assert intercept == pytest.approx(fit.intercept_sd, rel=1e-2)
    # generalised least squares at MixedLM's variances: (X' V^-1 X)^-1; MixedLM's own se is of the observed information
    inverse = np.linalg.inv(fit.intercept_sd**2 + fit.residual_sd**2 * np.eye(5))
    design = [np.column_stack([np.eye(5), row]) for row in x]
    information = sum(d.T @ inverse @ d for d in design)
    assert exact.se == pytest.approx(math.sqrt(np.linalg.inv(information)[-1, -1]), rel=1e-3)
    assert exact.se == pytest.approx(fit.of("x").se, rel=0.1)
    # 50 rows - 5 regions - 9 further patients - 1 slope
    assert exact.df == 35
    same = np.tile(y, (60, 1, 1))
    assert rubin(same, x).se == pytest.approx(exact.se, rel=1e-6)


def test_a_quantity_of_the_patient_is_told_by_patients() -> None:
    _, y = cohort(3, 0.5)
    age = np.tile(np.linspace(50, 80, 10)[:, None], 5)
    assert known_error(y, age, np.zeros((10, 5, 5)))[0].df == 8


def test_the_structural_slope_undoes_attenuation_where_there_is_much_data() -> None:
    x, y = cohort(4, 0.5, patients=120)
    w = x + np.random.default_rng(0).normal(0, 0.8, x.shape)
    plain = published(observed(y=y, w=w), "y", "w").of("w")
    found = structural_slope(w, y, np.tile(0.64 * np.eye(5), (120, 1, 1)), np.zeros((120, 5, 5)))
    # the within-patient share of truth is .64 / (.64 + .64), a half
    assert plain.estimate == pytest.approx(0.27, abs=0.04)
    assert found.reliability == pytest.approx(0.5, abs=0.08)
    assert found.beta == pytest.approx(0.5, abs=0.1)
    assert found.low < 0.5 < found.high < found.low + 0.35
    assert found.sigma_e == pytest.approx(0.7, abs=0.1)
    assert found.tau == pytest.approx(0.6, abs=0.1)


def test_what_a_patient_s_regions_err_by_together_takes_no_reliability() -> None:
    # S = .04 I + 4 1 1': of differences between regions the error's variance is .04 ((tr S - 1'S1 / 5) / 4), not 4.04; that of
    # the truth about .64, so that about .64 / .68 is no error; 4.04 in its place would leave .14 and a false alarm
    x, y = cohort(4, 0.5, patients=60)
    s = np.tile(0.04 * np.eye(5) + 4.0, (60, 1, 1))
    rng = np.random.default_rng(0)
    w = x + rng.normal(0, 0.2, x.shape) + rng.normal(0, 2.0, (60, 1))
    found = structural_slope(w, y, s, np.zeros((60, 5, 5)))
    assert found.reliability == pytest.approx(found.omega**2 / (found.omega**2 + 0.04), rel=1e-9)
    told = statistics(observed({"alpha": s}, alpha=w, y=y), "y", ["alpha"])
    assert not any("hardly known" in words for words in told.warnings)


def test_the_likelihood_ratio_of_f_is_that_of_a_regression() -> None:
    # y = 2 x + e over 9 rows without intercept, beta fixed at 1.7: RSS by hand, 9 = df + 1 contrasts
    x = np.arange(1.0, 10.0)
    y = 2 * x + np.array([0.3, -0.1, 0.4, -0.6, 0.2, 0.1, -0.5, 0.3, -0.2])
    best = float(x @ y / (x @ x))
    rss, there = (float(((y - b * x) ** 2).sum()) for b in (best, 1.7))
    f = (there - rss) / (rss / 8)
    assert _ratio_of_f(f, 8.0) == pytest.approx(9 * math.log(there / rss), rel=1e-12)
    assert _f_of_ratio(_ratio_of_f(f, 8.0), 8.0) == pytest.approx(f, rel=1e-12)
    assert _ratio_of_f(f, 1e9) == pytest.approx(f, rel=1e-6)


def test_the_bias_is_that_of_an_estimate_in_closed_form() -> None:
    # no patients' parts, an error s of w, no error of y: beta is m_wy / (m_ww - s) from nu = patients x regions - regions rows,
    # of which Var(m_ww) = 2 W^2 / nu and Cov(m_ww, m_wy) = 2 W beta x / nu, W = x + s, so that to first order the bias is
    # beta Var(m_ww) / x^2 - Cov(m_ww, m_wy) / x^2 = 2 beta W s / (nu x^2); many patients, so that the first order is all
    rng = np.random.default_rng(4)
    x = rng.normal(0, 0.8, (400, 5))
    w, y = x + rng.normal(0, 0.8, x.shape), 0.5 * x + rng.normal(0, 0.7, x.shape)
    w, y = w - w.mean(axis=0), y - y.mean(axis=0)
    model = _Model(w, y, np.tile(0.64 * np.eye(5), (400, 1, 1)), np.zeros((400, 5, 5)))
    beta, _, at = model.fit()
    assert model.unbiased(beta, at) < beta
    truth, nu = float(np.exp(at[1])), 400 * 5 - 5
    expected = 2 * beta * (truth + 0.64) * 0.64 / (nu * truth**2)
    assert beta - model.unbiased(beta, at) == pytest.approx(expected, rel=0.15)


def test_the_structural_slope_scales_with_units() -> None:
    x, y = cohort(5, 0.5)
    s, t = np.tile(0.16 * np.eye(5), (10, 1, 1)), np.zeros((10, 5, 5))
    one, other = structural_slope(x, y, s, t), structural_slope(1000 * x, 10 * y, 1e6 * s, t)
    assert [other.beta, other.low, other.high] == pytest.approx([v / 100 for v in (one.beta, one.low, one.high)], rel=1e-2)
    assert other.p == pytest.approx(one.p, rel=1e-2)


def test_posteriors_as_wide_as_the_regions_differ_leave_the_slope_unbounded() -> None:
    rng = np.random.default_rng(1)
    w, y = rng.normal(size=(10, 5)), rng.normal(size=(10, 5))
    found = statistics(observed({"alpha": np.tile(4 * np.eye(5), (10, 1, 1))}, alpha=w, y=y), "y", ["alpha"])
    carried = found.associations[0].carried[0]
    assert not (math.isfinite(carried.low) and math.isfinite(carried.high))
    assert any("unbounded" in words for words in found.warnings)
    assert "alpha" in "".join(found.warnings)


def test_rubin_is_wider_than_the_known_error() -> None:
    x, y = cohort(6, 0.5)
    error = np.tile(0.64 * np.eye(5), (10, 1, 1))
    noisy = y + np.random.default_rng(3).normal(0, 0.8, y.shape)
    exact = known_error(noisy, x, error)[0]
    drawn = rubin(normal_draws(noisy, error, 60, 0), x)
    assert drawn.estimate == pytest.approx(exact.estimate, abs=0.1)
    assert drawn.se > 1.1 * exact.se


def test_no_spread_between_patients_is_said() -> None:
    x, y = cohort(7, 0.5)
    rest = y - y.mean(axis=1, keepdims=True)  # a patient's mean is zero: less than chance would leave
    fit = published(observed(d_mm=rest, x=x), "d_mm", "x")
    assert fit.intercept_sd == pytest.approx(0, abs=1e-2)
    assert any("ordinary least squares" in note for note in fit.notes)
    # by hand: s^2 (X'X)^-1, s^2 of 50 - 6 degrees of freedom; MixedLM's own se there is another by up to a tenth
    design = np.column_stack([np.tile(np.eye(5), (10, 1)), x.ravel()])
    b = np.linalg.solve(design.T @ design, design.T @ rest.ravel())
    se = math.sqrt(((rest.ravel() - design @ b) ** 2).sum() / 44 * np.linalg.inv(design.T @ design)[-1, -1])
    c = fit.of("x")
    assert (c.estimate, c.se, c.df) == pytest.approx((b[-1], se, 44), rel=1e-9)
    assert c.p == pytest.approx(2 * scipy_stats.t.sf(abs(b[-1] / se), 44), rel=1e-9)
    rows = journal.models(statistics(observed(d_mm=rest, x=x), "d_mm", ["x"]))
    assert {row["method"] for row in rows} == {SQUARES} and rows[0]["df"] == 44


def test_where_mixedlm_does_not_converge_the_same_model_is_found_another_way(monkeypatch: pytest.MonkeyPatch) -> None:
    import statsmodels.api as sm

    x, y = cohort(3, 0.5)
    good = published(observed(d_mm=y, x=x), "d_mm", "x")
    fit = sm.MixedLM.fit

    def lost(self: sm.MixedLM, **options: bool) -> object:
        found = fit(self, **options)
        found.converged = False
        return found

    monkeypatch.setattr(sm.MixedLM, "fit", lost)
    found = published(observed(d_mm=y, x=x), "d_mm", "x")
    assert (found.method, good.method) == (OTHER_REML, MIXED) and any("by another search" in note for note in found.notes)
    assert [c.estimate for c in found.coefficients] == pytest.approx([c.estimate for c in good.coefficients], rel=1e-3)
    assert found.of("x").se == pytest.approx(known_error(y, x, np.zeros((10, 5, 5)))[0].se, rel=1e-6)
    assert found.intercept_sd == pytest.approx(good.intercept_sd, rel=1e-2)


def _spoil(name: str, frame: pd.DataFrame) -> pd.DataFrame:
    if name == "one patient":
        return frame[frame.participant_id == "sub-0"]
    if name == "two rows":
        return pd.concat([frame, frame[:1]])
    if name == "other regions":
        return frame[:-1]
    if name == "text":
        frame["d_mm"] = frame["d_mm"].astype(object)
        frame.loc[3, "d_mm"] = "old"
    if name == "empty":
        frame.loc[3, "d_mm"] = np.nan
    if name == "infinite":
        frame.loc[3, "d_mm"] = np.inf
    if name == "path":
        frame.loc[3, "participant_id"] = "../sub-0"
    if name == "no name":
        frame.loc[3, "participant_id"] = None
    if name == "negative sd":
        frame["d_mm_sd"] = -1.0
    return frame


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("one patient", "at least 2"),
        ("two rows", "two rows"),
        ("other regions", "sub-3 has no row for roof"),
        ("text", "row 4 holds 'old'"),
        ("empty", "row 4 is empty"),
        ("infinite", "row 4 holds inf"),
        ("path", "'../sub-0' is no identifier"),
        ("no name", "participant_id, row 4 is empty"),
        ("negative sd", "negative"),
    ],
)
def test_a_bad_table_is_one_message(tmp_path: Path, name: str, words: str) -> None:
    _, y = cohort(1, 0, patients=4)
    file = tmp_path / "t.csv"
    _spoil(name, tidy(d_mm=y)).to_csv(file, index=False)
    with pytest.raises(TableError, match=words.replace(".", r"\.")):
        read_observations(file, ["d_mm"])


def test_what_cannot_be_fitted_is_said_before(tmp_path: Path) -> None:
    x, y = cohort(1, 0, patients=2)
    with pytest.raises(InputError, match="at least 3"):
        statistics(observed(d_mm=y, x=x), "d_mm", ["x"])
    x, y = cohort(1, 0, patients=4)
    with pytest.raises(InputError, match="same in all patients"):
        statistics(observed(d_mm=y, x=np.ones_like(x)), "d_mm", ["x"])
    with pytest.raises(UsageError, match="once"):
        statistics(observed(d_mm=y), "d_mm", ["d_mm"])
    age = np.tile(np.arange(4.0)[:, None], 5)
    with pytest.raises(InputError, match="one number a patient"):
        statistics(observed({"age": np.tile(np.eye(5), (4, 1, 1))}, d_mm=y, age=age), "d_mm", ["age"])
    file = tmp_path / "t.csv"
    tidy(d_mm=y).to_csv(file, index=False)
    with pytest.raises(UsageError, match="no column thickness"):
        read_observations(file, ["d_mm", "thickness"])


def test_joint_draws_take_the_place_of_the_sd(tmp_path: Path) -> None:
    x, y = cohort(1, 0.5, patients=3)
    file, other = tmp_path / "t.csv", tmp_path / "draws.csv"
    tidy(d_mm=y, alpha=x).assign(alpha_sd=9.0).to_csv(file, index=False)
    rng = np.random.default_rng(0)
    joint = rng.multivariate_normal(np.zeros(5), 0.2 + 0.3 * np.eye(5), size=(4000, 3)) + x
    rows = [tidy(alpha=draw).assign(draw=k) for k, draw in enumerate(joint)]
    pd.concat(rows).to_csv(other, index=False)
    found = read_observations(file, ["d_mm", "alpha"], draws=other)
    assert found.errors["alpha"] == pytest.approx(np.tile(0.2 + 0.3 * np.eye(5), (3, 1, 1)), abs=0.05)
    assert set(found.errors) == {"alpha"}
    pd.concat(rows[:60])[:-1].to_csv(other, index=False)
    with pytest.raises(LacliError, match="each draw once"):
        read_observations(file, ["alpha"], draws=other)


def test_the_files_hold_the_same_numbers(tmp_path: Path) -> None:
    import json

    x, y = cohort(1, 0.5)
    sd = np.tile(0.25 * np.eye(5), (10, 1, 1))
    found = statistics(observed({"alpha": sd}, d_mm=y, alpha=x), "d_mm", ["alpha"])
    files = journal.write(found, tmp_path)
    assert [f.name for f in files] == list(journal.FILES)
    pairs, models = pd.read_csv(files[0]), pd.read_csv(files[1])
    document = json.loads(files[2].read_text())
    assert list(pairs["p"]) == pytest.approx([t["p"] for t in document["pairs"]])
    carried = models[models.method == "structural"].iloc[0]
    assert carried["estimate"] == pytest.approx(document["associations"][0]["carried"][0]["estimate"])
    assert f"| alpha | structural | {carried['estimate']:.3g} |" in files[3].read_text()
    tex = files[4].read_text()
    assert r"d\_mm" in tex and tex.count(r"\begin{table}") == tex.count(r"\end{table}") == 2


def test_the_carried_slope_over_a_few_cohorts() -> None:
    """Six cohorts are no proof (the benchmark is), but a slope twice too small, as the plain one is, would show."""
    error, none = np.tile(0.64 * np.eye(5), (10, 1, 1)), np.zeros((10, 5, 5))
    found = []
    for seed in range(6):
        x, y = cohort(100 + seed, 0.5)
        w = x + np.random.default_rng(seed).normal(0, 0.8, x.shape)
        found.append(structural_slope(w, y, error, none))
    assert 0.35 < float(np.median([f.beta for f in found])) < 0.65
    assert sum(f.low <= 0.5 <= f.high for f in found) >= 4


def test_the_information_is_that_of_the_restricted_likelihood_written_out() -> None:
    rng = np.random.default_rng(3)
    n, r = 4, 2
    errors = np.tile(0.3 * np.eye(r), (n, 1, 1)) * np.linspace(0.5, 1.5, n)[:, None, None]
    model = _Model(rng.normal(size=(n, r)), rng.normal(size=(n, r)), errors, 0.1 * errors)
    at = np.array([0.4, *np.log([0.5, 0.7, 0.2, 0.6])])

    def whole(point: np.ndarray) -> np.ndarray:
        return block_diag(*model.covariance(float(point[0]), point[1:]))

    # P = W - W X (X' W X)^-1 X' W with one mean for each column; information tr(P V_i P V_j) / 2
    w, x = np.linalg.inv(whole(at)), np.tile(np.eye(2 * r), (n, 1))
    p = w - w @ x @ np.linalg.inv(x.T @ w @ x) @ x.T @ w
    h = 1e-4
    v = [(whole(at + h * e) - whole(at - h * e)) / (2 * h) for e in np.eye(5)]
    expected = [[0.5 * np.trace(p @ a @ p @ b) for b in v] for a in v]
    assert model.information(at, range(5)) == pytest.approx(np.array(expected), rel=1e-5)
    part = [0, 2, 4]
    assert model.information(at, part) == pytest.approx(np.array(expected)[np.ix_(part, part)], rel=1e-5)


def test_degrees_of_freedom_are_few_where_patients_are_few_and_those_of_residuals_where_they_are_many() -> None:
    found = []
    for patients in (10, 400):
        x, y = cohort(6, 0.5, patients=patients)
        w = x + np.random.default_rng(0).normal(0, 0.8, x.shape)
        found.append(structural_slope(w, y, np.tile(0.64 * np.eye(5), (patients, 1, 1)), np.zeros((patients, 5, 5))))
    assert 1 <= found[0].df < 15  # what the variances of ten patients tell, not their 35 residuals
    assert found[1].df > 15 * found[0].df  # in proportion to the patients: 40 times as many


def test_a_fit_without_standard_errors_is_told_and_warns_nobody() -> None:
    """Four patients between whom nothing varies as the model has it: REML's curvature there has no root."""
    d = [
        [5.82, 4.36, 3.45, 7.40, 3.94],
        [4.51, 5.54, 3.79, 6.55, 2.76],
        [5.97, 6.29, 4.16, 7.16, 3.19],
        [5.14, 5.0, 3.88, 6.48, 2.6],
    ]
    alpha = [
        [1.93, 1.71, 1.24, 1.98, 1.75],
        [2.85, 3.07, 2.93, 1.6, 2.08],
        [1.21, 1.13, 1.67, 2.04, 1.39],
        [3.11, 2.36, 2.43, 2.85, 2.39],
    ]
    found = published(observed(d_mm=np.array(d), alpha=np.array(alpha)), "d_mm", "alpha")  # warnings are errors here
    again = known_error(np.array(d), np.array(alpha), np.zeros((4, 5, 5)))[0]
    assert (found.of("alpha").estimate, found.of("alpha").se) == pytest.approx((again.estimate, again.se), rel=1e-4)
    assert found.method == SQUARES and any("MixedLM did not converge" in note for note in found.notes)
