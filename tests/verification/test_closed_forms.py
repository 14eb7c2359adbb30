"""What the verification holds the simulator against is itself right: limits, and every input in one direction."""

from __future__ import annotations

import numpy as np
import pytest

from lacli.verification.prestrain import sphere_prestrain_pressure
from lacli.verification.sensitivities import INPUTS, _directions


def test_a_small_prestrain_holds_the_pressure_of_linear_elasticity() -> None:
    # e^{2c/r^3} - e^{-4c/r^3} = 6 c / r^3 + ..., so p = 24 C c int r^-4 dr = 8 C c (1/a^3 - 1/b^3)
    a, b, stiffness, c = 10.0, 12.0, 2.0, 1e-3
    exact = 8.0 * stiffness * c * (a**-3 - b**-3)
    assert sphere_prestrain_pressure(c, (a, b), stiffness) == pytest.approx(exact, rel=1e-4)
    assert sphere_prestrain_pressure(0.0, (a, b), stiffness) == 0.0
    assert sphere_prestrain_pressure(50.0, (a, b), 2 * stiffness) == pytest.approx(
        2 * sphere_prestrain_pressure(50.0, (a, b), stiffness)
    )
    thin = sphere_prestrain_pressure(
        50.0, (a, a + 1e-3), stiffness
    )  # Laplace's law: p = 2 sigma t / r, sigma = 2 C (lt^2 - lr^2)
    stretch = np.exp(50.0 / a**3)
    assert thin == pytest.approx(2.0 * 2.0 * stiffness * (stretch**2 - stretch**-4) * 1e-3 / a, rel=1e-3)


def test_every_input_is_in_one_direction_with_a_weight_of_its_own() -> None:
    weights = np.array(list(_directions().values()))
    assert weights.shape[1] == INPUTS
    assert ((weights != 0).sum(axis=0) == 1).all()
    used = np.abs(weights[weights != 0])
    assert len(np.unique(used)) == INPUTS and used.min() >= 0.5
