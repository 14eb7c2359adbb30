"""What stands in a bundle's folder: our own files give way to another bundle, those of somebody else are left alone."""

from __future__ import annotations

from pathlib import Path

import pytest
from shapes import fibrous_ball

from lacli.anatomy import opening_pictures, pictures, quality
from lacli.anatomy.bundle_folder import OURS, PICTURES, check_replaceable
from lacli.anatomy.openings import landmarks
from lacli.base.errors import AnatomyError
from lacli.contracts import bundle as contract
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
