"""Small inputs that once failed, each one of a kind, through the command as its script calls it; skipped where they are not."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import lacli
from lacli.anatomy.inputs.image import read_labels, write
from lacli.contracts.bundle import load
from lacli.synthetic.atrium import cavity, sized

CASES = Path(__file__).resolve().parents[3] / "shared" / "cases"
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not CASES.is_dir(), reason="the shared cases are not beside this checkout"),
]
# exit code (None: the script ends with that of a pipe), and what must be said; numbers from each case's expected.txt
WANTED: dict[str, tuple[int | None, str]] = {
    "01_nifti_qform_sform": (None, r"two transforms that differ by 8\d\.\d mm and 30 degrees.*the sform is used"),
    "03_nifti_units_micron": (1, r"0\.0012 x 0\.0012 x 0\.0012 mm.*micrometres.*xyzt_units"),
    "05_labels_almost_integer": (0, r'"cavity_volume_ml": 12\d\.'),
    "06_label_cut_by_border": (0, r"may be cut: label 2 touches the image's anterior border .* voxels, .* cm2"),
    "07_vtk_label_volume": (1, r"holds an image .*STRUCTURED_POINTS.*not a surface"),
    "08_bundle_in_cm": (1, r"0\.125 mL .*are the lengths centimetres"),
    "09_also_msh_is_fluent": (0, r"^\$MeshFormat\n2\.2 "),
    "10_emulate_collinear": (1, r"inputs a and a2 are linearly dependent \(correlation 1.*Leave one out"),
    "12_run_id_other_order": (0, r"paired by run_id"),
    "13_status_word": (0, r"R2.*Emulators in "),
    "15_carp_tabs": (None, r"written: .*wall\.vtu"),
    "18_posterior_out_of_reach": (1, r"no point of the box reaches f|f .*455"),
    "21_nrrd_gantry_tilt": (1, r"not perpendicular.*gantry"),
    "22_nifti_sform_other_spacing": (1, r"columns of the sform are 2\.4 x 2\.4 x 2\.4 mm long, pixdim says 1\.2"),
}


def test_every_case_is_here() -> None:
    assert {path.name for path in CASES.iterdir() if path.is_dir()} == set(WANTED)


@pytest.mark.parametrize("case", WANTED)
def test_a_shared_case_behaves_as_wanted(case: str) -> None:
    code, words = WANTED[case]
    environment = {**os.environ, "LACLI": f"{sys.executable} -m lacli", "COLUMNS": "1000", "NO_COLOR": "1"}
    answer = subprocess.run(
        ["bash", str(CASES / case / "repro.sh")],
        capture_output=True, text=True, errors="replace", check=False, timeout=600, env=environment,
    )  # fmt: skip
    said = answer.stdout + answer.stderr
    assert "Traceback" not in said and not re.search(r"\bvtk[A-Z]|ERR\||itk::|Warning", answer.stderr), said[-2000:]
    assert code is None or answer.returncode == code, said[-2000:]
    assert re.search(words, said, re.DOTALL), said[-2000:]
    if code == 1:
        assert sum(line.startswith("lacli:") for line in answer.stderr.splitlines()) == 1, said[-2000:]


@pytest.mark.skipif(not CASES.is_dir(), reason="the shared cases are not beside this checkout")
def test_labels_that_are_almost_integers_are_those_integers(tmp_path: Path) -> None:
    """The same cavity as of the map that has the integers themselves."""
    source = CASES / "05_labels_almost_integer" / "heart.nii.gz"
    write(read_labels(source), tmp_path / "rounded.nrrd", np.uint8)
    volumes = []
    for file in (source, tmp_path / "rounded.nrrd"):
        folder = tmp_path / file.name.split(".")[0]
        lacli.mesh(file, folder, la=2, lv=3, cell_size_mm=6.0, order=1)
        volumes.append(load(folder).cavity_volume_ml())
    assert volumes[0] == pytest.approx(volumes[1], abs=1e-6)
    # the map is of a synthetic atrium (seed 3), whose cavity, cut as meshes are, has so much
    assert volumes[0] == pytest.approx(cavity(sized(3).at_ostia()).volume_ml(), rel=0.004)
