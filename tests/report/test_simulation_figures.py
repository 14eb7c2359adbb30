"""Pictures of a simulation, drawn without a display from made-up results."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import pyvista as pv

from lacli.base.errors import InputError
from lacli.contracts.labels import PLANES, REGIONS, RINGS
from lacli.report import simulation_figures as figures


def shell() -> pv.UnstructuredGrid:
    """A spherical shell of wedges around a mitral opening below, 25 mm in radius, 2 mm thick."""
    ball = pv.Icosphere(radius=1.0, nsub=4)
    triangles = ball.faces.reshape(-1, 4)[:, 1:]
    n = ball.n_points
    points = np.vstack([25 * ball.points, 27 * ball.points])
    cells = np.hstack([np.full((len(triangles), 1), 6), triangles, triangles + n]).ravel()
    grid = pv.UnstructuredGrid(cells, np.full(len(triangles), pv.CellType.WEDGE), points)
    x, y, z = (ball.points[triangles].mean(axis=1)).T
    region = np.full(len(triangles), REGIONS["roof"])
    region[(z < 0.6) & (np.abs(y) >= np.abs(x))] = REGIONS["posterior"]
    region[(z < 0.6) & (np.abs(y) >= np.abs(x)) & (y < 0)] = REGIONS["anterior"]
    region[(z < 0.6) & (np.abs(y) < np.abs(x))] = REGIONS["lateral"]
    region[(z < 0.6) & (np.abs(y) < np.abs(x)) & (x < 0)] = REGIONS["septum"]
    region[z < -0.75] = RINGS["mv"]
    region[z < -0.85] = PLANES["mv"]
    grid.cell_data["region"] = region
    return grid


@pytest.fixture
def run_folder(tmp_path: Path) -> Path:
    ed = shell()
    displacement = np.column_stack([0.1 * ed.points[:, 0], 0.15 * ed.points[:, 1], -8 * (ed.points[:, 2] < -18).astype(float)])
    ed.point_data["displacement"] = np.zeros_like(displacement)
    es = ed.copy()
    es.points = ed.points + displacement
    es.point_data["displacement"] = displacement
    (tmp_path / "fields").mkdir()
    ed.save(tmp_path / "fields" / "ed.vtu")
    es.save(tmp_path / "fields" / "es.vtu")
    time = np.linspace(0, 0.8, 17)
    rise = np.where(time <= 0.4, np.sin(time / 0.4 * np.pi / 2), np.cos((time - 0.4) / 0.4 * np.pi / 2) * 0.7 + 0.3)
    table = {
        "time": time,
        "phase": np.where(time <= 0.4, "reservoir", "conduit"),
        "pressure_mmhg": 8 + 12 * rise,
        "volume_ml": 80 + 35 * rise,
        "d_global_mm": 3 * rise,
        **{f"d_{name}_mm": (2 + 0.5 * i) * rise for i, name in enumerate(REGIONS)},
    }
    pd.DataFrame(table).to_csv(tmp_path / "transients.csv", index=False)
    return tmp_path


def test_both_pictures_are_drawn_in_a_process_without_a_display(run_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    drawn, trouble = figures.draw_apart(run_folder)
    assert trouble == ""
    assert [path.name for path in drawn] == ["transients.png", "shapes.png"]
    for path in drawn:
        picture = pv.read(path)
        assert min(picture.dimensions[:2]) > 800
    shapes = np.asarray(pv.read(drawn[1]).active_scalars)[:, :3]
    colours = {tuple(c) for c in shapes[np.ptp(shapes, axis=1) > 60]}
    assert len(colours) > 100, "coloured shapes, not an empty frame"
    assert sorted(p.name for p in run_folder.iterdir()) == ["fields", "shapes.png", "transients.csv", "transients.png"]


def test_anterior_is_looked_at_with_the_roof_up(run_folder: Path) -> None:
    front, up = figures._viewing_directions(figures._read_shape(run_folder / "fields" / "ed.vtu"))
    np.testing.assert_allclose(front, [0, -1, 0], atol=0.05)
    np.testing.assert_allclose(up, [0, 0, 1], atol=0.05)


def test_one_region_only_still_has_a_view() -> None:
    grid = shell()
    grid.cell_data["region"] = np.ones(grid.n_cells, dtype=int)
    front, up = figures._viewing_directions(grid)
    assert abs(front @ up) < 1e-12
    assert np.linalg.norm(front) == pytest.approx(1)


def test_nothing_to_draw_is_no_error(tmp_path: Path) -> None:
    assert figures.draw(tmp_path) == []


def test_damaged_results_are_named(run_folder: Path) -> None:
    (run_folder / "transients.csv").write_text("time,phase\n0,reservoir\n")
    with pytest.raises(InputError, match=r"transients\.csv: the column 'pressure_mmhg' is missing"):
        figures.draw(run_folder)
    drawn, trouble = figures.draw_apart(run_folder)
    assert drawn == []
    assert "pressure_mmhg" in trouble


def test_module_prints_paths_only(run_folder: Path) -> None:
    (run_folder / "fields" / "ed.vtu").unlink()
    answer = subprocess.run(
        [sys.executable, "-m", "lacli.report.simulation_figures", str(run_folder)], capture_output=True, text=True, check=True
    )
    assert answer.stdout == f"{run_folder / 'transients.png'}\n"
    assert answer.stderr == ""
