"""A refusal leaves a picture of both readings and landmarks to correct; with these corrected the same command succeeds."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pytest
import pyvista as pv
import tomli_w
from typer.testing import CliRunner

from lacli.base.errors import AnatomyError
from lacli.cli.main import build as application
from lacli.contracts.bundle import load
from lacli.contracts.labels import PLANES, plane_of
from lacli.geometry.surface import Surface
from lacli.synthetic import variants
from lacli.synthetic.shape import draw


def mesh(source: Path, out: Path, *more: str) -> tuple[int, str]:
    words = ["mesh", str(source), "--out", str(out), "--order", "1", "--cell-size-mm", "8", "--no-pictures", *more]
    run = CliRunner().invoke(application({"mesh"}), words)
    return run.exit_code, run.output + (str(run.exception) if isinstance(run.exception, AnatomyError) else "")


def test_a_missing_vein_is_drawn_and_the_corrected_file_meshes(tmp_path: Path) -> None:
    # everything open but the LSPV, whose stump is closed: the appendage has its place
    shape, cuts = variants._cuts(draw(3), "open", np.random.default_rng(0))
    lost = next(c for c in cuts if c.label == PLANES["lspv"])
    surface = variants.isosurface(shape, 1.0)
    for cut in cuts:
        surface = variants.cut_open(surface, cut)
    open_ones = [p for n, p in PLANES.items() if n != "lspv"]
    keep = ~np.isin(surface.label, open_ones)
    pv.PolyData.from_regular_faces(surface.points, surface.triangles[keep]).save(tmp_path / "atrium.vtp")
    code, words = mesh(tmp_path / "atrium.vtp", tmp_path / "out")
    assert code == 1 and "LSPV" in words and "out-landmarks.toml" in words
    assert not (tmp_path / "out").exists()
    assert not list(tmp_path.glob(".*"))
    picture = tmp_path / "out-readings.png"
    assert ("out-readings.png" in words) == picture.is_file()

    table = tomllib.loads((tmp_path / "out-landmarks.toml").read_text())
    truth = {plane_of(c.label): c for c in cuts}
    table.pop("appendage", None)
    for name, cut in truth.items():
        place = cut.centre - (2.0 if name == "lspv" else 0.0) * cut.direction
        table[name] = {"centre": place.tolist(), "normal": cut.direction.tolist(), "diameter_mm": 14.0 if name != "mv" else 30.0}
    (tmp_path / "mine.toml").write_text(tomli_w.dumps(table))
    code, words = mesh(tmp_path / "atrium.vtp", tmp_path / "out", "--landmarks", str(tmp_path / "mine.toml"))
    assert code == 0, words
    bundle = load(tmp_path / "out")
    corner = bundle.points[bundle.triangles[bundle.tags == PLANES["lspv"], :3]]
    assert corner.mean(axis=(0, 1)) == pytest.approx(lost.centre, abs=4.0)


def test_both_readings_are_drawn_in_a_process_of_their_own(tmp_path: Path) -> None:
    from lacli.anatomy import opening_pictures
    from lacli.anatomy.openings.landmarks import Landmarks, Opening

    ball = pv.Icosphere(radius=20.0, nsub=3)
    surface = Surface(np.asarray(ball.points, dtype=float), ball.regular_faces, np.zeros(ball.n_cells, dtype=np.int64))
    ways = {"mv": [0, 0, -1], "rspv": [-1, 0, 0.5], "ripv": [-1, 0.5, 0], "lspv": [1, 0, 0.5], "lipv": [1, 0.5, 0]}
    marks = {}
    for name, way in ways.items():
        n = np.array(way, dtype=float) / np.linalg.norm(way)
        marks[name] = Opening(name, 20 * n, n, 22 * n, 12.0, 1.0, "given")
    swapped = {**marks, "lspv": marks["lipv"], "lipv": marks["lspv"]}
    file = tmp_path / "readings.png"
    drawn = opening_pictures.draw_readings(surface, [("first", Landmarks(marks)), ("second", Landmarks(swapped))], file)
    if not drawn:
        pytest.skip("VTK cannot draw here (EGL, OSMesa or an X server is needed)")
    import matplotlib.pyplot as plt

    pixels = plt.imread(file)[..., :3]
    half = pixels.shape[0] // 2
    # dark red (LSPV) and light red (LIPV) are on both rows
    for rows in (slice(0, half), slice(half, None)):
        for colour in (opening_pictures.COLOURS["lspv"], opening_pictures.COLOURS["lipv"]):
            rgb = np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)]) / 255
            assert (np.abs(pixels[rows] - rgb).max(axis=2) < 0.02).sum() > 50
