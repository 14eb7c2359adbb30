"""A case: what one simulation needs to know, gathered once; it passes from writing to running to reading."""

from __future__ import annotations

from dataclasses import dataclass

from lacli.contracts.bundle import Bundle
from lacli.contracts.motion import Motion
from lacli.contracts.scene import Scene


@dataclass(frozen=True)
class Phase:
    """A stretch of the load: pressures in kPa, times as shares of the cycle; ``start`` and ``file`` name the states at its ends,
    ``by_edp`` and ``by_esp`` are the derivatives of its last pressure along EDP and ESP."""

    name: str
    start: str
    file: str
    pressure_from: float
    pressure_to: float
    time_from: float
    time_to: float
    by_edp: float
    by_esp: float


@dataclass(frozen=True)
class Plan:
    """Which terms the deck contains, and its phases in the order in which they are solved; ``rest_sweeps`` as in the scene, 0
    where no spring could move; ``second``: phases of another way from end-diastole to end-systole, where it is asked for."""

    title: str
    unloading: bool
    prestrain: bool
    unloaded: bool
    moving: bool
    vein_springs: bool
    pericardium: bool
    outward_only: bool
    dents: bool
    sensitivities: bool
    rest_sweeps: int
    phases: tuple[Phase, ...]
    second: tuple[Phase, ...] = ()

    def stretches(self) -> tuple[Phase, ...]:
        """The phases after end-diastole, each with a state at its end."""
        return tuple(phase for phase in self.phases if phase.name != "load")


@dataclass(frozen=True)
class Case:
    """A scene with what it refers to: the bundle and the annulus's motion (None: held) in the scene's order of cells, the plan of
    what is modelled, and the key of the run's content (``lacli.contracts.identity.run_key``)."""

    scene: Scene
    bundle: Bundle
    motion: Motion | None
    plan: Plan
    key: str
