"""A case: what one simulation needs to know, gathered once; it passes from writing to running to reading."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lacli.base.arrays import FloatArray, IntArray
from lacli.base.errors import AnatomyError
from lacli.contracts.bundle import Bundle
from lacli.contracts.motion import Motion
from lacli.contracts.scene import Scene


@dataclass(frozen=True)
class Phase:
    """A stretch of the load: pressures in kPa, times as shares of the cycle; ``file`` names the state at its end, ``by_edp`` and
    ``by_esp`` are the derivatives of its pressure along EDP and ESP."""

    name: str
    file: str
    pressure_from: float
    pressure_to: float
    time_from: float
    time_to: float
    by_edp: float
    by_esp: float


@dataclass(frozen=True)
class Plan:
    """Which terms the deck contains, and its phases in order."""

    title: str
    unloading: bool
    prestrain: bool
    unloaded: bool
    moving: bool
    vein_springs: bool
    pericardium: bool
    outward_only: bool
    fibres: bool
    sensitivities: bool
    phases: tuple[Phase, ...]

    def stretches(self) -> tuple[Phase, ...]:
        """The phases after end-diastole, each with a state at its end."""
        return tuple(phase for phase in self.phases if phase.name != "load")


@dataclass(frozen=True)
class Case:
    """A scene with what it refers to: the bundle and the annulus's motion (None: held) in the scene's order of cells, and the
    plan of what is modelled."""

    scene: Scene
    bundle: Bundle
    motion: Motion | None
    plan: Plan


def as_order(bundle: Bundle, order: int) -> Bundle:
    """The bundle with cells of that order: edge middles dropped for 1. Raises AnatomyError where they would be needed."""
    if order == bundle.order:
        return bundle
    if order == 2:
        raise AnatomyError("numerics.order is 2 but the bundle has 4-node cells: set numerics.order to 1, or mesh with order 2.")
    used, local = np.unique(bundle.tets[:, :4], return_inverse=True)
    new = np.full(len(bundle.points), -1, dtype=np.int64)
    new[used] = np.arange(len(used))

    def pick(values: FloatArray | None) -> FloatArray | None:
        return None if values is None else values[used]

    return Bundle(
        points=bundle.points[used],
        tets=local.reshape(-1, 4),
        region=bundle.region,
        triangles=new[bundle.triangles[:, :3]],
        tags=bundle.tags,
        fibre=bundle.fibre,
        transmural=pick(bundle.transmural),
        uac=pick(bundle.uac),
        pericardium_coordinate=pick(bundle.pericardium_coordinate),
        info=bundle.info,
    )


def motion_as_order(motion: Motion | None, bundle: Bundle, order: int) -> Motion | None:
    """The motion of ``bundle``'s points with the ids they have in ``as_order(bundle, order)``."""
    if motion is None or order == bundle.order:
        return motion
    kept: IntArray = np.unique(bundle.tets[:, :4])
    inside = np.isin(motion.wall_point, kept)
    ids = np.searchsorted(kept, motion.wall_point[inside])
    return Motion(motion.times, ids, motion.positions[:, inside], motion.es_time)
