"""Where fat is looked for: a label map's or a bundle's blood; and files that are written together or not at all."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from shapes import hollow_cube

from lacli.anatomy.inputs.image import Image, write
from lacli.anatomy.wall.fat import WINDOWS, Fat
from lacli.anatomy.wall.fat_files import pool_of, save
from lacli.base.errors import AnatomyError, UsageError


def found(filled: bool) -> dict[str, Fat]:
    array = np.zeros((6, 6, 6), dtype=np.uint8)
    if filled:
        array[2:4, 2:4, 2:5] = 1
    image = Image(array, np.ones(3), np.zeros(3), np.eye(3))
    return {
        name: Fat(image, np.zeros((6, 6, 6), dtype=np.int64), 0.02, 0.012 * (1 + number)) for number, name in enumerate(WINDOWS)
    }


def test_a_bundle_s_pool_is_its_cavity_looking_outward() -> None:
    cube = hollow_cube()
    surface, notes = pool_of(None, None, cube)
    assert notes == []
    assert surface.volume_ml() == pytest.approx(cube.cavity_volume_ml()) == pytest.approx(1.0)  # 10 mm cubed, positive


def test_a_label_map_s_pool_is_the_label_asked_for(tmp_path: Path) -> None:
    axis = np.arange(40) - 20.0
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
    array = np.where(x**2 + y**2 + z**2 <= 12**2, 2, 0).astype(np.uint8)
    array[0, 0, 0] = 5
    write(Image(array, np.ones(3), np.full(3, -20.0), np.eye(3)), tmp_path / "map.nrrd")
    surface, _ = pool_of(tmp_path / "map.nrrd", 2, None)
    assert surface.volume_ml() == pytest.approx(4 / 3 * np.pi * 12**3 / 1000, rel=0.02)
    with pytest.raises(UsageError, match=r"several labels: 2 \(.* mL\), 5 .*--la"):
        pool_of(tmp_path / "map.nrrd", None, None)


def test_no_fat_is_an_error_that_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(AnatomyError, match=r"ct.nrrd: no fat within 5 mm of the blood pool"):
        save(found(False), tmp_path / "out", Path("ct.nrrd"), 5.0, [])
    assert not (tmp_path / "out").exists()


def test_the_report_says_what_was_found(tmp_path: Path) -> None:
    import meshio

    report = save(found(True), tmp_path / "out", Path("ct.nrrd"), 5.0, ["a note"])
    assert json.loads((tmp_path / "out" / "fat.json").read_text()) == report
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["fat.json", "fat.vtp", "fat.vtu"]
    assert report["notes"] == ["a note"] and report["within_mm"] == 5.0
    for number, (name, bounds) in enumerate(WINDOWS.items()):
        assert report["windows"][name]["hu"] == list(bounds)
        assert report["windows"][name]["fat_ml"] == pytest.approx(0.012 * (1 + number))
    assert len(meshio.read(tmp_path / "out" / "fat.vtu").cells[0].data) == 12  # 2 x 2 x 3 voxels
