"""The runs of a calibration that seeks the posterior: asked for within a budget, held against the targets that runs can tell."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from lacli.base.arrays import FloatArray
from lacli.calibration.sequential import branches
from lacli.calibration.sequential.evidence import Evidence, gather, narrowed
from lacli.calibration.sequential.scale import Scale
from lacli.contracts.targets import Targets
from lacli.inference.box import Box
from lacli.inference.runs import RunLog, Simulator
from lacli.inference.sampling import posterior as mcmc


@dataclass(frozen=True)
class Settings:
    """How far the search goes.

    starts of the search (>= 4); first_runs around the most probable point, drawn from a Gaussian ``widening`` times as wide
    as the posterior's, then ``batch`` at a time; end when the emulator's error moves the posterior's mean by less than
    ``share`` of its sd in every input, or at max_runs. mode_runs: at most so many to rule out other modes.
    """

    starts: int = 4
    first_runs: int = 12
    widening: float = 1.6
    batch: int = 4
    share: float = 0.1
    mode_runs: int = 12
    max_runs: int = 60
    seed: int = 0
    mcmc: mcmc.Settings = field(default_factory=mcmc.Settings)


@dataclass(frozen=True)
class Status:
    """Where a calibration stands: its stage, runs done of those asked for, and the runs so far in all."""

    stage: str
    done: int
    total: int
    runs: int


Monitor = Callable[[Status], None]


class Search:
    """The runs so far, with what asks for more. targets: those that runs can tell; notes: what a user must know."""

    def __init__(
        self, simulator: Simulator, box: Box, targets: Targets, settings: Settings, log: RunLog, monitor: Monitor
    ) -> None:
        self.simulator, self.box, self.given, self.settings = simulator, narrowed(box, targets), targets, settings
        self.targets = targets
        self.log, self.monitor = log, monitor
        self.scale = Scale.of(self.box)
        self.x = np.empty((0, box.d))
        self.stages: dict[str, int] = {}
        self.notes: list[str] = []
        self.strays = 0

    def run(self, z: FloatArray, stage: str) -> Evidence:
        """Run the points z (k, d) that the budget allows; the evidence of all runs."""
        x = self.scale.to_x(z)
        x = x[self.box.contains(x)][: max(0, self.settings.max_runs - len(self.x))]
        if len(x):
            before = len(self.x)
            self.log.run(self.simulator, x, lambda done, total: self.monitor(Status(stage, done, total, before + done)))
            self.x = _joined(self.x, x)
            self.stages[stage] = self.stages.get(stage, 0) + len(self.x) - before
        return self.evidence()

    def evidence(self) -> Evidence:
        """Of all runs so far but for those on another branch; targets of frames that have several are left out from now on."""
        while True:
            found = gather(self.log, self.x, self.targets, self.scale)
            if not len(found.z):
                return found
            seen = branches.look(found, self.targets)
            if not seen.times:
                self.strays = int(seen.strays.sum())
                return found.take(~seen.strays)
            self.targets = branches.without(self.targets, seen.times)

    @property
    def left(self) -> int:
        """Runs that the budget still allows."""
        return self.settings.max_runs - len(self.x)

    @property
    def left_out(self) -> tuple[str, ...]:
        """Names of the targets that the runs cannot tell."""
        return tuple(name for name in self.given.names if name not in self.targets.names)

    def say(self, stage: str) -> None:
        """Tell the monitor of a stage without runs."""
        self.monitor(Status(stage, 0, 0, len(self.x)))


def _joined(x: FloatArray, more: FloatArray) -> FloatArray:
    """Both, each point once, in order."""
    return np.array(list(dict.fromkeys(tuple(row) for row in np.vstack([x, more]).tolist())))
