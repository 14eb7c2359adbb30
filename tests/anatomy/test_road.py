"""The whole road on a parametric atrium: image, surface, landmarks, cuts, mesh, coordinates, fibres, fat."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lacli.anatomy import build
from lacli.anatomy.coordinates import describe as coordinates
from lacli.anatomy.coordinates import fibres, regions
from lacli.anatomy.inputs import extraction, image
from lacli.anatomy.inputs.meshes import carp, meshfile
from lacli.anatomy.openings import finding, landmarks
from lacli.anatomy.wall import fat
from lacli.base.errors import AnatomyError
from lacli.contracts.bundle import check, load, save
from lacli.contracts.labels import EPI, OPENINGS, PLANES, REGIONS
from lacli.geometry import laplace
from lacli.synthetic import atrium as synthetic
from lacli.synthetic import image as synthetic_image

SEED = 2
OPTIONS = build.Options(cell_size_mm=4.0)


def quiet(_: str) -> None:
    return None


@pytest.fixture(scope="module")
def made() -> synthetic_image.SyntheticImages:
    return synthetic_image.images(SEED, spacing_mm=(0.9, 0.9, 0.9))


@pytest.fixture(scope="module")
def built(made: synthetic_image.SyntheticImages) -> build.Built:
    return build.from_labels(made.labels, synthetic_image.LA, synthetic_image.LV, OPTIONS, say=quiet)


def test_every_opening_is_found_at_its_place_and_named(built: build.Built) -> None:
    truth = {next(n for n, v in PLANES.items() if v == c.label): c for c in synthetic.sized(SEED).cuts()}
    assert set(built.landmarks.openings) == set(OPENINGS)
    for name, opening in built.landmarks.openings.items():
        # veins may be cut some mm further in or out along the vessel, not beside it
        gap = opening.centre - truth[name].centre
        along = gap @ truth[name].direction
        assert np.linalg.norm(gap - along * truth[name].direction) < 4.0, name
        assert abs(along) < 9.0, name
        assert opening.normal @ truth[name].direction > 0.8, name
        assert opening.confidence > 0.5, name


def test_volume_and_mesh(built: build.Built) -> None:
    check(built.bundle, "built")
    assert built.bundle.cavity_volume_ml() == pytest.approx(built.measures["clipped_voxel_volume_ml"], rel=0.02)
    shell = built.bundle.info["shell"]
    assert shell["scaled_jacobian_min"] > 0.05
    assert shell["scaled_jacobian_share_below_02"] < 1e-3


def test_regions_lie_where_their_names_say(built: build.Built) -> None:
    bundle = built.bundle
    centre = {n: bundle.points[bundle.tets[bundle.region == v, :4]].mean(axis=(0, 1)) for n, v in REGIONS.items()}
    # LPS: x left, y back, z head
    assert centre["lateral"][0] > centre["septum"][0] + 20
    assert centre["posterior"][1] > centre["anterior"][1] + 10
    assert centre["roof"][2] > max(centre["anterior"][2], centre["posterior"][2])


def test_a_described_bundle_described_again_is_the_same(built: build.Built) -> None:
    again = coordinates.describe(built.bundle, built.landmarks.sides).bundle
    assert (again.region == built.bundle.region).all()
    assert again.pericardium_coordinate == pytest.approx(built.bundle.pericardium_coordinate, abs=1e-9)


def test_coordinates_run_from_0_to_1_and_fibres_are_tangent(built: build.Built) -> None:
    bundle = built.bundle
    assert bundle.uac is not None and bundle.fibre is not None and bundle.pericardium_coordinate is not None
    assert np.isfinite(bundle.uac).all()
    assert bundle.uac.min() >= -1e-6 and bundle.uac.max() <= 1 + 1e-6
    assert np.linalg.norm(bundle.fibre, axis=1) == pytest.approx(1.0)
    ring = np.unique(bundle.tets[bundle.region == 11, :4])
    assert bundle.pericardium_coordinate[ring] == pytest.approx(0.0, abs=1e-12)
    # 1 on the roof as the regions have it, but for cells that its border crosses
    top = (bundle.pericardium_coordinate[bundle.tets[:, :4]] > 0.999).all(axis=1)
    body = bundle.region < 10
    in_roof = bundle.region == REGIONS["roof"]
    assert top[in_roof].mean() > 0.85 and (top & body & ~in_roof).sum() < 0.05 * in_roof.sum()
    # harmonic between them: as on the outside's own nodes, for as much as these are coarser
    outside = coordinates.layer_of(bundle, EPI)
    matrix = laplace.stiffness(laplace.gradient(outside.points, outside.triangles), len(outside.points))
    nodes = np.unique(outside.triangles)
    xi = bundle.pericardium_coordinate[nodes]
    ends = {0.0: nodes[xi < 1e-9], 1.0: nodes[xi > 1.0 - 1e-9]}
    assert np.abs(laplace.solve(matrix, ends)[nodes] - xi).mean() < 0.01
    # round the mitral rim fibres follow it: across the valve's axis
    normal = built.landmarks.openings["mv"].normal
    assert np.median(np.abs(bundle.fibre[bundle.region == 11] @ normal)) < 0.35


def test_landmarks_go_out_and_in_and_win(built: build.Built, made: synthetic_image.SyntheticImages, tmp_path: Path) -> None:
    landmarks.write(built.landmarks, tmp_path / "landmarks.toml")
    given = landmarks.read(tmp_path / "landmarks.toml")
    surface = extraction.surface_of(extraction.blood_pool(made.labels, 2).mask, grid_mm=0.9)
    moved = replace(given.openings["lspv"], centre=given.openings["lspv"].centre + 2.0 * given.openings["lspv"].normal)
    there = landmarks.Landmarks({**given.openings, "lspv": moved})
    before = build.clip(surface, finding.find(surface, [], landmarks.LPS, given).landmarks)
    after = build.clip(surface, finding.find(surface, [], landmarks.LPS, there).landmarks)
    # two millimetres more of a tube of 13 - 15 mm
    assert 150 < 1000 * (after.volume_ml() - before.volume_ml()) < 500
    (tmp_path / "bad.toml").write_text("[lspv]\ncentre = [1, 2]\nnormal = [0, 0, 1]\n")
    with pytest.raises(AnatomyError, match="three finite numbers"):
        landmarks.read(tmp_path / "bad.toml")
    (tmp_path / "odd.toml").write_text("[vein]\ncentre = [1, 2, 3]\nnormal = [0, 0, 1]\n")
    with pytest.raises(AnatomyError, match="unknown opening 'vein'"):
        landmarks.read(tmp_path / "odd.toml")


def test_a_missing_vein_is_refused(made: synthetic_image.SyntheticImages) -> None:
    cut = next(c for c in synthetic.sized(SEED).cuts() if c.label == PLANES["lipv"])
    labels = made.labels
    index = np.argwhere(labels.array == 2)
    world = labels.to_world(index[:, ::-1].astype(float))
    relative = world - cut.centre
    along = relative @ cut.direction
    away = np.linalg.norm(relative - along[:, None] * cut.direction, axis=1)
    gone = index[(along > -8.0) & (away < 14.0)]
    array = labels.array.copy()
    array[tuple(gone.T)] = 0
    with pytest.raises(AnatomyError, match=r"one vein was found on the left.*landmarks\.toml"):
        build.from_labels(labels.with_array(array), 2, 3, OPTIONS, say=quiet)


def test_fat_of_known_volume(made: synthetic_image.SyntheticImages, built: build.Built) -> None:
    pool = extraction.surface_of(extraction.blood_pool(made.labels, 2).mask)
    found = fat.segment(made.ct, pool, built.bundle)
    assert found.volume_ml == pytest.approx(made.fat_ml, rel=0.03)
    # it ends at -45 HU for -30: of what is fat and tissue it takes from 61 % fat on, not from half; and so it finds less
    assert fat.segment(made.ct, pool, None, "alternative").volume_ml == pytest.approx(0.97 * made.fat_ml, rel=0.01)
    assert sum(found.per_region_ml.values()) == pytest.approx(found.volume_ml, rel=1e-9)
    points, cells, region = fat.cells(found)
    assert len(cells) == found.mask.array.sum() == len(region)
    a, b, d, e = (points[cells[:, i]] for i in (0, 1, 3, 4))
    assert np.einsum("ij,ij->i", np.cross(b - a, d - a), e - a) == pytest.approx(0.9**3, rel=1e-6)
    with pytest.raises(AnatomyError, match="not Hounsfield"):
        fat.segment(made.labels, pool)


def test_files_of_other_tools_keep_everything(built: build.Built, tmp_path: Path) -> None:
    save(built.bundle, tmp_path / "bundle")
    again = load(tmp_path / "bundle")
    assert np.array_equal(again.tets, built.bundle.tets)
    assert again.uac == pytest.approx(built.bundle.uac)
    meshfile.write(built.bundle, tmp_path / "wall.pts")
    mesh = carp.read(tmp_path / "wall")
    corners = np.unique(built.bundle.tets[:, :4])
    assert mesh.points == pytest.approx(built.bundle.points[corners], rel=1e-14)
    assert np.array_equal(corners[mesh.cells], built.bundle.tets[:, :4])
    assert np.array_equal(mesh.tag, built.bundle.region)
    assert np.array_equal(mesh.fibre, built.bundle.fibre)
    for name in ("wall.vtk", "wall.vtu"):
        meshfile.write(built.bundle, tmp_path / name)
        centre, fibre = meshfile.read_fibres(tmp_path / name)
        assert fibre == pytest.approx(built.bundle.fibre, abs=1e-12)
        assert meshfile.carry_fibres(built.bundle, centre, fibre) == pytest.approx(built.bundle.fibre, abs=1e-12)
    with pytest.raises(AnatomyError, match="mm away"):
        meshfile.carry_fibres(built.bundle, centre + 50.0, fibre)


def test_the_uac_rule_circles_the_valve_and_steps_at_half_depth(built: build.Built) -> None:
    bundle = coordinates.describe(built.bundle, rule="uac").bundle
    assert bundle.fibre is not None and bundle.transmural is not None
    assert np.linalg.norm(bundle.fibre, axis=1) == pytest.approx(1.0)
    normal = built.landmarks.openings["mv"].normal
    assert np.median(np.abs(bundle.fibre[bundle.region == 11] @ normal)) < 0.35
    inner = fibres.bundle_direction(np.array([[0.5, 0.8]]), epicardial=False)[0]
    outer = fibres.bundle_direction(np.array([[0.5, 0.8]]), epicardial=True)[0]
    assert abs(outer[0]) > 0.99  # Bachmann's bundle runs along alpha
    assert abs(inner[1]) > 0.9


def test_region_lines() -> None:
    lines = regions.Lines(0.1, 0.55, 0.9, 0.3)
    uac = np.array([[0.05, 0.8], [0.95, 0.1], [0.5, 0.2], [0.5, 0.4], [0.5, 0.7]])
    names = ["septum", "lateral", "posterior", "roof", "anterior"]
    assert regions.of_coordinates(uac, lines).tolist() == [REGIONS[n] for n in names]


def test_the_command(made: synthetic_image.SyntheticImages, tmp_path: Path) -> None:
    from typer.testing import CliRunner

    from lacli.cli.main import build as application

    image.write(made.labels, tmp_path / "labels.nii.gz")
    run = CliRunner().invoke(
        application({"mesh"}),
        f"mesh {tmp_path}/labels.nii.gz --la 2 --lv 3 --cell-size-mm 4 --order 1 --out {tmp_path}/anatomy --no-pictures --json",
    )
    assert run.exit_code == 0, run.output
    report = json.loads(run.stdout)
    assert set(report["openings"]) == set(OPENINGS)
    assert load(tmp_path / "anatomy").order == 1
    assert (tmp_path / "anatomy" / "landmarks.toml").is_file()
