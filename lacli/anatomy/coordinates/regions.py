"""The five regions of the wall, from the square of universal atrial coordinates."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lacli.base.arrays import FloatArray, IntArray
from lacli.contracts.labels import REGIONS
from lacli.geometry import curves as paths


@dataclass(frozen=True)
class Lines:
    """The cuts of the square: alpha and beta through the centres of the right superior and the left inferior vein."""

    alpha_rspv: float = 0.115
    beta_rspv: float = 0.555
    alpha_lipv: float = 0.87
    beta_lipv: float = 0.315


def lines_of(rspv_rim: FloatArray, lipv_rim: FloatArray) -> Lines:
    """Lines from the (k, 2) coordinates of the two veins' rims: the middles of their boxes."""
    right, left = ((rim.min(axis=0) + rim.max(axis=0)) / 2 for rim in (rspv_rim, lipv_rim))
    return Lines(float(right[0]), float(right[1]), float(left[0]), float(left[1]))


def of_coordinates(uac: FloatArray, lines: Lines) -> IntArray:
    """(n, 2) alpha, beta -> (n,) region: septum and lateral wall at the sides, posterior, roof, anterior between them."""
    alpha, beta = uac.T
    between = np.where(
        beta < lines.beta_lipv, REGIONS["posterior"], np.where(beta > lines.beta_rspv, REGIONS["anterior"], REGIONS["roof"])
    )
    return np.where(
        alpha < lines.alpha_rspv, REGIONS["septum"], np.where(alpha > lines.alpha_lipv, REGIONS["lateral"], between)
    ).astype(np.int64)


def of_triangles(uac: FloatArray, triangles: IntArray, lines: Lines) -> IntArray:
    """Region per triangle: its corners' majority where the coordinates jump across it, else its centre's."""
    corner = uac[triangles]
    jumps = np.ptp(corner, axis=1).max(axis=1) > 0.25
    region = of_coordinates(corner.mean(axis=1), lines)
    votes = of_coordinates(corner.reshape(-1, 2), lines).reshape(-1, 3)
    majority = np.where(votes[:, 1] == votes[:, 2], votes[:, 1], votes[:, 0])
    return np.where(jumps, majority, region)


def without_islands(triangles: IntArray, region: IntArray, area: FloatArray, body: NDArray[np.bool_]) -> tuple[IntArray, int]:
    """Floating elements take the label around them: every region keeps its largest part. (t,) regions, how many changed.

    body (t,): triangles that take part (rings and planes do not).
    """
    region = region.copy()
    edges, _, of = paths.edge_table(triangles)
    changed = 0
    for _ in range(10):
        island = np.zeros(len(triangles), dtype=bool)
        for value in np.unique(region[body]):
            mine = body & (region == value)
            count, part = paths.triangle_components(triangles, mine)
            if count > 1:
                size = np.bincount(part[mine], weights=area[mine])
                island |= mine & (part != int(np.argmax(size)))
        if not island.any():
            break
        # shared edges with settled triangles vote, over and over until the islands are gone
        while island.any():
            votes = np.zeros((len(edges), 6))
            settled = np.flatnonzero(body & ~island)
            for side in range(3):
                np.add.at(votes, (of[settled, side], region[settled]), 1.0)
            ballots = votes[of[island]].sum(axis=1)
            ids = np.flatnonzero(island)
            has = ballots.sum(axis=1) > 0
            if not has.any():
                break
            region[ids[has]] = np.argmax(ballots[has], axis=1)
            changed += int(has.sum())
            island[ids[has]] = False
    return region, changed
