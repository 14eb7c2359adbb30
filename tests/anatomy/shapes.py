"""Shapes whose volumes and offsets are known."""

from __future__ import annotations

import numpy as np
import pyvista as pv

from lacli.anatomy.openings.cut import Cut, cut_open
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
