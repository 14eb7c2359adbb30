"""Material laws: energies by hand, no stress at rest, the stiffness at rest that they claim, no change under rotation."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from lacli.contracts.laws import CONSTANTS, LAWS, NUMBER, RINGS_LAW, Constant, Law, green

B = np.array([8.0, 4.0, 3.0])
F0 = np.array([0.6, 0.48, 0.64])
small = st.lists(st.floats(-0.15, 0.15), min_size=9, max_size=9)


def constants(law: Law) -> np.ndarray:
    return np.array([constant.default for constant in law.constants] + [0.0] * (3 - len(law.constants)))


def test_values_by_hand() -> None:
    along = np.diag([1.2, 1.0, 1.0])
    assert green(along)[0, 0] == pytest.approx(0.22)  # (1.44 - 1) / 2
    # Q = alpha bf E^2 = 2 x 8 x .0484; C/2 (exp Q - 1)
    fibre = np.array([1.0, 0, 0])
    assert LAWS["guccione"].energy(along, fibre, 1.7, 2.0, B) == pytest.approx(0.85 * np.expm1(2 * 8 * 0.0484))
    # across the fibre bt counts, in shear bft twice
    assert LAWS["guccione"].energy(along, np.array([0.0, 1, 0]), 1.7, 2.0, B) == pytest.approx(0.85 * np.expm1(2 * 3 * 0.0484))
    # I1 - 3 = .44, J = 1.2
    assert LAWS["neo_hookean"].energy(along, fibre, 7.45, 1.0, B) == pytest.approx(7.45 * (0.44 - 2 * np.log(1.2)))


@pytest.mark.parametrize("name", sorted(LAWS))
def test_at_rest_there_is_no_energy_no_stress_and_the_modulus_that_is_claimed(name: str) -> None:
    law = LAWS[name]
    b = constants(law)
    at = lambda F: law.energy(F, F0, 1.7, 1.3, b)  # noqa: E731
    assert at(np.eye(3)) == 0.0
    h = 1e-4
    for i in range(3):
        for j in range(3):
            e = np.zeros((3, 3))
            e[i, j] = h
            assert (at(np.eye(3) + e) - at(np.eye(3) - e)) / (2 * h) == pytest.approx(0.0, abs=1e-6)
    # without a fibre: under a small traceless strain e the energy is mu e:e, and the modulus twice mu
    even = np.array([4.0, 4.0, 4.0]) if law.constants else b
    e = 1e-3 * np.diag([1.0, -0.5, -0.5])
    shear = law.energy(np.eye(3) + e, F0, 1.7, 1.3, even) + law.energy(np.eye(3) - e, F0, 1.7, 1.3, even)
    claimed = law.modulus(np.array([1.7]), np.array([1.3]), even)[0]
    assert shear / (e**2).sum() == pytest.approx(claimed, rel=1e-4)


@pytest.mark.parametrize("name", sorted(LAWS))
@given(values=small, turn=st.lists(st.floats(-3, 3), min_size=3, max_size=3))
def test_a_rotation_of_the_deformed_or_of_the_whole_changes_nothing(name: str, values: list[float], turn: list[float]) -> None:
    law = LAWS[name]
    b = constants(law)
    F, R = np.eye(3) + np.reshape(values, (3, 3)), Rotation.from_rotvec(turn).as_matrix()
    energy = law.energy(F, F0, 1.7, 1.3, b)
    assert law.energy(R @ F, F0, 1.7, 1.3, b) == pytest.approx(energy, rel=1e-9, abs=1e-10)
    assert law.energy(R @ F @ R.T, R @ F0, 1.7, 1.3, b) == pytest.approx(energy, rel=1e-9, abs=1e-10)
    assert energy >= -1e-12
    assert law.energy(F, F0, 3.4, 1.3, b) == pytest.approx(2 * energy)  # C is a factor


def test_the_fibre_matters_where_it_is_said_to() -> None:
    stretched = np.diag([1.2, 0.9, 1.0])
    for law in LAWS.values():
        for b in (B, np.array([4.0, 4.0, 4.0])):
            ends = [law.energy(stretched, np.eye(3)[i], 1.0, 1.0, b) for i in range(3)]
            assert (np.ptp(ends) > 1e-9) == law.directed(b)


def test_the_table_is_whole() -> None:
    assert list(NUMBER.values()) == list(range(len(LAWS))) and RINGS_LAW in LAWS
    assert len({c.name for c in CONSTANTS}) == len(CONSTANTS)
    for c in CONSTANTS:
        assert c.possible[0] <= c.plausible[0] <= c.default <= c.plausible[1] <= c.possible[1]
    one = Constant("a", "a", "", "a", 1.0, (0, 2), (0, 2))
    with pytest.raises(ValueError, match="at most 3 constants"):
        Law("four", LAWS["guccione"].energy, LAWS["guccione"].modulus, (one,) * 4)
