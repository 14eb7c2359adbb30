"""A four-chamber heart's left atrium, its tetrahedra kept or its cavity meshed anew."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from lacli.anatomy.inputs.meshes.tagged import read_mesh, read_tagged
from lacli.base.errors import AnatomyError
from lacli.contracts.bundle import check
from lacli.contracts.labels import ENDO, OPENINGS, PLANES, RINGS
from lacli.geometry import tetrahedra as cells
from lacli.geometry.surface import defects

DATA = Path(__file__).parents[4] / "shared" / "data" / "la_rodero01"
FILES = (DATA / "LA_tets_2.0mm.vtu", DATA / "LA_surfaces_2.0mm.vtp", DATA / "rodero_01_fullheart_2.0mm.namemap.json")
needs_data = pytest.mark.skipif(
    not FILES[0].is_file(), reason="needs the left atrium of Rodero et al. 2021, case 01 (see examples/rodero)"
)


@needs_data
def test_their_cells_stay_and_the_planes_close_the_cavity() -> None:
    bundle = read_tagged(*FILES, rule="simple")
    check(bundle, "rodero")
    # published with the data: 31,533 cells, cavity 68.00 mL, wall 26.09 mL
    own = bundle.region < 21
    assert own.sum() == 31533
    assert cells.volumes(bundle.points, bundle.tets)[own].sum() / 1000 == pytest.approx(26.09, abs=0.005)
    assert bundle.cavity_volume_ml() == pytest.approx(68.00, rel=3e-3)  # their caps are fans, ours smooth
    assert defects(bundle.cavity_triangles()[:, :3]) == ""
    assert (bundle.tags == ENDO).sum() == 5740
    assert set(np.unique(bundle.tags)) == {1, 2, 3, *RINGS.values(), *PLANES.values()}
    assert cells.scaled_jacobian(bundle.points, bundle.tets).min() >= 0.05


@needs_data
def test_the_cavity_meshed_anew_keeps_its_volume() -> None:
    bundle = read_tagged(*FILES, cell_size_mm=4.0)
    check(bundle, "rodero")
    quality = cells.scaled_jacobian(bundle.points, bundle.tets)
    assert quality.min() >= 0.05
    assert (quality < 0.2).mean() <= 1e-3
    volume = read_mesh(*FILES, "Left atrium").cavity.volume_ml()
    assert volume == pytest.approx(68.00, rel=5e-3)
    assert bundle.info["cavity_volume_ml"] == pytest.approx(volume, rel=3e-3)


@needs_data
def test_a_missing_name_is_named(tmp_path: Path) -> None:
    names = json.loads(FILES[2].read_text())
    table = names["_surface_id_to_name"]
    names["_surface_id_to_name"] = {k: v for k, v in table.items() if v != "left-atrium-appendage"}
    file = tmp_path / "names.json"
    file.write_text(json.dumps(names))
    with pytest.raises(AnatomyError, match="atrium-appendage"):
        read_tagged(FILES[0], FILES[1], file)
    file.write_text("{")
    with pytest.raises(AnatomyError, match="not valid JSON"):
        read_tagged(FILES[0], FILES[1], file)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(AnatomyError, match="no such file"):
        read_tagged(tmp_path / "a.vtu", tmp_path / "b.vtp", tmp_path / "c.json")
    assert len(OPENINGS) == 6
