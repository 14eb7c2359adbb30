"""Sobol' indices against analytic values and SALib."""

import numpy as np
import pytest

from lacli.inference.sensitivity import function_indices, saltelli_sample, sobol_indices


def ishigami(x):
    return (np.sin(x[:, 0]) + 7 * np.sin(x[:, 1]) ** 2 + 0.1 * x[:, 2] ** 4 * np.sin(x[:, 0]))[:, None]


def test_ishigami():
    a, b, pi = 7.0, 0.1, np.pi
    v1, v2, v13 = 0.5 * (1 + b * pi**4 / 5) ** 2, a**2 / 8, 8 * b**2 * pi**8 / 225
    v = v1 + v2 + v13
    s = function_indices(ishigami, np.full(3, -pi), np.full(3, pi), 2**15)
    assert s.s1[0] == pytest.approx([v1 / v, v2 / v, 0], abs=0.003)
    assert s.st[0] == pytest.approx([(v1 + v13) / v, v2 / v, v13 / v], abs=0.003)
    assert s.s2[0, 0, 2] == pytest.approx(v13 / v, abs=0.003) and s.s2[0, 0, 1] == pytest.approx(0, abs=0.003)


def test_g_function():
    a = np.array([0.0, 0.5, 3.0, 9.0, 99.0])
    s = function_indices(lambda x: np.prod((np.abs(4 * x - 2) + a) / (1 + a), axis=1)[:, None], np.zeros(5), np.ones(5), 2**15)
    vi = 1 / (3 * (1 + a) ** 2)
    v = np.prod(1 + vi) - 1
    assert s.s1[0] == pytest.approx(vi / v, abs=0.003)
    assert s.st[0] == pytest.approx(vi * np.prod(1 + vi) / (1 + vi) / v, abs=0.003)
    assert s.ranking().sum() == pytest.approx(1.0) and (np.diff(s.ranking()) < 0).all()


def test_equal_to_salib():
    from SALib.analyze import sobol

    lower, upper = np.full(3, -np.pi), np.full(3, np.pi)
    points = saltelli_sample(lower, upper, 256, seed=5)
    y = np.stack([ishigami(block) for block in points])
    y = np.concatenate([y, np.cos(points[..., :1]) + points[..., 1:2]], axis=2)
    ours = sobol_indices(y, resamples=50, seed=9)
    problem = {"num_vars": 3, "names": ["a", "b", "c"], "bounds": np.c_[lower, upper].tolist()}
    for i in range(2):
        theirs = sobol.analyze(problem, y[..., i].T.ravel(), num_resamples=50, seed=9)
        for name, value in (("S1", ours.s1), ("ST", ours.st), ("S2", ours.s2)):
            assert np.nanmax(np.abs(theirs[name] - value[i])) < 1e-12
            assert np.nanmax(np.abs(theirs[name + "_conf"] - getattr(ours, name.lower() + "_conf")[i])) < 1e-12


def test_sample_blocks_differ_in_one_column():
    points = saltelli_sample(np.zeros(4), np.ones(4), 8, 0)
    for j in range(4):
        assert np.array_equal(points[1 + j][:, j], points[-1][:, j])  # A with column j of B
        assert np.array_equal(points[5 + j][:, j], points[0][:, j])  # B with column j of A
        other = np.arange(4) != j
        assert np.array_equal(points[1 + j][:, other], points[0][:, other])
        assert np.array_equal(points[5 + j][:, other], points[-1][:, other])
