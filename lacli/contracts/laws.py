"""The material laws of the wall, one entry each: name, constants with units and ranges, energy, stiffness at rest.

A law's stress and tangent stand in ``solvers/freefem/plugin/laws/NAME.hpp``; ``lacli verify law`` compares them with finite
differences of the energy here. C (kPa, by region) is a factor of every law's energy; alpha (by region) of the exponent of those
that have one, and of nothing else. The energies lack the bulk modulus' part, which is added to each alike (``plugin/law.hpp``).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lacli.base.arrays import FloatArray

Range = tuple[float, float]
MOST_CONSTANTS = 3


@dataclass(frozen=True)
class Constant:
    """A number of a law, one for the whole wall: ``materials.<name>`` of a scene. Fields as in contracts/parameters."""

    name: str
    symbol: str
    unit: str
    text: str
    default: float
    possible: Range
    plausible: Range
    log: bool = True


@dataclass(frozen=True)
class Law:
    """A material law.

    energy(F (3, 3), f (3,) of length 1, c, alpha, constants (3,)): kPa. modulus(c (m,), alpha (m,), constants (3,)): (m,) twice
    the shear modulus at rest, kPa. directed(constants): whether the fibre matters. script: whether FreeFEM's own language has the
    law as well (else the compiled engine alone).
    """

    name: str
    energy: Callable[[FloatArray, FloatArray, float, float, FloatArray], float]
    modulus: Callable[[FloatArray, FloatArray, FloatArray], FloatArray]
    constants: tuple[Constant, ...] = ()
    directed: Callable[[FloatArray], bool] = lambda constants: False
    script: bool = False

    def __post_init__(self) -> None:
        if len(self.constants) > MOST_CONSTANTS:
            raise ValueError(f"{self.name}: a law has at most {MOST_CONSTANTS} constants")

    @property
    def title(self) -> str:
        """The name as it is written in a sentence."""
        return self.name.replace("_", "-")


def green(F: FloatArray) -> FloatArray:
    """Green's strain (3, 3) of a deformation gradient."""
    strain: FloatArray = (F.T @ F - np.eye(3)) / 2
    return strain


def _guccione(F: FloatArray, f: FloatArray, c: float, alpha: float, b: FloatArray) -> float:
    """C/2 (exp Q - 1), Q = alpha [bf Eff^2 + 2 bft (|Ef|^2 - Eff^2) + bt (tr E^2 - 2 |Ef|^2 + Eff^2)]; Guccione et al. 1991."""
    E = green(F)
    along, squares, all_squares = float(f @ E @ f), float(np.sum((E @ f) ** 2)), float(np.sum(E * E))
    bf, bft, bt = (float(v) for v in b)
    return (
        0.5
        * c
        * float(np.expm1(alpha * (bf * along**2 + 2 * bft * (squares - along**2) + bt * (all_squares - 2 * squares + along**2))))
    )


def _neo_hookean(F: FloatArray, f: FloatArray, c: float, alpha: float, b: FloatArray) -> float:
    """C (I1 - 3) - 2 C ln J."""
    return c * float(np.sum(F * F) - 3.0 - 2.0 * np.log(np.linalg.det(F)))


_ALL: tuple[Law, ...] = (
    Law(
        "guccione",
        _guccione,
        modulus=lambda c, alpha, b: c * alpha * ((b[0] + b[1] + b[2]) / 3.0),
        constants=(
            Constant("bf", r"b_\mathrm{f}", "", "exponent along the fibre", 8.0, (1e-3, 500.0), (0.3, 80.0)),
            Constant(
                "bft", r"b_\mathrm{ft}", "", "exponent of shear between fibre and cross-fibre", 4.0, (1e-3, 500.0), (0.2, 60.0)
            ),
            Constant("bt", r"b_\mathrm{t}", "", "exponent across the fibre", 3.0, (1e-3, 500.0), (0.2, 60.0)),
        ),
        directed=lambda b: not b[0] == b[1] == b[2],
        script=True,
    ),
    Law("neo_hookean", _neo_hookean, modulus=lambda c, alpha, b: 4.0 * c, script=True),
)

LAWS: dict[str, Law] = {law.name: law for law in _ALL}
# as the engine numbers them (LAW_<name> of plugin/law.hpp)
NUMBER: dict[str, int] = {name: number for number, name in enumerate(LAWS)}
# each once, also where two laws share one
CONSTANTS: tuple[Constant, ...] = tuple({constant.name: constant for law in _ALL for constant in law.constants}.values())
RINGS_LAW = "neo_hookean"  # of the rings and planes, whatever the body's
