"""Tables of walls and meshes, and the sections of a study's page that show all of them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import lacli
from lacli.cohort import sections
from lacli.cohort.analysis.convergence import convergence
from lacli.cohort.analysis.fits import read_anatomy
from lacli.cohort.analysis.walls import over_walls, walls, windows_of
from lacli.contracts.bundle import load
from lacli.contracts.labels import BODY_REGIONS
from lacli.mechanics.numerics.error_model import model_errors, resolution

FIT = [{"feature": f"d_{r}_mm", "target": 4.0 + i, "sd": 0.3} for i, r in enumerate(BODY_REGIONS)]
FIT += [{"feature": "esv_ml", "target": 140.0, "sd": 5.0}, {"feature": "n_roof_mm@0.2", "target": 2.0, "sd": 0.3}]


@pytest.fixture(scope="module")
def bundle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("la") / "la"
    lacli.synthesize(folder, cell_size_mm=12.0, order=1)
    errors = {"esv_ml": 3.0, "d_roof_mm": 0.3, "d_septum_mm": 0.4}
    (folder / "accuracy.json").write_text(json.dumps({"entries": {"x": {"numerics": "p1_q4", "errors": errors}}}))
    return folder


def test_errors_fall_with_the_cells_as_the_model_says(bundle: Path) -> None:
    frame = pd.DataFrame(convergence("a", bundle, {"fit": FIT}))
    own = resolution(load(bundle), 1)
    here = frame[(frame["order"] == 1) & frame["own"]].set_index("source")
    told = model_errors({str(row["feature"]): row["target"] for row in FIT if "@" not in str(row["feature"])}, own)
    lengths = [value for name, value in told.items() if name.startswith("d_")]
    assert here.loc["model", "error_mm"] == pytest.approx(np.sqrt(np.mean(np.square(lengths))))
    assert here.loc["model", "cell_mm"] == pytest.approx(own.h_mm)
    # sqrt((.3^2 + .4^2) / 2)
    assert here.loc["measured", ["error_mm", "error_ml"]].tolist() == pytest.approx([0.125**0.5, 3.0])
    for _, line in frame[frame["source"] == "model"].groupby("order"):
        assert (np.diff(line.sort_values("cell_mm")["error_mm"]) > 0).all() and len(line) == 5
    assert convergence("a", bundle, {"fit": FIT[-1:]})[0]["source"] == "measured", "no motion at end-systole, no model"


def test_walls_over_the_patients(bundle: Path) -> None:
    anatomy = read_anatomy(bundle, "a")
    fat = {"wide": dict.fromkeys(BODY_REGIONS, 3.0), "standard": dict.fromkeys(BODY_REGIONS, 2.0)}
    rows = [*walls("a", anatomy, fat), *walls("b", None, {"standard": dict.fromkeys(BODY_REGIONS, 4.0)})]
    assert windows_of(pd.DataFrame(rows)) == ["standard", "wide"]
    assert walls("c", None, {}) == []
    found = {row["region"]: row for row in over_walls(rows)}
    assert (found["roof"]["fat_standard_mean_ml"], found["roof"]["fat_standard_sd_ml"]) == (3.0, pytest.approx(2.0**0.5))
    assert (found["all"]["fat_standard_mean_ml"], found["all"]["fat_wide_mean_ml"], found["all"]["fat_wide_sd_ml"]) == (
        15.0, 15.0, None,
    )  # fmt: skip
    assert found["all"]["thickness_laplace_mean_mm"] == pytest.approx(2.0, abs=0.1)
    assert anatomy is not None
    off = [abs(anatomy.laplace_mm[r] - anatomy.eikonal_mm[r]) for r in BODY_REGIONS]
    assert found["all"]["thickness_median_difference_mm"] == pytest.approx(np.median(off))


def test_sections_show_numbers_of_their_tables(bundle: Path, tmp_path: Path) -> None:
    scores = [
        {"participant_id": p, "output": o, "r2": r2, "ise": 0.95}
        for p, o, r2 in (("a", "esv_ml", 0.99), ("b", "esv_ml", 0.71), ("a", "d_roof_mm", 0.98), ("b", "d_roof_mm", 0.97))
    ]
    pd.DataFrame(scores).to_csv(tmp_path / "scores.csv", index=False)
    pd.DataFrame([{"output": "esv_ml", "r2_least": 0.71, "of": "b"}]).to_csv(tmp_path / "emulators.csv", index=False)
    waves = [{"participant_id": p, "wave": w, "nroy_share": 0.1 / w} for p in "ab" for w in (1, 2)]
    pd.DataFrame(waves).to_csv(tmp_path / "waves.csv", index=False)
    pd.DataFrame(convergence("a", bundle, {"fit": FIT})).to_csv(tmp_path / "convergence.csv", index=False)
    pd.DataFrame({"participant_id": ["a"], "bundle": [str(bundle)]}).to_csv(tmp_path / "anatomies.csv", index=False)
    pd.DataFrame({"participant_id": ["a"], "af": ["yes"]}).to_csv(tmp_path / "patients.csv", index=False)
    fat = {"standard": dict.fromkeys(BODY_REGIONS, 2.0)}
    pd.DataFrame(walls("a", read_anatomy(bundle, "a"), fat)).to_csv(tmp_path / "walls.csv", index=False)
    shares = [{"participant_id": p, "feature": "esv_ml", "by": "total effects", "alpha": 0.7, "edp_mmhg": 0.3} for p in "ab"]
    pd.DataFrame(shares).to_csv(tmp_path / "influences.csv", index=False)
    pictures = tmp_path / "figures"
    pictures.mkdir()

    emulators = sections.emulators_section(tmp_path, pictures)
    assert emulators is not None and len(emulators.figures) == 2 and ("esv_ml", "0.71", "b") in emulators.tables[0].rows
    numerics = sections.numerics_section(tmp_path, pictures)
    assert numerics is not None and len(numerics.figures) == 1
    assert any("measured" in row and "0.3536" in row for row in numerics.tables[0].rows)
    anatomies = sections.anatomies_section(tmp_path, pictures)
    assert anatomies is not None and len(anatomies.figures) == 3 and anatomies.tables[1].rows[-1][0] == "all"
    influences = sections.influences_section(tmp_path, pictures)
    assert influences is not None and len(influences.figures) == 4 and influences.tables[0].rows[0] == ("alpha", "0.7", "0.7")
    assert influences.text[0].startswith("Total effects over the box")
    assert sections.transients_section(tmp_path, pictures) is None and sections.fits_section(tmp_path, pictures) is None
    assert {f.suffix for f in pictures.iterdir()} == {".png", ".pdf", ".svg"}
