"""A common trunk's one plane becomes two planes with a strip of wall between them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from shapes import cut_ball

from lacli.anatomy.cuts.trunk import CARINA_MM, part
from lacli.anatomy.openings.landmarks import Opening
from lacli.contracts.labels import PLANES
from lacli.geometry.surface import Surface, check


def test_a_round_trunk_is_parted_along_its_middle() -> None:
    ball = cut_ball()  # a disc of radius sqrt(204) at z = 14
    upper, lower = PLANES["lspv"], PLANES["lipv"]
    trunk = Surface(ball.points, ball.triangles, np.where(ball.label == 21, upper, 0))
    up = np.array([0.0, 0, 1])
    one = Opening("lspv", np.array([6.0, 0, 14]), up, np.array([0.0, 0, 20]), 14.0, 1.0, "test", cap=upper)
    two = replace(one, name="lipv", centre=np.array([-6.0, 0, 14]))
    done = part(trunk, one, two)
    check(done, "parted trunk")
    assert set(done.label.tolist()) == {0, upper, lower}
    middle = done.points[done.triangles].mean(axis=1)
    assert middle[done.label == upper, 0].min() > CARINA_MM / 2 - 1e-9
    assert middle[done.label == lower, 0].max() < -CARINA_MM / 2 + 1e-9
    # half a disc less half the strip: r^2 acos(h / r) - h sqrt(r^2 - h^2) with h = 2
    r2, h = 204.0, CARINA_MM / 2
    segment = r2 * np.arccos(h / np.sqrt(r2)) - h * np.sqrt(r2 - h * h)
    for label in (upper, lower):
        assert done.areas()[done.label == label].sum() == pytest.approx(segment, rel=0.02)
    assert done.area_mm2() == pytest.approx(trunk.area_mm2(), rel=1e-6)
