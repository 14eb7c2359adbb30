"""Laplace's equation on linear tetrahedra and triangles: the harmonic coordinates that fibres, regions and thickness rest on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix, diags
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import cg

from lacli.base.arrays import FloatArray, IntArray
from lacli.base.errors import AnatomyError


@dataclass(frozen=True)
class Gradient:
    """Constant gradients of the linear shape functions: ``shape`` (m, k, 3) in 1/mm, ``measure`` (m,) in mm3 or mm2."""

    cells: IntArray
    shape: FloatArray
    measure: FloatArray

    def of(self, field: FloatArray) -> FloatArray:
        """(n,) nodal values -> (m, 3) gradient per cell."""
        return np.einsum("mk,mkd->md", field[self.cells], self.shape)


def gradient(points: FloatArray, cells: IntArray) -> Gradient:
    """Shape-function gradients of linear tetrahedra (m, 4) or triangles (m, 3); corner columns of higher cells are enough.

    Raises AnatomyError on a cell without volume (area): its gradient does not exist.
    """
    corner = points[cells]
    edges = corner[:, 1:] - corner[:, :1]
    gram = np.einsum("mid,mjd->mij", edges, edges)
    determinant = np.linalg.det(gram)
    if np.any(determinant <= 0) or not np.isfinite(determinant).all():
        bad = int(np.argmin(np.where(np.isfinite(determinant), determinant, -np.inf)))
        raise AnatomyError(f"cell {bad} has no volume (or area); repair the mesh before solving on it.")
    dual = np.einsum("mij,mjd->mid", np.linalg.inv(gram), edges)
    shape = np.concatenate([-dual.sum(axis=1, keepdims=True), dual], axis=1)
    factor = 6.0 if cells.shape[1] == 4 else 2.0
    return Gradient(cells, shape, np.sqrt(determinant) / factor)


def stiffness(grad: Gradient, size: int) -> csr_matrix:
    """The symmetric (size, size) matrix of the integral of grad u . grad v."""
    local = np.einsum("mid,mjd,m->mij", grad.shape, grad.shape, grad.measure)
    count = grad.cells.shape[1]
    rows = np.repeat(grad.cells, count, axis=1).ravel()
    columns = np.tile(grad.cells, (1, count)).ravel()
    return coo_matrix((local.ravel(), (rows, columns)), shape=(size, size)).tocsr()


def solve(
    matrix: csr_matrix, fixed: Mapping[float, IntArray] | tuple[IntArray, FloatArray], tolerance: float = 1e-11
) -> FloatArray:
    """Harmonic field with the given values: ``fixed`` is {value: point ids}, or (point ids, values).

    Points that touch no cell get NaN. No clipping: on obtuse cells linear elements overshoot slightly, which is the
    exact discrete answer. Raises AnatomyError where a boundary set is empty, or the field is not determined.
    """
    size = matrix.shape[0]
    ids, values = _dirichlet(fixed)
    if len(ids) == 0:
        raise AnatomyError("Laplace problem without a boundary value: the boundary set is empty.")
    field = np.full(size, np.nan)
    diagonal = matrix.diagonal()
    inside = diagonal > 0
    field[ids] = values
    free = inside.copy()
    free[ids] = False
    unknown = np.flatnonzero(free)
    if len(unknown) == 0:
        return field
    known = np.unique(ids)
    # where no value is given, any constant solves the equations: the iteration would keep what it started from
    _, part = connected_components(matrix, directed=False)
    if not np.isin(part[unknown], part[known]).all():
        raise AnatomyError("Laplace problem without an answer: a part of the mesh is not connected to any boundary value.")
    rows = matrix[unknown]
    right = -(rows[:, known] @ field[known])
    system = rows[:, unknown]
    scale = 1.0 / np.sqrt(diagonal[unknown])
    scaled = diags(scale) @ system @ diags(scale)
    start = np.full(len(unknown), float(values.mean())) / scale
    answer, status = cg(scaled, right * scale, x0=start, rtol=tolerance, atol=0.0, maxiter=20 * len(unknown) + 1000)
    if status != 0 or not np.isfinite(answer).all():
        raise AnatomyError("Laplace problem without an answer: the iteration does not converge; the mesh's cells are too poor.")
    field[unknown] = answer * scale
    return field


def _dirichlet(fixed: Mapping[float, IntArray] | tuple[IntArray, FloatArray]) -> tuple[IntArray, FloatArray]:
    if isinstance(fixed, tuple):
        ids, values = fixed
        return np.asarray(ids, dtype=np.int64), np.asarray(values, dtype=np.float64)
    for value, points in fixed.items():
        if len(points) == 0:
            raise AnatomyError(f"Laplace problem: no points carry the boundary value {value:g}.")
    ids = np.concatenate([np.asarray(p, dtype=np.int64) for p in fixed.values()])
    values = np.concatenate([np.full(len(p), float(v)) for v, p in fixed.items()])
    return ids, values


def nodal(grad: Gradient, per_cell: FloatArray, size: int) -> FloatArray:
    """Volume-weighted mean of a cell field (m,) or (m, d) at the points; zero at points of no cell."""
    flat = per_cell.reshape(len(per_cell), -1)
    total = np.zeros((size, flat.shape[1]))
    weight = np.zeros(size)
    for column in grad.cells.T:
        weight += np.bincount(column, weights=grad.measure, minlength=size)
        for d in range(flat.shape[1]):
            total[:, d] += np.bincount(column, weights=grad.measure * flat[:, d], minlength=size)
    total /= np.maximum(weight, np.finfo(float).tiny)[:, None]
    return total.reshape((size, *per_cell.shape[1:]))
