"""Wall thickness two ways: arrival time of a front from the epicardium (eikonal), and length along the Laplace field's lines."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix, diags
from scipy.sparse.linalg import cg

from lacli.anatomy.coordinates.fibres import recovered
from lacli.base.arrays import FloatArray, IntArray
from lacli.base.errors import AnatomyError
from lacli.contracts.bundle import Bundle
from lacli.contracts.labels import ENDO, EPI, REGIONS, is_ring, is_wall
from lacli.geometry import laplace
from lacli.geometry.subdivision import straight


@dataclass(frozen=True)
class Thickness:
    """Both thicknesses (k,) mm at the endocardial corner points ``ids`` (k,), and the means per region."""

    ids: IntArray
    eikonal: FloatArray
    laplace: FloatArray
    per_region: dict[str, tuple[float, float]]

    @property
    def median_difference_mm(self) -> float:
        """Median over the regions of |eikonal - Laplace| of the regional means."""
        return float(np.median([abs(e - p) for e, p in self.per_region.values()]))


def of_bundle(bundle: Bundle) -> Thickness:
    """Thickness of the wall (rings included, planes not), regional means by endocardial area."""
    wall = is_wall(bundle.region)
    tets = bundle.tets[wall, :4]
    endo = bundle.triangles[bundle.tags == ENDO]
    outside = (bundle.tags == EPI) | is_ring(bundle.tags)
    epi = bundle.triangles[outside]
    inner, outer = np.unique(endo[:, :3]), np.unique(epi[:, :3])
    eik = eikonal(bundle.points, inner, straight(epi))
    lap = along_laplace(bundle.points, tets, inner, np.setdiff1d(outer, inner))
    return Thickness(inner, eik, lap, regional(bundle, inner, eik, lap))


def eikonal(points: FloatArray, endo: IntArray, epi: IntArray) -> FloatArray:
    """Arrival time (k,) s = mm at 1 mm/s at the points ``endo`` of a front that leaves all of ``epi`` (t, 3) at once.

    The first ray to arrive is straight and cannot cross the epicardium again, so the eikonal solution is the distance to the
    nearest point of the epicardial triangles; it is computed as that, without a grid.
    """
    import vtk

    if len(epi) == 0:
        raise AnatomyError("the wall has no epicardium.")
    from lacli.anatomy.pictures import polydata
    from lacli.geometry.surface import Surface

    locator = vtk.vtkStaticCellLocator()
    locator.SetDataSet(polydata(Surface(points, epi, np.zeros(len(epi), dtype=np.int64))))
    locator.BuildLocator()
    closest, cell, part, square = [0.0, 0.0, 0.0], vtk.reference(0), vtk.reference(0), vtk.reference(0.0)
    out = np.empty(len(endo))
    for i, point in enumerate(points[endo].tolist()):
        locator.FindClosestPoint(point, closest, cell, part, square)
        out[i] = float(square) ** 0.5
    return out


def along_laplace(points: FloatArray, tets: IntArray, endo: IntArray, epi: IntArray) -> FloatArray:
    """Length (k,) mm, at the points ``endo``, of the Laplace field's lines from the epicardium (Jones 2000, Bishop 2016).

    With T the unit gradient of the harmonic field (0 endo, 1 epi), the length L solves T . grad L = -1 with L = 0 on the
    epicardium; here in the least-squares sense on the same linear cells.
    """
    grad = laplace.gradient(points, tets)
    field = laplace.solve(laplace.stiffness(grad, len(points)), {0.0: endo, 1.0: epi})
    # cells with all corners on one side carry no gradient; the recovered one comes from their neighbours
    slope = recovered(grad, np.nan_to_num(field), len(points))
    size = np.linalg.norm(slope, axis=1)
    direction = slope / np.maximum(size, 1e-12)[:, None]
    weight = grad.measure * (size > 1e-9)
    along = np.einsum("mkd,md->mk", grad.shape, direction)
    local = np.einsum("mi,mj,m->mij", along, along, weight)
    rows = np.repeat(tets, 4, axis=1).ravel()
    columns = np.tile(tets, (1, 4)).ravel()
    matrix = coo_matrix((local.ravel(), (rows, columns)), shape=(len(points), len(points))).tocsr()
    right = -np.bincount(tets.ravel(), weights=(along * weight[:, None]).ravel(), minlength=len(points))
    # a whisper of smoothing keeps points determined that no line reaches
    matrix = matrix + 1e-6 * laplace.stiffness(grad, len(points))
    used = np.zeros(len(points), dtype=bool)
    used[tets] = True
    used[epi] = False
    unknown = np.flatnonzero(used)
    system = matrix[unknown][:, unknown]
    scale = 1.0 / np.sqrt(np.maximum(system.diagonal(), 1e-30))
    answer, status = cg(diags(scale) @ system @ diags(scale), right[unknown] * scale, rtol=1e-8, maxiter=20000)
    if status != 0:
        raise AnatomyError("the Laplace thickness did not converge; the wall's cells are too poor.")
    length = np.zeros(len(points))
    length[unknown] = answer * scale
    return length[endo]


def regional(bundle: Bundle, ids: IntArray, first: FloatArray, second: FloatArray) -> dict[str, tuple[float, float]]:
    """Area-weighted means of two endocardial fields per region (mm)."""
    from lacli.anatomy.coordinates.describe import cell_label

    endo = bundle.triangles[bundle.tags == ENDO, :3]
    label = cell_label(bundle, endo)
    place = np.zeros(len(bundle.points), dtype=np.int64)
    place[ids] = np.arange(len(ids))
    a, b, c = (bundle.points[endo[:, i]] for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    out = {}
    for name, value in REGIONS.items():
        mine = label == value
        if mine.any():
            out[name] = tuple(float(np.average(f[place[endo[mine]]].mean(axis=1), weights=area[mine])) for f in (first, second))
    return out  # type: ignore[return-value]
