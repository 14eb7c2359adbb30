"""The laws at single points: derivatives against finite differences, homogeneous states against formulas by hand. kPa."""

from __future__ import annotations

import numpy as np

from lacli.base.arrays import FloatArray
from lacli.contracts.laws import LAWS, NUMBER, Law
from lacli.mechanics.inputs import Cell
from lacli.verification.runs import GUCCIONE, NEO_HOOKEAN, Check, compare, material, respond

# central difference of fourth order: f' = sum w_k f(k h) / h
OFFSETS = np.array([-2.0, -1.0, 1.0, 2.0])
WEIGHTS = np.array([1.0, -8.0, 8.0, -1.0]) / 12.0
STEP = 5e-4
TOLERANCE = 1e-9

C, B, KAPPA_POINTS, KAPPA_FIELD, ALPHA = 1.7, (8.0, 4.0, 3.0), 100.0, 900.0, 1.3


def difference(values: FloatArray, step: float) -> FloatArray:
    """Derivative along the axis of OFFSETS, which comes first."""
    return np.tensordot(WEIGHTS, values, axes=1) / step


def guccione_stress(
    F: FloatArray, f: FloatArray, p: float, c: float, alpha: float, b: tuple[float, float, float], kappa: float
) -> FloatArray:
    """First Piola stress (3, 3) in the axes of fibre, sheet and normal, term by term as the law is printed:
    S_ij = C/2 exp Q dQ/dE_ij, Q = alpha [bf Eff^2 + 2 bft (Efs^2 + Efn^2) + bt (Ess^2 + Enn^2 + 2 Esn^2)]."""
    E, factor, axes = _guccione_terms(F, f, b)
    S = c * alpha * np.exp(alpha * np.sum(factor * E**2)) * factor * E
    return F @ (axes.T @ S @ axes) + (kappa * np.log(np.linalg.det(F)) + p) * np.linalg.inv(F).T


def guccione_exponent(F: FloatArray, f: FloatArray, alpha: float, b: tuple[float, float, float]) -> float:
    """Q of ``guccione_stress``."""
    E, factor, _ = _guccione_terms(F, f, b)
    return float(alpha * np.sum(factor * E**2))


def _guccione_terms(F: FloatArray, f: FloatArray, b: tuple[float, float, float]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Green's strain in the axes of fibre, sheet and normal, the factor of each of its squares in Q / alpha, the axes (rows)."""
    bf, bft, bt = b
    axes = np.linalg.svd(f.reshape(1, 3))[2]
    axes[0] = f
    E = axes @ ((F.T @ F - np.eye(3)) / 2) @ axes.T
    return E, np.array([[bf, bft, bft], [bft, bt, bt], [bft, bt, bt]]), axes


def neo_hookean_stress(F: FloatArray, p: float, c: float, kappa: float) -> FloatArray:
    """First Piola stress (3, 3) of W = c (I1 - 3) - 2c ln J + kappa/2 (ln J)^2 + p ln J."""
    return 2 * c * F + (-2 * c + kappa * np.log(np.linalg.det(F)) + p) * np.linalg.inv(F).T


def homogeneous() -> dict[str, FloatArray]:
    """Deformation gradients (3, 3) that keep the volume, by name."""
    stretch, shear = 1.25, np.eye(3)
    shear[0, 1] = 0.4
    return {
        "uniaxial": np.diag([stretch, stretch**-0.5, stretch**-0.5]),
        "equibiaxial": np.diag([stretch, stretch, stretch**-2]),
        "shear": shear,
    }


def law() -> list[Check]:
    """Energy -> stress -> tangents by finite differences; homogeneous states, volume-preserving, pressure known."""
    checks = []
    random = np.random.default_rng(7)
    for name, law in LAWS.items():
        constants = np.zeros(3)
        constants[: len(law.constants)] = B if name == "guccione" else [constant.default for constant in law.constants]
        row = material(NUMBER[name], C, tuple(constants), KAPPA_POINTS, KAPPA_FIELD, ALPHA)[: Cell.STABILISATION]
        directed = law.directed(constants)
        worst = np.zeros(4)
        cpu = 0.0
        for _ in range(4):
            F, f, p = np.eye(3) + 0.15 * random.standard_normal((3, 3)), random.standard_normal(3), 20 * random.standard_normal()
            f /= np.linalg.norm(f)
            errors, spent = _derivative_errors(law, row, F, f, p)
            worst, cpu = np.maximum(worst, errors), cpu + spent
        for quantity, error in zip(("stress", "tangent", "fibre_derivative", "energy"), worst, strict=True):
            if directed or quantity != "fibre_derivative":
                checks.append(compare("law", f"{name}_{quantity}", error, 0.0, TOLERANCE, 0, cpu))
    return checks + _homogeneous_checks()


def _derivative_errors(law: Law, row: FloatArray, F: FloatArray, f: FloatArray, p: float) -> tuple[FloatArray, float]:
    """Largest differences of P, A and dP/df from finite differences, relative to the largest entry; of the energy at all
    states from that of contracts/laws with the volume's; CPU seconds."""
    count = 1 + 4 * (9 + 3)
    rows, states = np.tile(row, (count, 1)), np.tile(F, (count, 1, 1))
    rows[:, 8:11] = f
    for k in range(9):
        states[1 + 4 * k : 5 + 4 * k].reshape(4, 9)[:, k] += STEP * OFFSETS
    for k in range(3):
        rows[37 + 4 * k : 41 + 4 * k, 8 + k] += STEP * OFFSETS
    W, P, A, dPdf, cpu = respond(rows, states, np.full(count, p))
    stress = np.array([difference(W[1 + 4 * k : 5 + 4 * k], STEP) for k in range(9)]).reshape(3, 3)
    tangent = np.moveaxis(np.array([difference(P[1 + 4 * k : 5 + 4 * k], STEP) for k in range(9)]), 0, -1)
    fibre = np.moveaxis(np.array([difference(P[37 + 4 * k : 41 + 4 * k], STEP) for k in range(3)]), 0, -1)
    pairs = ((P[0], stress), (A[0].reshape(3, 3, 9), tangent), (dPdf[0], fibre))
    errors = [np.abs(exact - found).max() / max(np.abs(exact).max(), 1e-300) for exact, found in pairs]
    own = np.array([_energy(law, row, state, f, p) for state in states[:37]])
    return np.array([*errors, np.abs(W[:37] - own).max() / np.abs(own).max()]), cpu


def _energy(law: Law, row: FloatArray, F: FloatArray, f: FloatArray, p: float) -> float:
    """Of a row of the engine's table: the law's energy, and the volume's kp/2 (ln J)^2 + p ln J - p^2 / (2 kq)."""
    log_j = float(np.log(np.linalg.det(F)))
    shape = law.energy(F, f, float(row[Cell.C]), float(row[Cell.ALPHA]), row[Cell.CONSTANTS : Cell.KAPPA_POINTS])
    volume = 0.5 * row[Cell.KAPPA_POINTS] * log_j**2 + p * log_j - 0.5 * p**2 / row[Cell.KAPPA_FIELD]
    return shape + float(volume)


def _homogeneous_checks() -> list[Check]:
    """Stress P11, P12 and P33 together (the largest difference counts) in three states, fibre along x and oblique."""
    fibres = np.array([[1.0, 0.0, 0.0], [0.6, 0.48, 0.64]])
    states = homogeneous()
    cases = [(name, F, f) for name, F in states.items() for f in fibres]
    pressures = np.linspace(-3.0, 4.0, len(cases))
    checks = []
    for law_name, number in (("guccione", GUCCIONE), ("neo_hookean", NEO_HOOKEAN)):
        rows = np.array([material(number, C, B, KAPPA_POINTS, KAPPA_FIELD, ALPHA, tuple(f))[:11] for _, _, f in cases])
        _, P, _, _, cpu = respond(rows, np.array([F for _, F, _ in cases]), pressures)
        for name in states:
            worst, at = -1.0, (0.0, 0.0)
            for k, (case, F, f) in enumerate(cases):
                if case != name:
                    continue
                if number == GUCCIONE:
                    exact = guccione_stress(F, f, pressures[k], C, ALPHA, B, KAPPA_POINTS)
                else:
                    exact = neo_hookean_stress(F, pressures[k], C, KAPPA_POINTS)
                gap = np.abs(P[k] - exact) / np.abs(exact).max()
                if gap.max() > worst:
                    entry = np.unravel_index(gap.argmax(), (3, 3))
                    worst, at = float(gap.max()), (float(P[k][entry]), float(exact[entry]))
                    scale = float(np.abs(exact).max())
            checks.append(compare("law", f"{law_name}_{name}", *at, TOLERANCE, 0, cpu, scale=scale))
    return checks
