"""Features of a deformed endocardium: cavity volume, displacement and its components, area and fibre strain, per region.

Image and simulation are measured by the same functions on the same curved faces. All lengths mm.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lacli.base.arrays import FloatArray, IntArray
from lacli.contracts.bundle import Bundle
from lacli.contracts.labels import ENDO, REGIONS, is_body
from lacli.geometry.quadrature import area_vectors, at_quadrature, enclosed_volume_ml, tangents, triangle_shapes

_FLAT = 1e-12


def cavity_volume_ml(bundle: Bundle, points: FloatArray) -> float:
    """Volume inside endocardium and valve planes, mL; points (n, 3) mm, curved triangles integrated exactly."""
    return -enclosed_volume_ml(bundle.cavity_triangles(), points)


def endocardial_regions(bundle: Bundle) -> tuple[IntArray, IntArray]:
    """Endocardial triangles (t, 3 or 6) of the body and their region (t,), from the cell each belongs to."""
    faces, cell = _endocardial_cells(bundle)
    return faces, bundle.region[cell]


def _endocardial_cells(bundle: Bundle) -> tuple[IntArray, IntArray]:
    """Endocardial triangles of the body and the cell (t,) behind each."""
    size = len(bundle.points)
    faces = np.concatenate([bundle.tets[:, list(f)] for f in ((0, 1, 2), (0, 1, 3), (0, 2, 3), (1, 2, 3))])
    owner = np.tile(np.arange(len(bundle.tets)), 4)
    key = _face_key(faces, size)
    order = np.argsort(key, kind="stable")
    endo = bundle.triangles[bundle.tags == ENDO]
    at = order[np.searchsorted(key[order], _face_key(endo[:, :3], size))]
    cell = owner[at]
    body = is_body(bundle.region[cell])
    return endo[body], cell[body]


def _face_key(faces: IntArray, size: int) -> IntArray:
    a, b, c = np.sort(faces, axis=1).T
    return (a * size + b) * size + c if size < 2_000_000 else a * size * size + b * size + c


@dataclass(frozen=True)
class Endocardium:
    """The body's endocardium at end-diastole, with what its features are measured along, at the quadrature points.

    faces (t, 3 or 6) point ids; region (t,); ed (n, 3) mm; area (t, q) mm2, weights included; normal (t, q, 3) out of the
    cavity; alpha, beta (t, q, 3): unit tangents along which the universal coordinates grow fastest, None where the bundle has
    none; along (t, q, 2): the unit fibre in the faces' two parameters, None where the bundle has no fibres. closed (c, 3 or 6):
    the cavity's closed surface.
    """

    faces: IntArray
    region: IntArray
    ed: FloatArray
    area: FloatArray
    normal: FloatArray
    alpha: FloatArray | None
    beta: FloatArray | None
    along: FloatArray | None
    closed: IntArray

    @classmethod
    def of(cls, bundle: Bundle, ed: FloatArray | None = None) -> Endocardium:
        """Of a bundle; ``ed``: its points (n, 3) mm at end-diastole, None: the bundle's own."""
        ed = bundle.points if ed is None else ed
        faces, cell = _endocardial_cells(bundle)
        vector = area_vectors(faces, ed)
        area = np.linalg.norm(vector, axis=2)
        d1, d2 = tangents(faces, ed)
        inverse = _pseudo_inverse(d1, d2)
        alpha = beta = along = None
        if bundle.uac is not None:
            s1, s2 = tangents(faces, bundle.uac)
            alpha, beta = (_unit(np.einsum("tqai,tqa->tqi", inverse, np.stack([s1[..., i], s2[..., i]], -1))) for i in (0, 1))
        if bundle.fibre is not None:
            share = np.einsum("tqai,ti->tqa", inverse, bundle.fibre[cell])
            length = np.linalg.norm(share[..., :1] * d1 + share[..., 1:] * d2, axis=2, keepdims=True)
            along = share / np.maximum(length, _FLAT)
        # the boundary's normals point out of the wall, into the cavity
        normal = -vector / np.maximum(area, _FLAT)[..., None]
        return cls(faces, bundle.region[cell], ed, area, normal, alpha, beta, along, bundle.cavity_triangles())

    def features(self, points: FloatArray) -> dict[str, float]:
        """All features of a deformed state (n, 3) mm, of contracts.features' table: ``volume_ml``, ``d_``, ``n_``, ``a_`` and
        ``b_<region>_mm``, ``area_strain_`` and ``fibre_strain_<region>``; only those the bundle has the data for."""
        moved = at_quadrature(self.faces, points - self.ed)
        length = np.linalg.norm(moved, axis=2)
        result = {
            "volume_ml": -enclosed_volume_ml(self.closed, points),
            "d_global_mm": float((self.area * length).sum() / self.area.sum()),
        }
        d1, d2 = tangents(self.faces, points)
        deformed = np.linalg.norm(area_vectors(self.faces, points), axis=2)
        fields = {"d_{}_mm": length, "n_{}_mm": (moved * self.normal).sum(2)}
        if self.alpha is not None and self.beta is not None:
            fields |= {"a_{}_mm": (moved * self.alpha).sum(2), "b_{}_mm": (moved * self.beta).sum(2)}
        if self.along is not None:
            fibre = self.along[..., :1] * d1 + self.along[..., 1:] * d2
            fields["fibre_strain_{}"] = 0.5 * ((fibre**2).sum(2) - 1.0)
        # each region's mean of every field
        for region, number in REGIONS.items():
            here = self.region == number
            if not here.any():
                continue
            weight = self.area[here] / self.area[here].sum()
            for key, field in fields.items():
                result[key.format(region)] = float((weight * field[here]).sum())
            result[f"area_strain_{region}"] = float(deformed[here].sum() / self.area[here].sum() - 1.0)
        return result

    def rates(self, points: FloatArray, moves: FloatArray) -> dict[str, FloatArray]:
        """Derivatives (m,) of each of ``features`` where the state's points go along ``moves`` (m, n, 3), by the unit of moves'
        own parameter. A point that is where it was at ED has no distance that could be differentiated, and counts 0."""
        shapes = triangle_shapes(self.faces.shape[1])
        moved = at_quadrature(self.faces, points - self.ed)
        d1, d2 = tangents(self.faces, points)
        normal = _unit(np.cross(d1, d2))
        fields = {"d_{}_mm": _unit(moved), "n_{}_mm": self.normal}
        if self.alpha is not None and self.beta is not None:
            fields |= {"a_{}_mm": self.alpha, "b_{}_mm": self.beta}
        # (t, k, 3): of a triangle's part in the area's sum along its nodes
        parts = {key: shapes.value.T @ (self.area[..., None] * field) for key, field in fields.items()}
        if self.along is not None:
            fibre = self.area[..., None] * (self.along[..., :1] * d1 + self.along[..., 1:] * d2)
            parts["fibre_strain_{}"] = shapes.d1.T @ (self.along[..., :1] * fibre) + shapes.d2.T @ (self.along[..., 1:] * fibre)
        normal *= shapes.weight[:, None]
        parts["area_strain_{}"] = shapes.d1.T @ np.cross(d2, normal) + shapes.d2.T @ np.cross(normal, d1)
        whole = {"d_global_mm": _nodal(parts["d_{}_mm"], self.faces, len(points)) / self.area.sum()}
        swept = triangle_shapes(self.closed.shape[1]).value.T @ area_vectors(self.closed, points)
        whole["volume_ml"] = -_nodal(swept, self.closed, len(points)) / 1000.0
        for region, number in REGIONS.items():
            here = self.region == number
            if here.any():
                area = self.area[here].sum()
                whole |= {k.format(region): _nodal(part[here], self.faces[here], len(points)) / area for k, part in parts.items()}
        seen = np.unique(np.concatenate([self.faces.ravel(), self.closed.ravel()]))
        gradients = np.array([gradient[seen].ravel() for gradient in whole.values()])
        return dict(zip(whole, gradients @ moves[:, seen].reshape(len(moves), -1).T, strict=True))


def _nodal(parts: FloatArray, faces: IntArray, n: int) -> FloatArray:
    """(n, 3) sums over the triangles of what each gives its nodes (t, k, 3)."""
    return np.stack([np.bincount(faces.ravel(), parts[..., i].ravel(), n) for i in range(3)], axis=1)


def surface_features(bundle: Bundle, ed: FloatArray, points: FloatArray) -> dict[str, float]:
    """All features of one deformed state; for several states of one bundle make an ``Endocardium`` once."""
    return Endocardium.of(bundle, ed).features(points)


def _pseudo_inverse(d1: FloatArray, d2: FloatArray) -> FloatArray:
    """(t, q, 2, 3): a vector's components along the tangents; transposed, it turns derivatives into the surface gradient."""
    g11, g12, g22 = (d1 * d1).sum(2), (d1 * d2).sum(2), (d2 * d2).sum(2)
    det = np.maximum(g11 * g22 - g12 * g12, _FLAT)[..., None]
    first = (g22[..., None] * d1 - g12[..., None] * d2) / det
    second = (g11[..., None] * d2 - g12[..., None] * d1) / det
    return np.stack([first, second], axis=2)


def _unit(vectors: FloatArray) -> FloatArray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=2, keepdims=True), _FLAT)
