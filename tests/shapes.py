"""Shapes whose volumes and offsets are known."""

from __future__ import annotations

from dataclasses import replace
from itertools import permutations, product

import numpy as np
import pyvista as pv

from lacli.anatomy.cuts.cut import Cut, cut_open
from lacli.anatomy.wall.shell import mesh_shell
from lacli.contracts.bundle import Bundle
from lacli.contracts.labels import ENDO, EPI
from lacli.geometry.surface import Surface

RADIUS, HEIGHT = 20.0, 14.0
RIM = np.sqrt(RADIUS**2 - HEIGHT**2)


def icosphere(radius: float, subdivisions: int) -> Surface:
    mesh = pv.Icosphere(radius=radius, nsub=subdivisions).clean()
    faces = mesh.faces.reshape(-1, 4)[:, 1:].astype(np.int64)
    points = np.asarray(mesh.points, dtype=np.float64)
    points *= radius / np.linalg.norm(points, axis=1, keepdims=True)
    return Surface(points, faces, np.zeros(len(faces), dtype=np.int64))


def cut_ball() -> Surface:
    """A ball of 20 mm with the part above z = 14 mm cut off, the cut labelled 21."""
    return cut_open(icosphere(RADIUS, 4), Cut(np.array([0.0, 0, HEIGHT]), np.array([0.0, 0, 1]), 40.0, 21))


def fibrous_ball(order: int) -> Bundle:
    """A ball of 20 mm radius cut at z = 14 mm, wall 2 mm, fibres around z, pericardium from the cut (0) to the far pole (1)."""
    bundle = mesh_shell(cut_ball(), 2.0, 9.0, order=order)
    centre = bundle.points[bundle.tets[:, :4]].mean(axis=1)
    fibre = np.cross([0.0, 0.0, 1.0], centre) + np.array([1e-9, 0.0, 0.0])
    height = np.clip((HEIGHT - bundle.points[:, 2]) / (RADIUS + HEIGHT), 0, 1)
    return replace(bundle, fibre=fibre / np.linalg.norm(fibre, axis=1, keepdims=True), pericardium_coordinate=height)


def hollow_cube(size: float = 30.0) -> Bundle:
    """A cube of 3 x 3 x 3 blocks without the middle one, six tetrahedra a block: a wall around a cavity of size^3 / 27."""
    grid = np.array(list(product(range(4), repeat=3)), dtype=float) * size / 3
    number = {corner: i for i, corner in enumerate(product(range(4), repeat=3))}
    tets = []
    for block in product(range(3), repeat=3):
        if block == (1, 1, 1):
            continue
        for order in permutations(range(3)):
            corner = list(block)
            path = [number[tuple(corner)]]
            for axis in order:
                corner[axis] += 1
                path.append(number[tuple(corner)])
            # the six paths along the edges turn left and right in turn
            even = np.linalg.det(np.eye(3)[list(order)]) > 0
            tets.append(path if even else [path[0], path[2], path[1], path[3]])
    cells = np.array(tets)
    faces = np.concatenate([cells[:, f] for f in ([0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2])])
    _, first, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    triangles = faces[first[count == 1]]
    inside = np.all(np.abs(grid[triangles] - size / 2) < size / 5, axis=(1, 2))
    return Bundle(
        points=grid,
        tets=cells,
        region=np.ones(len(cells), dtype=np.int64),
        triangles=triangles,
        tags=np.where(inside, ENDO, EPI),
        fibre=np.tile([1.0, 0.0, 0.0], (len(cells), 1)),
        transmural=grid[:, 0] / size,
        info={"provenance": "a cube"},
    )
