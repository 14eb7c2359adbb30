"""What a calibration will cost, before any run: runs at most, times what one takes."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from lacli.contracts import bundle as bundles
from lacli.contracts.scene import Scene
from lacli.mechanics.numerics.cost import Cost, Earlier, expected


@dataclass(frozen=True)
class Price:
    """Of simulations of one kind: what they are, how many at most, and the cost of one."""

    name: str
    runs: int
    each: Cost

    @property
    def cpu_s(self) -> float:
        """CPU seconds of all."""
        return self.runs * self.each.cpu_s


def price(name: str, scene: Scene, runs: int, done: Iterable[Earlier]) -> Price:
    """Of ``runs`` simulations of a scene, corrected by those that are ``done``."""
    return Price(name, runs, expected(scene, bundles.load(scene.anatomy.bundle), done))
