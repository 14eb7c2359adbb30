"""A parametric left atrium from a seed: closed cavity surface, wall mesh with coordinates, motion of the mitral annulus."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache

import numpy as np

from lacli.anatomy.coordinates.describe import describe
from lacli.anatomy.cuts.cut import cut_open
from lacli.anatomy.wall.shell import mesh_shell
from lacli.base.arrays import FloatArray
from lacli.base.errors import AnatomyError
from lacli.contracts.bundle import Bundle
from lacli.contracts.motion import Motion
from lacli.geometry.surface import WALL, Surface, compact
from lacli.motion.annulus import descend
from lacli.synthetic.shape import COHORT_ML, Shape, cohort_volume, draw

GRID_MM = 1.3


def synthesize(
    seed: int,
    volume_ml: float | None = None,
    thickness_mm: float = 2.0,
    cell_size_mm: float = 4.0,
    order: int = 2,
    frames: int = 10,
    descent_mm: float = 8.0,
    layers: int | None = None,
    rule: str = "laplace-dirichlet",
    at_ostia: bool = False,
    wall: Callable[[FloatArray], FloatArray] | None = None,
) -> tuple[Bundle, Motion]:
    """Bundle and annulus motion of a seed.

    volume_ml: cavity volume with the planes closed, None: the seed's own from the cohort's range. The mesh's curved
    cavity volume is within the discretisation of that. ``rule``: of coordinates.RULES, regions then follow the universal
    atrial coordinates; or "simple": sectors and two-layer fibres by the shape's own axes (see frame). ``at_ostia``: cut the
    vessels where `mesh` does, at their ostia (Shape.at_ostia), of the atrium that has the volume when cut as drawn.
    ``wall``: thickness (k,) mm at points (k, 3) mm, in place of one thickness everywhere.
    Raises AnatomyError for an argument out of range.
    """
    shape = sized(seed, volume_ml)
    surface = cavity(shape.at_ostia() if at_ostia else shape)
    bundle = mesh_shell(surface, thickness_mm if wall is None else wall(surface.points), cell_size_mm, order=order, layers=layers)
    if rule != "simple":
        bundle = describe(bundle, rule=rule).bundle
    info = {
        "source": "parametric left atrium",
        "seed": seed,
        "thickness_mm": thickness_mm if wall is None else "varying",
        "cell_size_mm": cell_size_mm,
    }
    bundle = replace(bundle, info={**info, **bundle.info})
    return bundle, descend(bundle, frames=frames, descent_mm=descent_mm)


def sized(seed: int, volume_ml: float | None = None) -> Shape:
    """The seed's shape, scaled so that its clipped cavity has the volume (mL)."""
    volume = cohort_volume(seed) if volume_ml is None else float(volume_ml)
    if not 5.0 <= volume <= 500.0:
        low, high = COHORT_ML
        raise AnatomyError(f"A left atrium has no {volume:g} mL: give 5 - 500 mL (the published cohort has {low:g} - {high:g}).")
    return replace(draw(seed), scale=float((volume / cavity(draw(seed)).volume_ml()) ** (1 / 3)))


def cavity(shape: Shape, grid_mm: float = GRID_MM) -> Surface:
    """The closed, clipped cavity surface, its points on the implicit function's zero; edges of ``grid_mm`` x scale."""
    unit_cavity = _unit_cavity(shape.seed, grid_mm, tuple(tube.cut_mm for tube in shape.tubes.values()))
    return replace(unit_cavity, points=unit_cavity.points * shape.scale)


@lru_cache(maxsize=4)
def _unit_cavity(seed: int, grid_mm: float, cuts_mm: tuple[float, ...]) -> Surface:
    shape = draw(seed)
    cut_at = zip(shape.tubes.items(), cuts_mm, strict=True)
    shape = replace(shape, tubes={name: replace(tube, cut_mm=mm) for (name, tube), mm in cut_at})
    surface = isosurface(shape, grid_mm)
    for cut in shape.cuts():
        surface = cut_open(surface, cut)
    return surface


def isosurface(shape: Shape, grid_mm: float) -> Surface:
    """The uncut surface as triangles of about ``grid_mm`` times the shape's scale."""
    import pyvista as pv

    step = grid_mm * shape.scale
    value, low = signed_distance_grid(shape, step)
    grid = pv.ImageData(dimensions=value.shape, spacing=(step,) * 3, origin=low)
    mesh = grid.contour([0.0], scalars=value.ravel(order="F"), method="flying_edges").clean(tolerance=1e-9)
    triangles = mesh.faces.reshape(-1, 4)[:, 1:].astype(np.int64)
    points = onto_zero(shape, np.asarray(mesh.points, dtype=np.float64))
    surface = compact(Surface(points, triangles, np.full(len(triangles), WALL)))
    return surface if surface.volume_ml() > 0 else replace(surface, triangles=triangles[:, ::-1].copy())


def onto_zero(shape: Shape, points: FloatArray, steps: int = 3) -> FloatArray:
    """Points moved along the gradient (central differences) onto the surface."""
    h = 1e-4 * shape.scale
    for _ in range(steps):
        value = shape.implicit(points)
        gradient = np.column_stack(
            [(shape.implicit(points + h * e) - shape.implicit(points - h * e)) / (2 * h) for e in np.eye(3)]
        )
        points = points - (value / np.maximum((gradient**2).sum(axis=1), 0.05))[:, None] * gradient
    return points


def signed_distance_grid(shape: Shape, spacing_mm: float) -> tuple[FloatArray, FloatArray]:
    """The implicit function (nx, ny, nz) mm on a regular grid over the shape's box, and the grid's first point (3,) mm."""
    low, high = shape.bounds()
    axes = [np.arange(a, b + spacing_mm, spacing_mm) for a, b in zip(low, high, strict=True)]
    value = np.empty(tuple(len(a) for a in axes))
    y, z = np.meshgrid(axes[1], axes[2], indexing="ij")
    for i, x in enumerate(axes[0]):
        layer = np.column_stack([np.full(y.size, x), y.ravel(), z.ravel()])
        value[i] = shape.implicit(layer).reshape(y.shape)
    return value, low


def signed_distance(seed: int, points: FloatArray, volume_ml: float | None = None, clipped: bool = True) -> FloatArray:
    """About the signed distance (k,) mm of ``points`` (k, 3) from the seed's cavity surface, negative inside.

    ``clipped``: the vessels and the valve end at their planes; else they go on past them, as in an image.
    """
    shape = sized(seed, volume_ml)
    value = shape.implicit(points)
    if clipped:
        for cut in shape.cuts():
            relative = points - cut.centre
            height = relative @ cut.direction
            across = np.linalg.norm(relative - height[:, None] * cut.direction, axis=1)
            value = np.where(across < cut.reach_mm, np.maximum(value, height), value)
    return value
