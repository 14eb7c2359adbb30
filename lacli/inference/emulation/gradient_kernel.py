"""Covariances of a stationary process's values and derivatives, and how they change with the length scales.

k(u, u') = s2 phi(rho), rho = 1/2 sum_j ((u_j - u'_j) / l_j)^2, phi = exp(-rho), or Matern's of smoothness 5/2. With
r = (u - u') / l and f_k = (-1)^k times the k-th derivative of phi, between the value and the derivatives times l:

    cov(y, y') = f0,  cov(y, l_b d_b y') = f1 r_b,  cov(l_a d_a y, y') = -f1 r_a,
    cov(l_a d_a y, l_b d_b y') = f1 [a = b] - f2 r_a r_b.

By log l_c, f_k changes by f_(k+1) r_c^2 and r_b by -r_b [b = c].
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from lacli.base.arrays import FloatArray, IntArray

Kind = Literal["squared_exponential", "matern52"]
KINDS: tuple[Kind, ...] = ("squared_exponential", "matern52")


def profile(kind: Kind, rho: FloatArray, count: int) -> list[FloatArray]:
    """f_0 .. f_(count - 1) at rho; where Matern's f_3 is infinite (rho = 0), 0: it only stands beside factors that vanish."""
    if kind == "squared_exponential":
        e = np.exp(-rho)
        return [e] * count
    s = np.sqrt(10.0 * rho)
    e = np.exp(-s)
    found = [(1.0 + s + s**2 / 3.0) * e, 5.0 / 3.0 * (1.0 + s) * e, 25.0 / 3.0 * e]
    if count > 3:
        found.append(np.divide(125.0 / 3.0 * e, s, out=np.zeros_like(s), where=s > 0))
    return found[:count]


def half_square(z: FloatArray, other: FloatArray) -> FloatArray:
    """rho (m, n) between points over their length scales (m, d) and (n, d)."""
    rho = 0.5 * (z**2).sum(1)[:, None] + 0.5 * (other**2).sum(1) - z @ other.T
    return np.maximum(rho, 0.0)


def blocks(kind: Kind, z: FloatArray, other: FloatArray, active: IntArray) -> FloatArray:
    """(1 + a, m, 1 + a, n): covariances over s2 of the value and the derivatives, times l, along ``active`` (a) inputs at the
    points z (m, d), over their length scales, with the same at ``other`` (n, d)."""
    a = len(active)
    f = profile(kind, half_square(z, other), 3)
    r = [z[:, None, j] - other[None, :, j] for j in active]
    result = np.empty((1 + a, len(z), 1 + a, len(other)))
    result[0, :, 0] = f[0]
    for i in range(a):
        np.multiply(f[1], r[i], out=result[0, :, 1 + i])
        np.negative(result[0, :, 1 + i], out=result[1 + i, :, 0])
        across = -f[2] * r[i]
        for b in range(i, a):
            np.multiply(across, r[b], out=result[1 + i, :, 1 + b])
            if b > i:
                result[1 + b, :, 1 + i] = result[1 + i, :, 1 + b]
        result[1 + i, :, 1 + i] += f[1]
    return result


def value_rows(kind: Kind, z: FloatArray, other: FloatArray, active: IntArray) -> FloatArray:
    """(m, 1 + a, n): covariances over s2 of values at z (m, d) with the value and the derivatives, times l, at the points
    ``other`` (n, d)."""
    f = profile(kind, half_square(z, other), 2)
    result = np.empty((len(z), 1 + len(active), len(other)))
    result[:, 0] = f[0]
    for i, j in enumerate(active):
        np.multiply(f[1], z[:, None, j] - other[None, :, j], out=result[:, 1 + i])
    return result


def length_gradient(kind: Kind, z: FloatArray, active: IntArray, weight: FloatArray) -> FloatArray:
    """Of sum(weight * ``blocks`` of z (n, d) with itself) by each log l (d,): weight (1 + a, n, 1 + a, n), symmetric; the l that
    derivatives are multiplied by are held."""
    f = profile(kind, half_square(z, z), 4)
    r = [z[:, None, j] - z[None, :, j] for j in active]
    # what stands before r_c^2, for all c at once
    common = weight[0, :, 0] * f[1]
    own = np.zeros(len(active))
    for i in range(len(active)):
        with_value = weight[1 + i, :, 0] * r[i]
        common -= 2.0 * f[2] * with_value  # and its mirror image: the sums below do not tell rows from columns
        across = np.zeros_like(common)
        for b in range(len(active)):
            across += weight[1 + i, :, 1 + b] * r[b]
        across *= r[i]
        common += f[2] * weight[1 + i, :, 1 + i] - f[3] * across
        # r_a changes by -r_a: once for each row and each column of that input
        own[i] = 2.0 * float((f[2] * across).sum() + (f[1] * with_value).sum())
    gradient = (common.sum(0) + common.sum(1)) @ z**2 - 2.0 * np.einsum("mj,mj->j", z, common @ z)
    np.add.at(gradient, active, own)
    return gradient


def mean_gradient(kind: Kind, z: FloatArray, other: FloatArray, active: IntArray, weight: FloatArray) -> FloatArray:
    """(m, d): the gradient by z (m, d) of the sum of weight (1 + a, n) times ``value_rows`` of z with ``other`` (n, d)."""
    f = profile(kind, half_square(z, other), 3)
    r = z[:, None, active] - other[None, :, active]
    common = f[1] * weight[0] + f[2] * np.einsum("mna,an->mn", r, weight[1:])
    result = common @ other - common.sum(1)[:, None] * z
    result[:, active] += f[1] @ weight[1:].T
    return result
