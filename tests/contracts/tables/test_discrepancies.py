"""What a model lacks, beside the targets: read, refused, added once."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lacli.base.errors import TableError
from lacli.contracts.tables.discrepancy import read_discrepancies
from lacli.contracts.targets import Targets, read_targets

TARGETS = """
[targets.esv_ml]
mean = 92.0
sd = 3.0
[targets.n_roof_mm]
mean = 1.0
sd = 0.3
[targets."n_septum_mm@0.2"]
mean = 0.5
sd = 0.3
[targets.d_roof_mm]
mean = 4.0
sd = 0.2
"""


def _read(folder: Path, more: str) -> Targets:
    (folder / "targets.toml").write_text(TARGETS + more)
    return read_targets(folder / "targets.toml")


def test_a_group_has_an_error_of_its_own_that_goes_together(tmp_path: Path) -> None:
    found = _read(tmp_path, "[discrepancy.n]\nsd = 0.4\ncorrelation = 0.25\n[discrepancy.n_roof_mm]\nsd = 1.2\n")
    # n_roof: .09 + .16 + 1.44; n_septum: .09 + .16; between them .25 * .16
    expected = np.diag([9.0, 1.69, 0.25, 0.04])
    expected[1, 2] = expected[2, 1] = 0.04
    assert found.covariance == pytest.approx(expected)
    assert found.sd == pytest.approx([3.0, 1.3, 0.5, 0.2]) and found.own_sd == pytest.approx([3.0, 0.3, 0.3, 0.2])


def test_volumes_are_one_group_and_no_table_changes_nothing(tmp_path: Path) -> None:
    found = _read(tmp_path, "[discrepancy.volume]\nsd = 4.0\n")
    assert found.sd == pytest.approx([5.0, 0.3, 0.3, 0.2]) and found.covariance is None
    plain = _read(tmp_path, "")
    assert plain.covariance is None and plain.errors is None and plain.sd == pytest.approx([3.0, 0.3, 0.3, 0.2])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[discrepancy.b]\nsd = 0.4\n", "of no target; there are the groups volume, n, d"),
        ("[discrepancy.n]\nsd = -1\n", "sd must be positive"),
        ("[discrepancy.n]\ncorrelation = 0.5\n", "needs a finite number for sd, found nothing|found None"),
        ("[discrepancy.n]\nsd = 1\ncorrelation = 1.0\n", "correlation must be 0 to 0.99"),
        ("[discrepancy.n]\nsd = 1\nrho = 0.5\n", "has a key rho"),
        ("[discrepancy.n]\nsd = 1e200\n", "sd 1e\\+200 tells nothing"),
        ("[discrepancy]\nn = 0.4\n", "needs a table for each group"),
    ],
)
def test_a_discrepancy_that_cannot_be_read_is_refused(tmp_path: Path, text: str, words: str) -> None:
    with pytest.raises(TableError, match=words):
        _read(tmp_path, text)


def test_without_a_table_nothing_is_lacking(tmp_path: Path) -> None:
    assert read_discrepancies(tmp_path, None, ("esv_ml",)) is None
    # esv and the course's volumes are one group
    found = read_discrepancies(tmp_path, {"volume": {"sd": 2.0, "correlation": 0.0}}, ("esv_ml", "volume_ml@0.2"))
    assert found == pytest.approx(np.diag([4.0, 4.0]))
