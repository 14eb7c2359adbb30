"""Quadrature over straight or curved triangles: shape functions, and the geometry of a surface at the quadrature points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lacli.base.arrays import FloatArray, IntArray

# Radon's 7 points, degree 5: exact for the volume below a quadratic map
_S = np.sqrt(15.0)
_A, _B = (6 - _S) / 21, (6 + _S) / 21
_POINTS = np.array(
    [[1 / 3, 1 / 3], [_A, _A], [1 - 2 * _A, _A], [_A, 1 - 2 * _A], [_B, _B], [1 - 2 * _B, _B], [_B, 1 - 2 * _B]], dtype=np.float64
)
_WEIGHTS = np.array([9 / 80] + [(155 - _S) / 2400] * 3 + [(155 + _S) / 2400] * 3)


@dataclass(frozen=True)
class TriangleShapes:
    """Shape functions (q, k) and their derivatives at the quadrature points; weights (q,) sum to 1/2."""

    value: FloatArray
    d1: FloatArray
    d2: FloatArray
    weight: FloatArray


def triangle_shapes(nodes: int) -> TriangleShapes:
    """Of a 3- or 6-node triangle in VTK's order (corners, middles of 01, 12, 20)."""
    r, s = _POINTS.T
    t = 1 - r - s
    one, zero = np.ones_like(r), np.zeros_like(r)
    if nodes == 3:
        value, d1, d2 = [t, r, s], [-one, one, zero], [-one, zero, one]
    else:
        value = [t * (2 * t - 1), r * (2 * r - 1), s * (2 * s - 1), 4 * t * r, 4 * r * s, 4 * s * t]
        d1 = [1 - 4 * t, 4 * r - 1, zero, 4 * (t - r), 4 * s, -4 * s]
        d2 = [1 - 4 * t, zero, 4 * s - 1, -4 * r, 4 * r, 4 * (t - s)]
    return TriangleShapes(np.stack(value, 1), np.stack(d1, 1), np.stack(d2, 1), _WEIGHTS)


def at_quadrature(triangles: IntArray, values: FloatArray) -> FloatArray:
    """Nodal values (n, ...) at the quadrature points of the triangles (t, 3 or 6): (t, q, ...)."""
    return np.einsum("qk,tk...->tq...", triangle_shapes(triangles.shape[1]).value, values[triangles])


def tangents(triangles: IntArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Derivatives of nodal values (n, ...) along the triangles' two parameters at the quadrature points: twice (t, q, ...)."""
    shapes = triangle_shapes(triangles.shape[1])
    nodes = values[triangles]
    return np.einsum("qk,tk...->tq...", shapes.d1, nodes), np.einsum("qk,tk...->tq...", shapes.d2, nodes)


def area_vectors(triangles: IntArray, points: FloatArray) -> FloatArray:
    """Normal times area element (t, q, 3) mm2 at the quadrature points, weights included: its norms sum to the area."""
    d1, d2 = tangents(triangles, points)
    return np.cross(d1, d2) * triangle_shapes(triangles.shape[1]).weight[:, None]


def enclosed_volume_ml(triangles: IntArray, points: FloatArray) -> float:
    """Volume, mL, that closed triangles (t, 3 or 6) with normals outward enclose; curved triangles integrated exactly."""
    return float(np.einsum("tqi,tqi->", at_quadrature(triangles, points), area_vectors(triangles, points)) / 3.0 / 1000.0)
