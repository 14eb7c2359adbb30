"""The compiled sums and numpy's are the same numbers, whatever the counts; a missing compiler costs time alone."""

import copy
import logging
import pickle
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lacli.base.processes import native as compiled
from lacli.inference.emulation import moments


def make(p: int, f: int, n: int, q: int, seed: int = 0) -> tuple[moments.Processes, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    exponent, linear, weights = -0.2 * rng.random((p, f, n)), rng.standard_normal((p, f, q)), rng.standard_normal((p, n, q))
    roots = np.triu(rng.standard_normal((p, n, n)))
    return moments.processes(exponent, linear, weights, roots), exponent, roots


needs_compiler = pytest.mark.skipif(moments._compiled() is None, reason="no C++ compiler here")


@needs_compiler
@settings(max_examples=30, deadline=None)
@given(
    st.integers(1, 3),
    st.integers(1, 9),
    st.integers(1, 40),
    st.integers(1, 12),
    st.integers(1, 120),
    st.sampled_from([0, 8, 999]),
)
def test_compiled_and_numpy_agree(p, f, n, q, m, used):
    s, _, _ = make(p, f, n, q, seed=n)
    rng = np.random.default_rng(m)
    phi, shift = rng.standard_normal((m, f)), -rng.random((m, p))
    which = [p - 1, 0]
    ours = moments.sums(s, phi, shift, which, used)
    theirs = moments._by_numpy(s, phi, shift, which, min(used, s.runs))
    for a, b in ((ours.mean, theirs.mean), (ours.linear, theirs.linear), (ours.explained, theirs.explained)):
        np.testing.assert_allclose(a, b, rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize("by_numpy", [False, True])
def test_sums_are_those_of_the_definition(by_numpy, monkeypatch):
    if by_numpy:
        monkeypatch.setattr(moments, "_compiled", lambda: None)
    s, exponent, roots = make(2, 4, 21, 3)
    rng = np.random.default_rng(1)
    phi, shift = rng.standard_normal((7, 4)), -rng.random((7, 2))
    found = moments.sums(s, phi, shift, [1])
    k = np.exp(phi @ exponent[1] + shift[:, 1:])
    np.testing.assert_allclose(found.explained[0], ((k @ roots[1]) ** 2).sum(1), rtol=1e-12)
    t = phi @ s.weights[1, :4, :3] + k @ s.weights[1, 4:25, :3]
    np.testing.assert_allclose(found.mean[0], t[:, 0], rtol=1e-11)
    np.testing.assert_allclose(found.linear[0], (t[:, 1:] ** 2).sum(1), rtol=1e-11)


@needs_compiler
def test_a_point_has_the_same_bits_in_any_company():
    s, _, _ = make(2, 5, 30, 4)
    rng = np.random.default_rng(2)
    phi, shift = rng.standard_normal((101, 5)), -rng.random((101, 2))
    together = moments.sums(s, phi, shift, [0, 1])
    alone = moments.sums(s, phi[77:78], shift[77:78], [0, 1])
    assert np.array_equal(together.explained[:, 77:78], alone.explained)
    assert np.array_equal(together.mean[:, 77:78], alone.mean)


@pytest.mark.parametrize("again", [copy.copy, copy.deepcopy, lambda s: pickle.loads(pickle.dumps(s))])  # noqa: S301
def test_a_copy_stands_on_arrays_of_its_own(again):
    """Addresses once asked for belong to the original: a copy that kept them would read what is there no more."""
    s, _, _ = make(2, 5, 30, 4)
    rng = np.random.default_rng(3)
    phi, shift = rng.standard_normal((7, 5)), -rng.random((7, 2))
    before = moments.sums(s, phi, shift, [0, 1])
    other = again(s)
    assert other.addresses == tuple(a.ctypes.data for a in (other.exponent, other.weights, other.roots))
    s.exponent[:] = s.weights[:] = s.roots[:] = np.nan
    if again is not copy.copy:
        assert np.array_equal(moments.sums(other, phi, shift, [0, 1]).explained, before.explained)


@needs_compiler
def test_exponentials_are_right_to_the_edge_of_the_numbers():
    """exp(-731) is denormal: a library that flushes such numbers to zero would have changed the whole process's rounding."""
    s = moments.processes(np.zeros((1, 1, 8)), np.zeros((1, 1, 1)), np.ones((1, 8, 1)) * 0.125, np.zeros((1, 8, 8)))
    shift = np.array([[-731.0], [-800.0], [0.0], [-1.0]])
    found = moments.sums(s, np.ones((4, 1)), shift, [0]).mean[0]
    # eight denormal numbers, each rounded to a multiple of 5e-324
    np.testing.assert_allclose(found, np.exp(shift[:, 0]), rtol=1e-15, atol=8 * 5e-324)
    assert 0 < found[0] < 1e-300
    assert np.float64(1e-320) * 1.0 > 0


@needs_compiler
def test_a_kept_library_that_does_not_load_is_made_again(tmp_path: Path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    source = tmp_path / "one.cpp"
    source.write_text('extern "C" int one() { return 1; }\n')
    # in other processes: what is loaded already is not looked at again
    words = f"import pathlib; from lacli.base.processes import native; print(native.library(pathlib.Path({str(source)!r})).one())"
    for _ in range(2):
        done = subprocess.run([sys.executable, "-c", words], capture_output=True, text=True, check=True)
        assert done.stdout == "1\n"
        (kept,) = (tmp_path / "cache").rglob("one.so")
        assert kept.stat().st_size > 1000
        kept.write_bytes(b"")


def test_a_user_without_a_home_predicts_all_the_same(tmp_path: Path, monkeypatch):
    """Containers run under numbers that no user has."""

    def homeless() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(Path, "home", homeless)
    source = tmp_path / "two.cpp"
    source.write_text('extern "C" int two() { return 2; }\n')
    assert compiled.library(source) is None


def test_what_does_not_compile_is_said_and_left(tmp_path: Path, monkeypatch, caplog):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    source = tmp_path / "broken.cpp"
    source.write_text("this is not C++\n")
    with caplog.at_level(logging.INFO):
        assert compiled.library(source) is None
    assert "broken.cpp" in caplog.text
    assert not list((tmp_path / "cache").rglob("*.so"))
    monkeypatch.setenv("CXX", "/nowhere/g++")
    assert compiled.library(tmp_path / "other.cpp") is None


def test_a_compiler_that_hangs_is_given_up_with_all_that_it_started(tmp_path: Path, monkeypatch, caplog):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    mark = tmp_path / "child.pid"
    driver = tmp_path / "driver"
    driver.write_text(f'#!/bin/sh\n[ "$1" = -dumpfullversion ] && exit 0\nsleep 60 & echo $! > {mark}\nwait\n')
    driver.chmod(0o755)
    monkeypatch.setenv("CXX", str(driver))
    monkeypatch.setattr(compiled, "_TIMEOUT_S", 2.0)
    source = tmp_path / "slow.cpp"
    source.write_text("int x;\n")
    with caplog.at_level(logging.INFO):
        assert compiled.library(source) is None
    assert "did not come to an end" in caplog.text
    # killed: on a busy machine it may not have died yet, and whoever inherits orphans here may not have reaped it
    status = Path(f"/proc/{mark.read_text().strip()}/status")
    until = time.monotonic() + 20.0  # it would sleep for 60
    while (alive := _lives(status)) and time.monotonic() < until:
        time.sleep(0.05)
    assert not alive


def _lives(status: Path) -> bool:
    try:
        return "State:\tZ" not in status.read_text()
    except (FileNotFoundError, ProcessLookupError):
        return False
