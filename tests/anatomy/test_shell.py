"""The wall: thickness, volume, tags and cell quality on shapes whose offset is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from shapes import HEIGHT, RADIUS, cut_ball, icosphere

from lacli.anatomy import build
from lacli.anatomy.wall.shell import mesh_shell
from lacli.base.errors import AnatomyError
from lacli.contracts.bundle import check
from lacli.contracts.labels import ENDO, EPI, OTHER
from lacli.geometry import tetrahedra as cells
from lacli.geometry.quadrature import enclosed_volume_ml
from lacli.geometry.surface import Surface, defects
from lacli.synthetic.atrium import cavity, sized


def volume_between(bundle: object) -> float:
    """Wall volume, mL: of the whole boundary, whose normals look out of the material."""
    return enclosed_volume_ml(bundle.triangles, bundle.points)  # type: ignore[attr-defined]


@pytest.mark.parametrize(("thickness", "size"), [(2.0, 4.0), (0.7, 8.0), (5.0, 4.0), (2.0, 2.0)])
def test_a_ball_gets_a_spherical_shell(thickness: float, size: float) -> None:
    bundle = mesh_shell(icosphere(RADIUS, 5), thickness, size)
    check(bundle, "ball")
    outer = RADIUS + thickness
    exact = 4 / 3 * np.pi * (outer**3 - RADIUS**3) / 1000
    assert volume_between(bundle) == pytest.approx(exact, rel=3e-3)
    away = np.linalg.norm(bundle.points[np.unique(bundle.triangles[bundle.tags == EPI])], axis=1)
    assert away == pytest.approx(outer, abs=0.02)  # corners and edge middles alike
    assert set(np.unique(bundle.tags)) == {ENDO, EPI}
    assert cells.curved_jacobian(bundle.points, bundle.tets).min() > 0.3


def test_layers_and_straight_cells() -> None:
    bundle = mesh_shell(icosphere(RADIUS, 4), 3.0, 4.0, order=1, layers=3)
    check(bundle, "ball")
    assert bundle.order == 1
    assert sorted(np.unique(bundle.transmural.round(6))) == pytest.approx([0, 1 / 3, 2 / 3, 1], abs=1e-6)
    exact = 4 / 3 * np.pi * RADIUS**3 / 1000
    assert bundle.cavity_volume_ml() == pytest.approx(exact, rel=3e-3)  # straight cells keep the volume, not the points


def test_what_processors_round_differently_makes_no_other_mesh() -> None:
    """OpenBLAS's kernels alone move the points of this surface by some 1e-14 of their size."""
    surface = cavity(sized(1))
    first = mesh_shell(surface, 2.0, 8.0)
    for seed in range(3):
        noise = 1.0 + 3e-15 * np.random.default_rng(seed).standard_normal(surface.points.shape)
        other = mesh_shell(replace(surface, points=surface.points * noise), 2.0, 8.0)
        assert (other.tets == first.tets).all()
        assert other.points == pytest.approx(first.points, abs=1e-9)


def test_a_graded_wall_is_as_thick_as_asked() -> None:
    ball = icosphere(RADIUS, 5)
    bundle = mesh_shell(ball, 2.0 + 0.05 * ball.points[:, 0], 4.0)  # 1 mm to 3 mm
    epi = bundle.points[np.unique(bundle.triangles[bundle.tags == EPI])]
    direction = epi / np.linalg.norm(epi, axis=1, keepdims=True)
    assert np.linalg.norm(epi, axis=1) - RADIUS == pytest.approx(2.0 + 0.05 * RADIUS * direction[:, 0], abs=0.05)


def test_the_plane_is_a_plate_mitred_to_the_wall() -> None:
    bundle = mesh_shell(cut_ball(), 2.0, 4.0)
    check(bundle, "cut ball")
    assert set(np.unique(bundle.region)) == {1, 11, 21}
    assert set(np.unique(bundle.tags)) == {ENDO, EPI, OTHER, 11, 21}
    assert defects(bundle.cavity_triangles()[:, :3]) == ""
    # the plate's far side is flat, 2 mm above the cut; the wall's outer side 22 mm from the centre, up to the mitre
    far = bundle.points[np.unique(bundle.triangles[bundle.tags == OTHER])]
    assert far[:, 2] == pytest.approx(HEIGHT + 2.0, abs=0.1)
    epi = np.linalg.norm(bundle.points[np.unique(bundle.triangles[bundle.tags == EPI])], axis=1)
    assert epi == pytest.approx(RADIUS + 2.0, abs=0.05)
    quality = cells.scaled_jacobian(bundle.points, bundle.tets)
    assert quality.min() > 0.15
    # ring cells sit on the rim, each outer face of the ring belongs to one of them
    faces, owner = cells.boundary_faces(bundle.tets[:, :4])
    of = dict(zip(map(tuple, np.sort(faces, axis=1).tolist()), bundle.region[owner].tolist(), strict=True))
    for tag, region in ((11, 11), (21, 21), (OTHER, 21), (EPI, 1)):
        mine = np.sort(bundle.triangles[bundle.tags == tag][:, :3], axis=1)
        assert {of[tuple(t)] for t in mine.tolist()} == {region}


def test_the_wall_stops_where_two_sides_meet() -> None:
    """A pinched ball: the groove is 3 mm wide, the wall asked 2 mm on both sides of it."""
    ball = icosphere(RADIUS, 5)
    x, rest = ball.points[:, :1], ball.points[:, 1:]
    pinch = 1 - 0.75 * np.exp(-((x / 2.5) ** 2))
    neck = Surface(np.hstack([x, rest * pinch]), ball.triangles, ball.label)
    bundle = mesh_shell(neck, 3.0, 3.0)
    check(bundle, "neck")
    assert cells.curved_jacobian(bundle.points, bundle.tets).min() > 0
    assert bundle.info["shell"]["thinned_share"] > 0


def test_straightening_one_cell_folds_none_beside_it() -> None:
    ball = icosphere(RADIUS, 4)
    bumps = 0.9 * np.random.default_rng(0).normal(size=(len(ball.points), 1))
    rough = Surface(ball.points * (1 + bumps / RADIUS), ball.triangles, ball.label)
    bundle = mesh_shell(rough, 0.5, 6.0)
    assert bundle.info["shell"]["straightened_edges"] > 100
    # 1 in a straight cell; MIN_JACOBIAN in the others
    assert cells.curved_jacobian(bundle.points, bundle.tets).min() >= 0.2


def test_an_outer_surface_replaces_the_thickness() -> None:
    ball = icosphere(RADIUS, 4)
    outer = icosphere(RADIUS + 3.0, 4)
    bundle = mesh_shell(ball, 2.0, 4.0, outer=outer)
    epi = np.linalg.norm(bundle.points[np.unique(bundle.triangles[bundle.tags == EPI][:, :3])], axis=1)
    assert epi == pytest.approx(RADIUS + 3.0, abs=0.06)


def test_where_the_outer_surface_is_out_of_reach_it_is_told() -> None:
    """Beyond z = 8 mm of a ball of 20 mm it is 9 mm away, more than 3 x 2 mm: a cap of (20 - 8) / 40 of the area."""
    ball, outer = icosphere(RADIUS, 4), icosphere(RADIUS + 3.0, 4)
    points = np.where(outer.points[:, 2:] > 8.0 * 23.0 / 20.0, outer.points * 29.0 / 23.0, outer.points)
    bundle = mesh_shell(ball, 2.0, 4.0, order=1, outer=replace(outer, points=points))
    shell = bundle.info["shell"]
    assert shell["unmet_share"] == pytest.approx(0.3, abs=0.05) and shell["unmet_at"][2] > 15.0
    epi = bundle.points[np.unique(bundle.triangles[bundle.tags == EPI][:, :3])]
    assert np.linalg.norm(epi[epi[:, 2] > 15.0], axis=1) == pytest.approx(RADIUS + 2.0, abs=0.2)
    notes: list[str] = []
    build._say_unmet(bundle, 2.0, notes)
    assert len(notes) == 1 and "its outer side as given is not 0.6 to 6 mm from the blood: the wall has 2 mm there" in notes[0]
    build._say_unmet(mesh_shell(ball, 2.0, 4.0, order=1, outer=outer), 2.0, notes)
    assert len(notes) == 1


@pytest.mark.parametrize(
    ("arguments", "words"),
    [((0.0, 4.0), "thickness"), ((np.nan, 4.0), "thickness"), ((2.0, -1.0), "cell size"), ((2.0, 4.0, 3), "order")],
)
def test_bad_arguments_are_named(arguments: tuple[float, ...], words: str) -> None:
    with pytest.raises(AnatomyError, match=words):
        mesh_shell(icosphere(RADIUS, 3), *arguments)  # type: ignore[arg-type]
