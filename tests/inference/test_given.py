"""Emulators and boxes as a user's files give them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from lacli.base.errors import UsageError
from lacli.contracts.tables.table import combine
from lacli.inference.emulation.emulator import fit_emulators
from lacli.inference.emulation.emulator_set import EmulatorSet
from lacli.inference.given import box_of, box_of_inputs, selected


@pytest.fixture(scope="module")
def emulators() -> EmulatorSet:
    x = 0.5 + np.random.default_rng(5).random((25, 2)) * [3.0, 10.0]
    table = combine(pd.DataFrame(x, columns=["alpha_roof", "w"]), pd.DataFrame({"p_ml": np.log(x[:, 0]), "q_ml": x[:, 1]}))
    return EmulatorSet(table.inputs, tuple(fit_emulators(table)))


def test_outputs_are_chosen_by_name_and_order(emulators: EmulatorSet) -> None:
    assert selected(emulators, ["q_ml", "p_ml"], Path("e.npz")).outputs == ("q_ml", "p_ml")
    with pytest.raises(UsageError, match=r"e\.npz: no emulator of r_ml; there are p_ml, q_ml"):
        selected(emulators, ["r_ml"], Path("e.npz"))


def test_a_box_is_in_the_emulators_order_whatever_the_file_s(emulators: EmulatorSet, tmp_path: Path) -> None:
    file = tmp_path / "box.toml"
    file.write_text("[box]\nw = [1.0, 5.0]\nalpha_roof = [0.6, 2.0]\n")
    box = box_of(emulators, file)
    assert box.names == ("alpha_roof", "w") and box.lower.tolist() == [0.6, 1.0] and box.upper.tolist() == [2.0, 5.0]
    with pytest.raises(UsageError, match="must hold exactly the inputs alpha_roof, other"):
        box_of_inputs(("alpha_roof", "other"), file)


def test_without_a_file_known_inputs_have_published_ranges_and_others_the_runs(emulators: EmulatorSet) -> None:
    box = box_of(emulators, None)
    low, high = emulators.range()
    assert (box.lower[1], box.upper[1]) == pytest.approx((low[1], high[1]))
    assert box.lower[0] != low[0], "alpha is a known input"


def test_a_box_that_reaches_where_a_logarithm_is_not_is_refused(emulators: EmulatorSet, tmp_path: Path) -> None:
    if not emulators.log_share.any():
        pytest.skip("no input was taken as its logarithm")
    name = emulators.inputs[int(np.argmax(emulators.log_share))]
    ranges = {"alpha_roof": (0.6, 2.0), "w": (1.0, 5.0)} | {name: (-1.0, 2.0)}
    file = tmp_path / "box.toml"
    file.write_text("[box]\n" + "".join(f"{n} = [{a}, {b}]\n" for n, (a, b) in ranges.items()))
    with pytest.raises(UsageError, match=r"logarithm|not possible"):
        box_of(emulators, file)
