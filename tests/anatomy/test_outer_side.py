"""The wall's outer side: a shell around a ball is as thick as asked, on folds thinner, and its cells are right way round."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from shapes import hollow_cube, icosphere

from lacli.anatomy import quality
from lacli.anatomy.remeshing.projection import Reference
from lacli.anatomy.wall.offset import offset_surface
from lacli.anatomy.wall.polish import polish
from lacli.geometry.prisms import shorter_diagonals, split_prisms
from lacli.geometry.surface import unique_edges
from lacli.geometry.tetrahedra import scaled_jacobian


@pytest.mark.parametrize("thickness", [0.5, 2.0, 6.0])
def test_a_ball_s_wall_is_as_thick_as_asked(thickness: float) -> None:
    ball = icosphere(20.0, 2)
    edges, _ = unique_edges(ball.triangles)
    found = offset_surface(ball, edges, Reference(icosphere(20.0, 4)), lambda p: np.full(len(p), thickness), None, True)
    length = np.linalg.norm(found.vector, axis=1)
    assert (length > 0.9 * thickness).all() and (length < 1.001 * thickness).all()
    assert (found.thinned == (length < 0.95 * thickness)).all(), "what is thinner than asked is told"
    assert thickness > 2.0 or not found.thinned.any()
    outward = ball.points / 20.0
    assert (np.einsum("ij,ij->i", found.vector, outward) > 0.98 * length).all()
    chord = np.linalg.norm(ball.points[edges].mean(axis=1), axis=1)
    middles = np.linalg.norm(found.middle, axis=1)
    assert (middles > chord).all() and middles == pytest.approx(20.0, abs=0.08), (
        "edges' middles are near the ball, off the chords"
    )
    n = len(ball.points)
    tets = split_prisms(ball.triangles, ball.triangles + n, found.starts)
    assert scaled_jacobian(np.vstack([ball.points, ball.points + found.vector]), tets).min() > 0.05


def test_poor_cells_of_a_shell_are_made_better_and_good_ones_stay() -> None:
    ball = icosphere(10.0, 2)
    vector = 2.0 * ball.points / 10.0
    aside = np.cross(vector[5], [0.3, 0.9, 0.1])
    vector[5] += 3.5 * aside / np.linalg.norm(aside)  # leans over its neighbours, 3 mm away
    starts = shorter_diagonals(ball.points, vector, ball.triangles, *unique_edges(ball.triangles))
    n = len(ball.points)
    tets = split_prisms(ball.triangles, ball.triangles + n, starts)
    before = scaled_jacobian(np.vstack([ball.points, ball.points + vector]), tets)
    made = polish(ball.points, vector, ball.triangles, starts, np.full(len(tets), 0.2))
    after = scaled_jacobian(np.vstack([ball.points, ball.points + made]), tets)
    assert after.min() > before.min() + 0.02
    moved = np.linalg.norm(made - vector, axis=1)
    assert (moved <= 0.5 * np.linalg.norm(vector, axis=1) + 1e-9).all()
    good = polish(ball.points, 2.0 * ball.points / 10.0, ball.triangles, starts, np.full(len(tets), 0.01))
    assert (good == 2.0 * ball.points / 10.0).all()


def test_the_report_is_text_and_json_of_the_same(tmp_path: Path) -> None:
    report = {"cells": 12, "mean_edge_mm": 3.14159265, "region_volume_ml": {"roof": 1.0}, "notes": ["a", "b"]}
    quality.write(report, tmp_path / "out")
    assert json.loads((tmp_path / "out" / "quality.json").read_text()) == report
    lines = (tmp_path / "out" / "quality.txt").read_text().splitlines()
    assert "cells                                12" in lines and "mean_edge_mm                         3.142" in lines
    assert "    roof" + " " * 33 + "1" in lines
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["quality.json", "quality.txt"]
    assert quality.pictures is not None and hollow_cube().order == 1
