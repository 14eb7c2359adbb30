"""Bad input through the command line: one message that names the file, before any long work; nothing is written."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lacli.anatomy.inputs import image
from lacli.anatomy.inputs.image import Image
from lacli.base.errors import AnatomyError, InputError, LacliError, StorageError, UsageError


def refused(words: str) -> LacliError:
    """The error of a command that has to fail with one of ours."""
    from typer.testing import CliRunner

    from lacli.cli.main import build as application

    run = CliRunner().invoke(application({"mesh", "fat"}), words)
    assert isinstance(run.exception, LacliError), run.output
    return run.exception


@pytest.fixture
def labels(tmp_path: Path) -> Path:
    array = np.zeros((30, 30, 30), dtype=np.int16)
    array[4:26, 4:26, 4:26] = 2
    path = tmp_path / "labels.nrrd"
    image.write(Image(array, np.full(3, 1.5), np.zeros(3), np.eye(3)), path)
    return path


@pytest.mark.parametrize("command", ["mesh {labels} --la 2", "fat {labels} --labels {labels} --la 2"])
def test_an_output_that_cannot_be_made_is_refused_before_the_work(labels: Path, tmp_path: Path, command: str) -> None:
    (tmp_path / "file").write_text("x")
    for out in (tmp_path / "file", tmp_path / "file" / "deeper"):
        error = refused(f"{command.format(labels=labels)} --out {out}")
        assert isinstance(error, StorageError) and f"{tmp_path}/file is a file" in str(error)
    if Path("/proc/self").is_dir():  # root may write everywhere but here
        error = refused(f"{command.format(labels=labels)} --out /proc/none/deeper")
        assert isinstance(error, StorageError) and "nothing can be made in /proc" in str(error)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["file", "labels.nrrd"]


def test_other_files_and_folders_are_looked_at_before_the_work(labels: Path, tmp_path: Path) -> None:
    for also, kind, words in (
        (tmp_path / "none" / "wall.vtk", StorageError, "its folder does not exist"),
        (tmp_path / "wall.docx", UsageError, "no format of tetrahedra has the ending '.docx'"),
    ):
        error = refused(f"mesh {labels} --la 2 --out {tmp_path}/a --also {also}")
        assert isinstance(error, kind) and words in str(error) and str(also) in str(error)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("keep")
    assert "something else than a bundle" in str(refused(f"mesh {labels} --la 2 --out {tmp_path}/mine"))
    (tmp_path / "mine" / "wall.vtu").write_text("a bundle")
    assert "mine: also holds notes.txt" in str(refused(f"mesh {labels} --la 2 --out {tmp_path}/mine"))
    (tmp_path / "mine" / "notes.txt").rename(tmp_path / "mine" / "labels.nrrd")
    error = refused(f"mesh {tmp_path}/mine/labels.nrrd --la 2 --out {tmp_path}/mine")
    assert "mine/labels.nrrd: lies in" in str(error) and (tmp_path / "mine" / "labels.nrrd").read_text() == "keep"
    assert "no such file" in str(refused(f"mesh {labels} --la 2 --out {tmp_path}/a --fibres {tmp_path}/none.vtu"))
    assert not (tmp_path / "a").exists()


def test_messages_name_the_file(labels: Path, tmp_path: Path) -> None:
    split = image.read(labels)
    split.array[:, :, 14:16] = 0
    image.write(split, tmp_path / "split.nrrd")
    for command in ("mesh {0} --la 2", "fat {1} --labels {0} --la 2"):
        error = refused(f"{command.format(tmp_path / 'split.nrrd', labels)} --out {tmp_path}/a")
        assert isinstance(error, AnatomyError)
        assert str(error).startswith(f"{tmp_path}/split.nrrd: label 2 falls in 2 unconnected parts")
    error = refused(f"fat {labels} --labels {labels} --la 2 --out {tmp_path}/a")
    assert str(error).startswith(f"{labels}: the image's values run from 0 to 2: not Hounsfield units")
    assert not (tmp_path / "a").exists()


def test_a_nrrd_whose_axes_are_not_finite_is_said_plainly(labels: Path, tmp_path: Path) -> None:
    head, body = labels.read_bytes().split(b"\n\n", 1)
    assert b"space directions: (1.5," in head
    for name, found, put in (
        ("axes", b"space directions: (1.5,", b"space directions: (nan,"),
        ("origin", b"space origin: (0,", b"space origin: (inf,"),
    ):
        (tmp_path / f"{name}.nrrd").write_bytes(head.replace(found, put) + b"\n\n" + body)
        error = refused(f"mesh {tmp_path}/{name}.nrrd --la 2 --out {tmp_path}/a")
        assert isinstance(error, InputError) and "in the NRRD header has a value that is not finite" in str(error)


@pytest.mark.parametrize("ending", ["stl", "vtp", "vtk", "vtu", "ply", "obj"])
def test_text_that_is_called_a_surface_makes_one_message(tmp_path: Path, ending: str, capfd: pytest.CaptureFixture[str]) -> None:
    (tmp_path / f"text.{ending}").write_text("Dear all,\nthis is a text file\n" * 20)
    error = refused(f"mesh {tmp_path}/text.{ending} --out {tmp_path}/a")
    assert isinstance(error, InputError) and "may be truncated" in str(error)
    assert capfd.readouterr() == ("", "")  # VTK's own warnings too


def test_a_ct_without_fat_leaves_no_folder(labels: Path, tmp_path: Path) -> None:
    shape = image.read(labels)
    hu = np.where(shape.array == 2, 350.0, 40.0) + np.random.default_rng(0).normal(0, 25.0, shape.array.shape)
    image.write(shape.with_array(hu.astype(np.float32)), tmp_path / "ct.nrrd")
    error = refused(f"fat {tmp_path}/ct.nrrd --labels {labels} --la 2 --out {tmp_path}/fat")
    assert isinstance(error, AnatomyError) and str(error).startswith(f"{tmp_path}/ct.nrrd: no fat within 5 mm")
    assert not (tmp_path / "fat").exists()


@pytest.mark.parametrize("triangles", [1, 50])
def test_a_flat_surface_is_no_atrium(triangles: int, tmp_path: Path) -> None:
    import pyvista as pv

    one = pv.PolyData(np.array([[0.0, 0, 0], [60, 0, 0], [0, 60, 0]]), [3, 0, 1, 2])
    flat = one if triangles == 1 else pv.Plane(i_size=60, j_size=60, i_resolution=5, j_resolution=5).triangulate()
    flat.save(tmp_path / "s.vtp")
    error = refused(f"mesh {tmp_path / 's.vtp'} --out {tmp_path / 'out'} --no-pictures")
    assert isinstance(error, AnatomyError) and "encloses no volume" in str(error)
    assert [path.name for path in tmp_path.iterdir()] == ["s.vtp"]
