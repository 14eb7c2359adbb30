"""What a table or a file says is taken as it stands, or refused: no cell, key or sign is turned into another without a word."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lacli.base.errors import InputError, StorageError, TableError
from lacli.base.files import check_file
from lacli.cohort.analysis.observations import read_observations
from lacli.cohort.analysis.statistics import statistics
from lacli.cohort.participants import read_participants
from lacli.contracts.priors import Prior, prior_sd
from lacli.contracts.tables.file import read_frame
from lacli.contracts.tables.table import read_runs
from lacli.contracts.targets import read_targets

TARGET = "[targets.esv_ml]\nmean = 90.0\nsd = 4.0\n"


@pytest.fixture
def patients(tmp_path: Path) -> Path:
    (tmp_path / "7").mkdir()
    (tmp_path / "007").mkdir()
    (tmp_path / "t.toml").write_text(TARGET)
    return tmp_path


@pytest.mark.parametrize("names", [("001", "002"), ("1e3", "2e3"), ("1.10", "1.1"), ("007", "7")])
def test_identifiers_and_paths_of_participants_are_words(patients: Path, names: tuple[str, str]) -> None:
    table = patients / "participants.csv"
    table.write_text("participant_id,bundle,targets,age\n" + "".join(f"{n},007,t.toml,63\n" for n in names))
    found = read_participants(table)
    assert tuple(p.identifier for p in found) == names
    assert {p.paths["bundle"].name for p in found} == {"007"}


@pytest.mark.parametrize("start", ["   \n", "\t\r\n \r\n", "\n\n  \n"])
def test_lines_of_blanks_before_the_header_are_empty_ones(tmp_path: Path, start: str) -> None:
    (tmp_path / "t.csv").write_text(start + "a, b,c\n1,2,3\n", newline="")
    frame = read_frame(tmp_path / "t.csv")
    assert list(frame.columns) == ["a", "b", "c"] and frame.iloc[0].tolist() == [1, 2, 3]


@pytest.mark.parametrize("line", ['covarience = "c.npz"', 'Covariance = "c.npz"', "correlation = 0.5"])
def test_a_key_beside_the_targets_that_is_not_read_is_refused(tmp_path: Path, line: str) -> None:
    (tmp_path / "t.toml").write_text(f"es_time = 0.4\nnearest_frame_to_es = 0.01\n{TARGET}")
    assert read_targets(tmp_path / "t.toml").names == ("esv_ml",)
    (tmp_path / "t.toml").write_text(f"{line}\n{TARGET}")
    with pytest.raises(TableError, match=f"{line.split()[0]} at the top is not read; there may stand covariance"):
        read_targets(tmp_path / "t.toml")


@pytest.mark.parametrize(
    ("prior", "words"),
    [
        ('distribution = ["normal"]\nmean = 3\nsd = 1', "distribution is"),
        ("mean = 3\nsd = 1e-13", "nothing is known so exactly"),
        ('distribution = "lognormal"\nmean = 3\nsd = 1e160', "more than 1000 times as much"),
        ('distribution = "lognormal"\nmean = 3\nsd = 1e-170', "nothing is known so exactly"),
    ],
)
def test_priors_that_cannot_be_calculated_with_are_refused(tmp_path: Path, prior: str, words: str) -> None:
    (tmp_path / "t.toml").write_text(f"{TARGET}[priors.a_kpa]\n{prior}\n")
    with pytest.raises(TableError, match=words):
        read_targets(tmp_path / "t.toml")


@pytest.mark.parametrize("kind", ["normal", "lognormal"])
def test_a_narrow_prior_keeps_its_sd_in_a_wide_box(kind: str) -> None:
    """Ten times the box's slices, a tenth of them, and the narrowest that is read."""
    for sd in (5e-2, 5e-5, 3e-6):
        prior = Prior("a", kind, 3.0, sd)  # type: ignore[arg-type]
        assert prior_sd([prior], ("a",), np.array([0.0]), np.array([100.0])) == pytest.approx(sd, rel=1e-3)


def test_a_negative_standard_deviation_of_a_run_is_no_positive_one(tmp_path: Path) -> None:
    (tmp_path / "x.csv").write_text("a_kpa\n1\n2\n3\n")
    (tmp_path / "y.csv").write_text("d_mm,d_mm_sd\n1,0.1\n2,-0.1\n3,0.1\n")
    with pytest.raises(TableError, match="d_mm_sd, row 2 holds a negative standard deviation of d_mm"):
        read_runs(tmp_path / "x.csv", tmp_path / "y.csv")


def test_an_output_that_is_named_twice_is_one(tmp_path: Path) -> None:
    (tmp_path / "x.csv").write_text("a_kpa\n" + "".join(f"{i}\n" for i in range(8)))
    (tmp_path / "y.csv").write_text("d_mm,v_ml\n" + "".join(f"{i * i},{2 + i}\n" for i in range(8)))
    assert tuple(read_runs(tmp_path / "x.csv", tmp_path / "y.csv", ["d_mm", "d_mm"]).outputs) == ("d_mm",)


def study(path: Path, cells: list[str], regions: tuple[str, ...] = ("roof", "septum")) -> Path:
    rows = [f"p{i},{r},{cell},{1 + 0.1 * i * len(r)}\n" for i, cell in enumerate(cells) for r in regions]
    path.write_text("participant_id,region,d_mm,thickness_mm\n" + "".join(rows))
    return path


@pytest.mark.parametrize(
    ("cells", "words"),
    [
        (["True", "False"] * 3, "holds True and False"),
        (["1" + "0" * 400] * 6, "not a finite number"),
        (["1e200"] * 6, "too large"),
    ],
)
def test_what_is_no_number_is_not_counted_with(tmp_path: Path, cells: list[str], words: str) -> None:
    with pytest.raises(TableError, match=words):
        read_observations(study(tmp_path / "s.csv", cells), ["d_mm", "thickness_mm"])


def test_one_region_has_no_mixed_model(tmp_path: Path) -> None:
    observed = read_observations(study(tmp_path / "s.csv", ["1.0", "2.5", "2.0", "3.1"], ("roof",)), ["d_mm", "thickness_mm"])
    with pytest.raises(InputError, match="one region; a mixed model needs two at least"):
        statistics(observed, "d_mm", ["thickness_mm"])


def test_no_input_and_no_file_of_another_kind_is_written_over(tmp_path: Path) -> None:
    table, archive = tmp_path / "runs.csv", tmp_path / "emulators.npz"
    table.write_text("a\n1\n")
    archive.write_bytes(b"PK\x03\x04")
    check_file(archive, table, None, begins=b"PK")
    check_file(tmp_path / "new.npz", table, begins=b"PK")
    with pytest.raises(StorageError, match="is an input, and would be written over"):
        check_file(tmp_path / "." / "runs.csv", table)
    with pytest.raises(StorageError, match="another kind of file"):
        check_file(table, begins=b"PK")


@pytest.mark.parametrize(("shift", "factor"), [(0.0, 1.0), (100.0, 1.0), (0.0, 0.1)])
def test_draws_of_another_posterior_are_refused(tmp_path: Path, shift: float, factor: float) -> None:
    table = study(tmp_path / "s.csv", ["1.0", "2.5", "2.0"])
    frame = read_frame(table)
    rng = np.random.default_rng(1)
    rows = [
        f"{p},{r},{k},{factor * (t + 0.01 * rng.standard_normal()) + shift}\n"
        for k in range(60)
        for p, r, t in zip(frame["participant_id"], frame["region"], frame["thickness_mm"], strict=True)
    ]
    (tmp_path / "draws.csv").write_text("participant_id,region,draw,thickness_mm\n" + "".join(rows))
    if (shift, factor) == (0.0, 1.0):
        assert "thickness_mm" in read_observations(table, ["d_mm", "thickness_mm"], draws=tmp_path / "draws.csv").draws
        return
    with pytest.raises(TableError, match=r"draws of thickness_mm of p\d, \w+ are .*: they are of another posterior"):
        read_observations(table, ["d_mm", "thickness_mm"], draws=tmp_path / "draws.csv")


def test_identifiers_of_a_study_s_table_are_words(tmp_path: Path) -> None:
    (tmp_path / "s.csv").write_text("participant_id,region,d_mm\n" + "".join(f"00{i},{r},{i}\n" for i in (1, 2) for r in (1, 2)))
    observed = read_observations(tmp_path / "s.csv", ["d_mm"])
    assert observed.patients == ("001", "002") and observed.regions == ("1", "2")


def test_a_participant_is_the_same_in_every_table(tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text("participant_id ,age\n007,63\n1e3,\n")
    frame = read_frame(tmp_path / "t.csv")
    assert frame["participant_id"].tolist() == ["007", "1e3"] and frame["age"].iloc[0] == 63
