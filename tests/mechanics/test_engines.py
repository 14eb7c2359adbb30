"""The compiled engine and the one in FreeFEM's own language: the same numbers from both, and a run where nothing compiles."""

from __future__ import annotations

import logging
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from shapes import fibrous_ball

from lacli.base import resources
from lacli.base.errors import SolverMissingError
from lacli.contracts import bundle as bundles
from lacli.contracts.bundle import Bundle, as_order
from lacli.contracts.case import Case
from lacli.contracts.labels import EPI, RINGS
from lacli.contracts.laws import LAWS
from lacli.contracts.scene import Scene, build_scene
from lacli.freefem import run as running
from lacli.freefem.program import FreeFem, find
from lacli.mechanics import engine, inputs, plan, simulation
from lacli.motion.annulus import asked_motion

SOLVERS = resources.folder("solvers") / "freefem"
SCALARS = 4
# every term loaded and stretched, on both maps; then each task's scalars, residual and, with a tangent, K v and K^-1 R
DISTURBED = """
load "msh3"
LOAD
macro Displacement() PORDER //
macro Points() POINTS //
include "geometry.idp"
include "engine_ENGINE.idp"
if (engineStart() != 0) exit(2);
engineFaces(0, "pressure.txt");
engineFaces(1, "veins.txt");
engineFaces(2, "pericardium.txt");
engineFaces(3, "pericardium.txt");
for (int i = 0; i < 9; ++i) held[7 * i] = 1;
engineHold();
pressureKPa = 1.3;
veinSpring = 0.7;
pericardiumSpring = 0.9;
real[int] dv(nAll), w(nAll);
for (int k = 0; k < nU; ++k) {
  real a = image[k], b = image[nU + k], c = image[2 * nU + k];
  for (int i = 0; i < 3; ++i) {
    dv[i * nU + k] = sin(0.3 * a + i) * cos(0.2 * b - 0.1 * c * i);
    state[i * nU + k] += 0.6 * sin(0.17 * a * (i + 1) + 0.2 * b) * cos(0.11 * c);
    prestrain[i * nU + k] = 0.5 * cos(0.13 * a + 0.21 * b * (i + 1)) * sin(0.15 * c + 1);
    X[i * nU + k] += 0.1 * sin(0.2 * (a + b) + i);
  }
}
fespace Qh(Th, P1);
Qh pp = 3 * sin(0.1 * x + 0.2 * y - 0.15 * z), dd = cos(0.2 * x - 0.1 * z);
for (int i = 0; i < nP; ++i) {
  state[3 * nU + i] = pp[][i];
  dv[3 * nU + i] = dd[][i];
}
ofstream out("ENGINE.txt");
out.precision(17);
func int show(int task) {
  if (assemble(task)) exit(3);
  out << minJ << "\\n" << minJX << "\\n" << energy << "\\n" << volumeMm3 << "\\n";
  for (int i = 0; i < nAll; ++i) out << R[i] << "\\n";
  if (task == 0 || task == 4) return 0;
  multiply(dv, w);
  for (int i = 0; i < nAll; ++i) out << w[i] << "\\n";
  if (task == 3) return 0;
  real[int] b(nAll);
  b = R;
  if (solveLinear(b, w) != 0) exit(4);
  for (int i = 0; i < nAll; ++i) out << w[i] << "\\n";
  return negativePivots();
}
damp(0.013);
show(0);
int unstable = show(1);
show(4);
show(5);
damp(0); // the tangent of the inverse problem is used undamped, and without prestrain
show(3);
damp(0.013);
keepPrestrain();
show(0);
unstable = 10000 * unstable + show(1);
out << unstable << endl;
cout << "@ done" << endl;
"""
TASKS = ((0, 1), (1, 3), (4, 1), (5, 3), (3, 2), (0, 1), (1, 3))  # and how many vectors each writes


@pytest.fixture(scope="module")
def ball() -> Bundle:
    """A ball of 20 mm radius cut at z = 14 mm, wall 2 mm, fibres around z, a patch of its far side tagged as a vein's ring."""
    bundle = fibrous_ball(order=2)
    middle = bundle.points[bundle.triangles[:, :3]].mean(axis=1)
    vein = (bundle.tags == EPI) & (middle[:, 2] < -12) & (middle[:, 0] > 0)
    return replace(bundle, tags=np.where(vein, RINGS["rspv"], bundle.tags))


@pytest.fixture(scope="module")
def folder(ball: Bundle, tmp_path_factory: pytest.TempPathFactory) -> Path:
    target = tmp_path_factory.mktemp("ball")
    bundles.save(ball, target / "bundle")
    return target


def scene(folder: Path, *overrides: str) -> Scene:
    base = ["motion.annulus=axial", "motion.amplitude_mm=3", "loads.edp_mmhg=3", "loads.esp_mmhg=8", "outputs.fields=none"]
    return build_scene({"anatomy": {"bundle": "bundle"}}, [*base, *overrides], folder=folder, where="test")


def disturbed(ball: Bundle, folder: Path, place: Path, order: int, points: int, chosen: str) -> NDArray[np.float64]:
    """What ``DISTURBED`` writes with one of the engines."""
    settings = scene(folder, f"numerics.order={order}", "materials.plane_c_kpa=3")
    work = as_order(ball, order)
    motion = asked_motion(settings.motion, work, settings.anatomy.bundle)
    inputs.write_inputs(Case(settings, work, motion, plan.make_plan(settings, work, motion), key=""), place)
    load = f'load "{engine.plugin().with_suffix("")}"' if chosen == "plugin" else ""
    text = DISTURBED.replace("LOAD", load).replace("PORDER", f"P{order}").replace("POINTS", str(points))
    script = place / f"{chosen}.edp"
    script.write_text(text.replace("ENGINE", chosen), encoding="utf-8")
    outcome = running.run(find(), script, place, 120, includes=(SOLVERS,))
    assert outcome.done, outcome.message
    return np.loadtxt(place / f"{chosen}.txt")


@pytest.mark.parametrize(("order", "points"), [(1, 4), (2, 4), (2, 14)])
def test_both_engines_agree_at_a_disturbed_state(
    freefem: FreeFem, ball: Bundle, folder: Path, tmp_path: Path, order: int, points: int
) -> None:
    one, other = (disturbed(ball, folder, tmp_path, order, points, chosen) for chosen in ("plugin", "script"))
    assert len(one) == len(other)
    assert one[-1] == other[-1]  # unstable modes, by the pivots' signs
    size = (len(one) - 1 - SCALARS * len(TASKS)) // sum(count for _, count in TASKS)
    start = 0
    for task, count in TASKS:
        assert other[start : start + SCALARS] == pytest.approx(one[start : start + SCALARS], rel=1e-10)
        start += SCALARS
        for name in ("residual", "product", "solution")[:count]:
            here = slice(start, start + size)
            gap = np.abs(one[here] - other[here]).max() / np.abs(one[here]).max()
            # the prestrain's tangent has its exponential differentiated by quadrature, the inverse's is a difference
            allowed = 1e-9 if name == "residual" or task == 1 else 1e-5
            assert gap < allowed, f"{name} of task {task}"
            start += size
    assert start == len(one) - 1


@pytest.mark.parametrize(
    "settings",
    [
        ("numerics.order=1", "pericardium.outward_only=true"),
        ("numerics.order=1", "numerics.unloading=backward"),
        ("numerics.order=2",),
        pytest.param(("numerics.order=2", "pericardium.outward_only=true", "numerics.quadrature=14"), marks=pytest.mark.slow),
    ],
)
def test_both_engines_reach_the_same_features(freefem: FreeFem, folder: Path, tmp_path: Path, settings: tuple[str, ...]) -> None:
    results = []
    for chosen in ("plugin", "script"):
        result = simulation.run_scene(scene(folder, *settings, f"numerics.engine={chosen}"), tmp_path)
        assert result.status == "done", result.message
        assert result.manifest["engine"] == chosen
        results.append(result)
    one, other = (result.features for result in results)
    assert one.keys() == other.keys()
    for name in one.keys() - {"cpu_s", "peak_memory_mb"}:
        if isinstance(one[name], dict):  # stated errors: shares of the features, and where each comes from
            assert other[name].keys() == one[name].keys()
            for inner, value in one[name].items():
                same = (
                    value == other[name][inner]
                    if isinstance(value, str)
                    else other[name][inner] == pytest.approx(value, rel=1e-6)
                )
                assert same, f"{name}.{inner}"
        else:
            assert other[name] == pytest.approx(one[name], rel=1e-6, abs=1e-9), name
    assert one["esv_ml"] > 1.1 * one["edv_ml"]  # something has moved


def test_without_a_compiler_a_run_goes_through_and_says_so_once(
    freefem: FreeFem, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("CXX", str(tmp_path / "no-such-compiler"))
    engine._warn.cache_clear()
    with caplog.at_level(logging.WARNING):
        for pressure in (4, 5):
            result = simulation.run_scene(scene(folder, "numerics.order=1", f"loads.esp_mmhg={pressure}"), tmp_path)
            assert result.status == "done", result.message
            assert result.manifest["engine"] == "script"
            assert (result.folder / "deck.edp").read_text().count("lacli.so") == 0
    (line,) = [record.getMessage() for record in caplog.records]
    assert engine.SLOWER_WORDS in line and "apt-get install -y g++" in line and "\n" not in line
    with pytest.raises(SolverMissingError, match=r"apt-get install -y g\+\+"):
        engine.choose("plugin", LAWS["guccione"])
    assert engine.choose("script", LAWS["guccione"]) is None


def test_what_mumps_says_when_it_fails_is_a_kind_of_failure(freefem: FreeFem, tmp_path: Path) -> None:
    script = tmp_path / "singular.edp"
    script.write_text(
        'load "MUMPS_seq"\nint[int] I = [0, 1], J = [0, 1];\nreal[int] V = [1., 0.], b = [1., 1.], x(2);\nmatrix A = [I, J, V];\n'
        'set(A, solver = "MUMPS");\nx = A ^ -1 * b;\ncout << "@ done" << endl;\n',
        encoding="utf-8",
    )
    outcome = running.run(freefem, script, tmp_path, 60)
    # MUMPS' error -10: numerically singular
    assert (outcome.kind, outcome.done) == ("linear_solver", False)
    assert "-10" in outcome.message


def test_no_pointer_is_made_from_an_entry_that_may_not_be_there() -> None:
    """``&a[0]`` of an empty array refers to nothing: checked arrays of FreeFEM abort there, compilers may assume otherwise."""
    taken = re.compile(r"&\(?\*?\w+\)?\[0\]")
    sources = sorted((SOLVERS / "plugin").rglob("*.?pp"))
    assert len(sources) > 5
    assert [(file.name, found) for file in sources for found in taken.findall(file.read_text(encoding="utf-8"))] == []
