"""Where the Guccione law stops being monotone, which is where a prestrain, or any equilibrium, may fold or not be unique.

    python benchmarks/monotonicity.py [--alpha 0.125 0.5 1 4] [--exponents 0.5 1 2 4 6] [--samples 200]

For random volume-preserving stretches exp(e), scaled until the law's exponent Q has a given value, the fibre of the deformed wall
being given: the tangent d sigma / d e of the Cauchy stress on volume-preserving strains. Printed is the share of stretches with
a direction in which more strain meets less stress (its symmetric part is not positive), by alpha and Q. Stresses grow as
C alpha exp(Q): softer walls reach larger Q under the same pressure, and at small alpha the same Q is a larger strain.
"""

from __future__ import annotations

import argparse

import numpy as np
from scipy.optimize import brentq

from lacli.base.arrays import FloatArray
from lacli.verification.laws import B, guccione_exponent, guccione_stress

FIBRE = np.array([1.0, 0.0, 0.0])
# an orthonormal basis (5, 3, 3) of symmetric matrices without trace
TRACELESS = np.array(
    [np.diag(v) for v in ((1 / np.sqrt(2), -1 / np.sqrt(2), 0.0), (1 / np.sqrt(6), 1 / np.sqrt(6), -2 / np.sqrt(6)))]
    + [
        (np.eye(3)[:, [i]] @ np.eye(3)[[j]] + np.eye(3)[:, [j]] @ np.eye(3)[[i]]) / np.sqrt(2)
        for i, j in ((0, 1), (0, 2), (1, 2))
    ]
)


def stretch(e: FloatArray) -> tuple[FloatArray, FloatArray]:
    """exp(e) of a symmetric e (3, 3), and the fibre of the unstrained wall that becomes FIBRE's direction."""
    value, vector = np.linalg.eigh(e)
    fibre = vector @ (np.exp(-value) * (vector.T @ FIBRE))
    return (vector * np.exp(value)) @ vector.T, fibre / np.linalg.norm(fibre)


def excess(size: float, direction: FloatArray, alpha: float, q: float) -> float:
    """How far the exponent Q at the stretch exp(size direction) is above ``q``."""
    U, f = stretch(size * direction)
    return guccione_exponent(U, f, alpha, B) - q


def stress(e: FloatArray, alpha: float) -> FloatArray:
    """Cauchy stress (3, 3) over C at the stretch exp(e) of no volume change, without its pressure."""
    U, f = stretch(e)
    return guccione_stress(U, f, 0.0, 1.0, alpha, B, 0.0) @ U


def least(e: FloatArray, alpha: float, step: float = 1e-6) -> float:
    """Smallest eigenvalue of the symmetric part of d sigma / d e on strains without trace, over the largest."""
    change = np.array([(stress(e + step * d, alpha) - stress(e - step * d, alpha)) / (2 * step) for d in TRACELESS])
    tangent = np.einsum("aij,bij->ab", TRACELESS, change)
    value = np.linalg.eigvalsh((tangent + tangent.T) / 2)
    return float(value[0] / value[-1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--alpha", type=float, nargs="+", default=[0.125, 0.5, 1.0, 4.0])
    parser.add_argument("--exponents", type=float, nargs="+", default=[0.5, 1.0, 2.0, 4.0, 6.0])
    parser.add_argument("--samples", type=int, default=200)
    choice = parser.parse_args()
    random = np.random.default_rng(0)
    directions = np.einsum("na,aij->nij", random.standard_normal((choice.samples, 5)), TRACELESS)
    print("share of stretches (%) where the law is not monotone\n alpha " + "".join(f"     Q {q:<4g}" for q in choice.exponents))
    for alpha in choice.alpha:
        shares = []
        for q in choice.exponents:
            lost = 0
            for d in directions:
                size = brentq(excess, 0.0, 4.0 / np.linalg.norm(d), args=(d, alpha, q))
                lost += least(size * d, alpha) <= 0
            shares.append(100 * lost / len(directions))
        print(f"{alpha:6g} " + "".join(f"{share:10.1f} " for share in shares), flush=True)


if __name__ == "__main__":
    main()
