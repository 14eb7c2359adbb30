"""``lacli synthesize``: writes, keeps what is finished, refuses folders that are not its own."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from lacli.anatomy.inputs.image import read
from lacli.base.errors import AnatomyError, InputError, StorageError, UsageError
from lacli.cli.main import build
from lacli.contracts.bundle import load
from lacli.contracts.motion import load_motion


def run(*arguments: str) -> str:
    result = CliRunner().invoke(build({"synthesize"}), ["synthesize", *arguments], catch_exceptions=False)
    assert result.exit_code == 0
    return result.stdout


def test_a_cohort_is_written_and_resumed(tmp_path: Path) -> None:
    options = [str(tmp_path / "c"), "--cohort", "2", "--cell-size-mm", "8", "--volume-ml", "60", "--frames", "20", "--json"]
    rows = json.loads(run(*options))
    assert [row["seed"] for row in rows] == [1, 2]
    for row in rows:
        folder = Path(row["folder"])
        assert row["cavity_volume_ml"] == pytest.approx(60.0, rel=5e-3)
        bundle = load(folder)
        assert len(bundle.tets) == row["cells"]
        assert len(load_motion(folder).times) == 20
    times = {f: f.stat().st_mtime_ns for f in tmp_path.rglob("wall.vtu")}
    assert len(times) == 2
    (tmp_path / "c" / "la02" / "motion.npz").unlink()  # an unfinished one is made again, the other kept
    assert json.loads(run(*options)) == rows
    changed = [f.parent.name for f, t in times.items() if f.stat().st_mtime_ns != t]
    assert changed == ["la02"]
    assert not list(tmp_path.rglob("*.partial"))


def test_a_folder_of_somebody_else_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("thesis")
    with pytest.raises(AnatomyError, match="was not written by"):
        run(str(tmp_path))
    assert (tmp_path / "mine.txt").read_text() == "thesis"


def test_files_of_somebody_else_beside_a_bundle_are_not_removed_with_it(tmp_path: Path) -> None:
    options = [str(tmp_path / "la"), "--cell-size-mm", "8", "--order", "1"]
    run(*options)
    (tmp_path / "la" / "scene.toml").write_text("mine")
    run(*options)  # the same again removes nothing
    with pytest.raises(AnatomyError, match=r"la: also holds scene\.toml, .* choose another folder"):
        run(*options, "--seed", "2")
    assert (tmp_path / "la" / "scene.toml").read_text() == "mine"


@pytest.mark.parametrize("descent", ["nan", "inf", "-1"])
def test_a_descent_that_is_none_is_refused(descent: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="annulus"):
        run(str(tmp_path / "la"), "--cell-size-mm", "8", "--order", "1", "--descent-mm", descent)
    assert not list(tmp_path.iterdir())


def test_an_output_that_cannot_be_made_is_refused_before_the_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lacli.synthetic.atrium.synthesize", None)
    (tmp_path / "file").write_text("x")
    for arguments in ([str(tmp_path / "file" / "la")], [str(tmp_path / "file"), "--cohort", "2"]):
        with pytest.raises(StorageError, match="is a file"):
            run(*arguments)


def test_images_come_with_it(tmp_path: Path) -> None:
    options = ["--cell-size-mm", "8", "--volume-ml", "50", "--image", "--voxel-mm", "2.5", "--json"]
    (row,) = json.loads(run(str(tmp_path / "a"), *options))
    labels, ct = (read(tmp_path / "a" / f"{name}.nrrd") for name in ("labels", "ct"))
    assert labels.array.shape == ct.array.shape
    # the blood with its uncut veins is more than the clipped cavity, by four veins and an appendage of some mL each
    pool = float((labels.array == 2).sum()) * labels.voxel_ml
    assert pool == pytest.approx(row["image_pool_ml"], rel=1e-6)
    assert 50 < pool < 85
    assert row["image_fat_ml"] > 1


@pytest.mark.parametrize(
    "options",
    [["--frames", "3"], ["--noise-hu", "-1"], ["--heart-rate", "0"], ["--parameter", "alpha_roof"], ["--parameter", "a=1"]],
)
def test_a_gated_case_that_cannot_be_is_refused_before_anything_is_made(tmp_path: Path, options: list[str]) -> None:
    with pytest.raises(UsageError):
        run(str(tmp_path / "p"), "--gated", *options)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_a_gated_case_has_frames_and_a_truth_that_fits_them(tmp_path: Path) -> None:
    """End-diastole is the bundle itself; the volume rises to the truth's ES; blood is where the truth says."""
    options = [str(tmp_path / "p"), "--gated", "--frames", "4", "--voxel-mm", "2", "--cell-size-mm", "8", "--order", "1"]
    row = json.loads(run(*options, "--volume-ml", "45", "--json"))[0]
    assert row["esv_ml"] > 1.1 * row["edv_ml"]
    frames = sorted((tmp_path / "p" / "frames").iterdir())
    assert len(frames) == 4
    with np.load(tmp_path / "p" / "truth" / "points.npz") as truth:
        assert np.abs(truth["positions"][0] - load(tmp_path / "p" / "bundle").points[truth["point"]]).max() < 1e-9
    assert json.loads(run(*options, "--volume-ml", "45", "--json"))[0]["esv_ml"] == row["esv_ml"]
