"""The atrium's own axes (roof, left, anterior) and what follows from them by simple geometric rules.

The rules stand where no landmarks-based coordinates exist: five sectors as regions, height over the mitral valve as
pericardium coordinate, circumferential and longitudinal fibres.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lacli.base.arrays import FloatArray, IntArray
from lacli.contracts.labels import REGIONS

ROOF_HALF_ANGLE_DEG = 50.0


@dataclass(frozen=True)
class AtrialFrame:
    """Right-handed or left-handed unit axes at ``centre`` (3,) mm: roof (away from the mitral valve), left, anterior."""

    centre: FloatArray
    mitral_centre: FloatArray
    roof: FloatArray
    left: FloatArray
    anterior: FloatArray

    def components(self, points: FloatArray) -> FloatArray:
        """(n, 3) mm: components along left, anterior, roof of ``points`` from the centre."""
        return (points - self.centre) @ np.column_stack([self.left, self.anterior, self.roof])


def unit(v: FloatArray) -> FloatArray:
    """Vectors scaled to length one along the last axis; zero vectors stay zero."""
    size = np.linalg.norm(v, axis=-1, keepdims=True)
    return v / np.where(size > 0, size, 1.0)


def frame_from_openings(centre: FloatArray, openings: dict[str, FloatArray]) -> AtrialFrame:
    """Axes from the cavity's centre and the openings' centres (each (3,) mm, keys of OPENINGS).

    left: from the right veins to the left ones; roof: from the mitral valve's centre to the cavity's, perpendicular to
    left (the valve lies to the left, so the line through it alone would tilt the roof to the right); anterior:
    perpendicular to both, on the side away from the inferior veins' mean (they open posteriorly).
    """
    left = unit((openings["lspv"] + openings["lipv"]) / 2 - (openings["rspv"] + openings["ripv"]) / 2)
    roof = centre - openings["mv"]
    roof = unit(roof - (roof @ left) * left)
    anterior = np.cross(roof, left)
    back = (openings["lipv"] + openings["ripv"]) / 2 - centre
    if anterior @ back > 0:
        anterior = -anterior
    return AtrialFrame(centre, openings["mv"], roof, left, anterior)


def sectors(frame: AtrialFrame, points: FloatArray) -> IntArray:
    """Region of REGIONS per point (n,): the roof is a cone about its axis, the rest four quadrants around that axis."""
    x, y, z = frame.components(points).T
    away = np.maximum(np.sqrt(x**2 + y**2 + z**2), 1e-12)
    side = np.where(x > 0, REGIONS["lateral"], REGIONS["septum"])
    front = np.where(y > 0, REGIONS["anterior"], REGIONS["posterior"])
    region = np.where(np.abs(x) > np.abs(y), side, front)
    return np.where(z / away > np.cos(np.radians(ROOF_HALF_ANGLE_DEG)), REGIONS["roof"], region).astype(np.int64)


def height(frame: AtrialFrame, points: FloatArray) -> FloatArray:
    """Pericardium coordinate (n,): height over the mitral centre along the line from it
    through the cavity's centre, 0 there and 1 at the highest point."""
    h = (points - frame.mitral_centre) @ unit(frame.centre - frame.mitral_centre)
    return np.clip(h / h.max(), 0.0, 1.0)


def sweep(frame: AtrialFrame, points: FloatArray) -> FloatArray:
    """UAC-like pair (n, 2): alpha 0 septal -> 1 lateral, beta 0 posterior MV -> 0.5 roof -> 1 anterior MV, both by angle."""
    x, y, z = frame.components(points).T
    alpha = np.arctan2(x, np.hypot(y, z)) / np.pi + 0.5
    beta = np.clip(np.arctan2(y, z) / (1.5 * np.pi) + 0.5, 0.0, 1.0)
    return np.column_stack([alpha, beta])


def two_layer_fibres(frame: AtrialFrame, normals: FloatArray, transmural: FloatArray) -> FloatArray:
    """Unit fibres (m, 3): round the mitral axis for transmural < 0.5, from valve to roof above (a step, as published).

    normals (m, 3): unit, across the wall. Where the normal is along the roof axis (the roof's top, the valve) the
    rule has no direction of its own and follows the left-right axis.
    """
    around = np.cross(unit(frame.centre - frame.mitral_centre), normals)
    weight = np.linalg.norm(around, axis=1, keepdims=True)
    spare = unit(frame.left - (normals @ frame.left)[:, None] * normals)
    around = unit(np.where(weight > 0.1, around, spare))
    along = unit(np.cross(normals, around))
    fibre = unit(np.where((transmural < 0.5)[:, None], around, along))
    return np.where(np.linalg.norm(fibre, axis=1, keepdims=True) > 0.5, fibre, frame.left)
