"""What stands in a bundle's folder: our own files give way to another bundle, those of somebody else are left alone."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from shapes import fibrous_ball

from lacli.anatomy import opening_pictures, pictures, quality
from lacli.anatomy.bundle_folder import FILES, IMAGES, OURS, PICTURES, check_inputs, check_replaceable
from lacli.anatomy.openings import landmarks
from lacli.base.errors import AnatomyError, UsageError
from lacli.contracts import bundle as contract
from lacli.contracts.identity import file_digest
from lacli.contracts.motion import FILE as MOTION
from lacli.mechanics.numerics.accuracy import FILE as ACCURACY


def test_all_that_is_written_into_a_bundles_folder_gives_way_to_another(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drawings = [(pictures, name) for name in ("square", "regions", "fibres", "thickness", "cuts")]
    for module, name in [*drawings, (opening_pictures, "bundle_picture")]:
        monkeypatch.setattr(module, name, lambda *given: given[-1].write_bytes(b"a picture"))
    bundle = fibrous_ball(1)
    contract.save(bundle, tmp_path)
    landmarks.write(landmarks.Landmarks({}, {}), tmp_path / "landmarks.toml")
    quality.write({}, tmp_path)
    assert tuple(quality.draw(tmp_path)) == PICTURES
    for name in (MOTION, ACCURACY):
        (tmp_path / name).write_text("written later")
    assert {file.name for file in tmp_path.iterdir()} <= OURS
    check_replaceable(tmp_path)
    (tmp_path / "notes.txt").write_text("keep")
    with pytest.raises(AnatomyError, match=r"also holds notes\.txt, and would be replaced whole"):
        check_replaceable(tmp_path)
    check_replaceable(tmp_path, ["notes.txt"])


def test_images_that_nobody_synthesized_with_the_bundle_are_kept(tmp_path: Path) -> None:
    for name in IMAGES:
        (tmp_path / name).write_bytes(name.encode())
    (tmp_path / "anatomy.json").write_text("{}")
    with pytest.raises(AnatomyError, match=r"also holds ct\.nrrd, labels\.nrrd"):
        check_replaceable(tmp_path)
    (tmp_path / "anatomy.json").write_text(json.dumps({FILES: {name: file_digest(tmp_path / name) for name in IMAGES}}))
    check_replaceable(tmp_path)
    (tmp_path / "labels.nrrd").write_bytes(b"corrected by hand")
    with pytest.raises(AnatomyError, match=r"also holds labels\.nrrd,"):
        check_replaceable(tmp_path)


def test_an_input_in_the_folder_that_is_replaced_or_written_over_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    folder, source = tmp_path / "a", Path("a") / "labels.nrrd"
    folder.mkdir()
    (tmp_path / "link").symlink_to(folder)
    for place in (folder, Path("a"), Path("link")):
        with pytest.raises(UsageError, match=r"a/labels\.nrrd: lies in .*, which is replaced whole; choose another --out"):
            check_inputs(place, [source], [])
    with pytest.raises(UsageError, match="is an input, and would be written over; choose another --also"):
        check_inputs(tmp_path / "b", [source], [folder / "labels.nrrd"])
    check_inputs(tmp_path / "b", [source], [tmp_path / "wall.vtk"])
