"""Coordinates and fibres against other groups' published results (data beside the repository)."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from lacli.anatomy.coordinates import fibres, uac
from lacli.geometry import curves as paths

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
ATLAS, LAPLACE = DATA / "la_atlas_uac", DATA / "la_laplace_reference"


@pytest.mark.skipif(not LAPLACE.is_dir(), reason="reference fields are not beside the repository")
def test_laplace_dirichlet_rule_reproduces_the_reference() -> None:
    import pyvista as pv

    mesh = pv.read(LAPLACE / "la_input.vtu")
    points, tets = np.asarray(mesh.points, dtype=float), mesh.cells.reshape(-1, 5)[:, 1:].astype(np.int64)
    values = {"ab": (-1.0, 0.0, 1.0, 2.0), "v": (0.0, 1.0), "r": (0.0, 1.0)}
    sets = {n: {v: np.flatnonzero(np.abs(mesh.point_data[n] - v) < 1e-9) for v in vs} for n, vs in values.items()}
    fields = fibres.solve_fields(points, tets, sets)
    for name, field in fields.items():
        assert np.abs(field - mesh.point_data[name]).max() < 2e-6, name
    skin = pv.read(LAPLACE / "la_endo.vtk").clean()
    endo = cKDTree(points).query(skin.points)[1][skin.faces.reshape(-1, 4)[:, 1:]]
    ruled = fibres.laplace_dirichlet(points, tets, fields, fibres.endocardial_normals(points, tets, endo))
    assert (ruled.bundle == fibres.BODY).sum() == 33097
    assert ruled.fibre[0] == pytest.approx([0.54939723, 0.77379318, -0.31528842], abs=3e-6)
    assert np.linalg.norm(ruled.fibre, axis=1) == pytest.approx(1.0)
    assert np.abs(np.sum(ruled.fibre * ruled.across, axis=1)).max() < 1e-9


@pytest.mark.skipif(not ATLAS.is_dir(), reason="the atlas is not beside the repository")
def test_universal_coordinates_of_the_atlas() -> None:
    def table(name: str, columns: tuple[int, ...]) -> np.ndarray:
        with gzip.open(ATLAS / name, "rt") as stream:
            return np.loadtxt(stream, skiprows=1, usecols=columns)

    points = table("Labelled.pts.gz", (0, 1, 2)) / 1000
    cells = table("Labelled.elem.gz", (1, 2, 3, 4)).astype(np.int64)
    reference = table("Labelled_Coords_2D_Rescaling_v3_C.pts.gz", (0, 1))
    names = {11: "", 13: "appendage", 21: "lspv", 23: "lipv", 25: "rspv", 27: "ripv"}
    vessel = np.array([names[t] for t in cells[:, 3]])
    triangles = cells[:, :3]
    rims = paths.loops(paths.open_edges(triangles))
    assert len(rims) == 5
    mitral = max(rims, key=lambda loop: paths.perimeter(points, loop))
    marks = np.loadtxt(ATLAS / "Landmarks.txt", delimiter=",") / 1000
    own = uac.coordinates(uac.Parts(points, triangles, vessel, mitral, *marks))
    apart = np.abs(own - reference)
    # differences are due to ties between equally long ways to the mitral rim
    assert (np.median(apart, axis=0) < 0.003).all()
    assert (np.percentile(apart, 95, axis=0) < 0.02).all()
    found = np.abs(uac.coordinates(uac.Parts(points, triangles, vessel, mitral)) - reference)
    assert (np.median(found, axis=0) < 0.01).all()
    assert (np.percentile(found, 95, axis=0) < 0.08).all()
