"""Surfaces through voxels: a closed one painted on a grid, and what ragged triangles enclose."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from lacli.anatomy.inputs.image import Image
from lacli.base.arrays import FloatArray, IntArray
from lacli.base.errors import AnatomyError
from lacli.geometry.surface import Surface


def voxels(surface: Surface, spacing_mm: float) -> Image:
    """1 inside a closed surface and 0 outside (float32), on an isotropic grid with a margin."""
    import vtk
    from vtk.util.numpy_support import vtk_to_numpy

    from lacli.anatomy.pictures import polydata

    margin = int(np.ceil(6.0 / spacing_mm))
    low = surface.points.min(axis=0) - margin * spacing_mm
    size = np.ceil(np.ptp(surface.points, axis=0) / spacing_mm).astype(int) + 2 * margin
    stencil = vtk.vtkPolyDataToImageStencil()
    stencil.SetInputData(polydata(surface))
    stencil.SetOutputSpacing(spacing_mm, spacing_mm, spacing_mm)
    stencil.SetOutputOrigin(*low)
    stencil.SetOutputWholeExtent(0, int(size[0]) - 1, 0, int(size[1]) - 1, 0, int(size[2]) - 1)
    paint = vtk.vtkImageStencilToImage()
    paint.SetInputConnection(stencil.GetOutputPort())
    paint.SetInsideValue(1)
    paint.SetOutsideValue(0)
    paint.SetOutputScalarTypeToUnsignedChar()
    paint.Update()
    array = vtk_to_numpy(paint.GetOutput().GetPointData().GetScalars()).reshape(size[::-1]).astype(np.float32)
    return Image(array, np.full(3, spacing_mm), low, np.eye(3))


def voxel_field(surface: Surface, spacing_mm: float) -> Image:
    """A closed surface as a field, about 1 inside and 0 outside, on an isotropic grid."""
    field = voxels(surface, spacing_mm)
    return field.with_array(ndimage.gaussian_filter(field.array, 0.7))


def from_voxels(points: FloatArray, triangles: IntArray, spacing_mm: float = 0.5) -> Surface:
    """The cavity that triangles enclose up to gaps: walls are thickened until a flood from outside does not get in.

    Gaps up to 6 mm are bridged. Raises AnatomyError where the flood always gets in.
    """
    from lacli.anatomy.inputs import extraction

    low = points.min(axis=0) - 10.0
    size = np.ceil((points.max(axis=0) + 10.0 - low) / spacing_mm).astype(int)
    if np.prod(size.astype(float)) > 3e8:
        raise AnatomyError("the surface is too wide to be rebuilt from voxels; remove what lies far from the atrium.")
    sample = _sample(points, triangles, 0.6 * spacing_mm)
    wall = np.zeros(size[::-1], dtype=bool)
    index = np.round((sample - low) / spacing_mm).astype(int)
    wall[index[:, 2], index[:, 1], index[:, 0]] = True
    distance = ndimage.distance_transform_edt(~wall) * spacing_mm
    enclosed_least = 0.2 * float(np.prod(np.ptp(points, axis=0))) / spacing_mm**3
    for reach in (0.6, 1.0, 1.5, 2.0, 3.0):
        room, _ = ndimage.label(distance > reach)
        outside = room == room[0, 0, 0]
        inside = (distance > reach) & ~outside
        if inside.sum() > 0.3 * enclosed_least:
            parts, _ = ndimage.label(inside)
            inside = parts == 1 + int(np.argmax(np.bincount(parts.ravel())[1:]))
            # grow back to the wall itself, half of its thickened layer
            grown = ndimage.distance_transform_edt(~inside) * spacing_mm <= reach
            mask = Image(grown & ~outside, np.full(3, spacing_mm), low, np.eye(3))
            return extraction.surface_of(mask, sigma_mm=max(0.8, reach), grid_mm=0.8)
    raise AnatomyError(
        "the triangles enclose no cavity, even with gaps up to 6 mm bridged; close the surface in the tool that wrote it."
    )


def _sample(points: FloatArray, triangles: IntArray, step: float) -> FloatArray:
    """Points on the triangles, at most about ``step`` apart."""
    a, b, c = (points[triangles[:, i]] for i in range(3))
    longest = np.max([np.linalg.norm(b - a, axis=1), np.linalg.norm(c - b, axis=1), np.linalg.norm(a - c, axis=1)], axis=0)
    count = np.minimum(np.ceil(longest / step).astype(int), 400)
    out = []
    for n in np.unique(count):
        mine = count == n
        i, j = np.meshgrid(np.arange(n + 1), np.arange(n + 1))
        keep = i + j <= n
        s, t = i[keep] / max(n, 1), j[keep] / max(n, 1)
        out.append((a[mine][:, None] + s[:, None] * (b - a)[mine][:, None] + t[:, None] * (c - a)[mine][:, None]).reshape(-1, 3))
    return np.concatenate(out)
