"""The material laws: energies by hand, stiffness at rest by finite differences, and the shape of an entry."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lacli.contracts.laws import CONSTANTS, LAWS, MOST_CONSTANTS, NUMBER, RINGS_LAW, Constant, Law, green

B = np.array([8.0, 4.0, 3.0])
F_ = np.array([0.0, 0.6, 0.8])


def test_energies_by_hand() -> None:
    f = np.array([1.0, 0.0, 0.0])
    stretched = np.diag([1.2, 1.0, 1.0])  # E11 = (1.44 - 1) / 2 = .22
    assert LAWS["guccione"].energy(stretched, f, 2.0, 1.5, B) == pytest.approx(math.expm1(1.5 * 8.0 * 0.22**2))
    across = np.diag([1.0, 1.2, 1.0])
    assert LAWS["guccione"].energy(across, f, 2.0, 1.5, B) == pytest.approx(math.expm1(1.5 * 3.0 * 0.22**2))
    shear = np.array([[1.0, 0.1, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])  # E12 = .05, E22 = .005
    q = 2 * 4.0 * 0.05**2 + 3.0 * 0.005**2
    assert LAWS["guccione"].energy(shear, f, 2.0, 1.0, B) == pytest.approx(math.expm1(q))
    assert LAWS["neo_hookean"].energy(stretched, f, 3.0, 1.0, B) == pytest.approx(3.0 * 0.44 - 6.0 * math.log(1.2))


@pytest.mark.parametrize("law", LAWS.values(), ids=LAWS)
def test_rest_has_no_energy_and_rotations_change_none(law: Law) -> None:
    rng = np.random.default_rng(4)
    assert law.energy(np.eye(3), F_, 2.0, 1.3, B) == pytest.approx(0.0, abs=1e-14)
    for _ in range(5):
        deformed = np.eye(3) + 0.1 * rng.normal(size=(3, 3))
        turn = Rotation.random(rng=rng).as_matrix()
        value = law.energy(deformed, F_, 2.0, 1.3, B)
        assert law.energy(turn @ deformed, F_, 2.0, 1.3, B) == pytest.approx(value, rel=1e-9)
        assert law.energy(deformed @ turn, turn.T @ F_, 2.0, 1.3, B) == pytest.approx(value, rel=1e-9)
        assert law.energy(deformed, F_, 4.0, 1.3, B) == pytest.approx(2.0 * value), "C is a factor"
        assert value > 0 or law.name == "neo_hookean"


def test_the_modulus_is_twice_the_shear_modulus_at_rest() -> None:
    # of an isotropic wall: W = mu gamma^2 / 2 for a simple shear gamma
    gamma, equal = 1e-4, np.array([4.0, 4.0, 4.0])
    shear = np.eye(3)
    shear[0, 1] = gamma
    for law in LAWS.values():
        mu = 2.0 * law.energy(shear, F_, 1.7, 1.4, equal) / gamma**2
        found = law.modulus(np.array([1.7]), np.array([1.4]), equal)[0]
        assert found == pytest.approx(2.0 * mu, rel=1e-3), law.name


def test_green_s_strain_and_the_table_s_shape() -> None:
    assert green(np.diag([1.2, 1.0, 1.0]))[0, 0] == pytest.approx(0.22)
    assert list(NUMBER.values()) == list(range(len(LAWS))) and RINGS_LAW in LAWS
    assert [c.name for c in CONSTANTS] == list(dict.fromkeys(c.name for law in LAWS.values() for c in law.constants))
    assert LAWS["neo_hookean"].title == "neo-hookean"
    assert LAWS["guccione"].directed(B) and not LAWS["guccione"].directed(np.array([4.0, 4.0, 4.0]))
    many = tuple(Constant(f"c{i}", "", "", "", 1.0, (0, 1), (0, 1)) for i in range(MOST_CONSTANTS + 1))
    with pytest.raises(ValueError, match="at most 3 constants"):
        Law("new", LAWS["guccione"].energy, LAWS["guccione"].modulus, many)
