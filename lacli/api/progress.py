"""How far a long call is, and the caller's word that it is no longer wanted."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from lacli.base.errors import Cancelled

if TYPE_CHECKING:
    from lacli.calibration.calibration import Status
    from lacli.freefem.run import Progress as SolverProgress


@dataclass(frozen=True)
class Progress:
    """How far a call is.

    stage: what is being done; done of total: its steps (of a simulation: the share of the load in this phase, of 1);
    left_s: seconds left of the stage by the pace so far, None where nothing is known of it; solver: of a simulation,
    the solver's own words (phase, load, Newton step, residual, least Jacobian); calibration: of a calibration, its waves.
    """

    stage: str
    done: float
    total: float
    left_s: float | None = None
    solver: SolverProgress | None = None
    calibration: Status | None = None


OnProgress = Callable[[Progress], None]
Cancel = Callable[[], bool]


class Stage:
    """Tells the progress of one stage and asks at each step whether the call is still wanted."""

    def __init__(self, name: str, total: float, progress: OnProgress | None, cancel: Cancel | None) -> None:
        self.name, self.total, self._progress, self._cancel = name, total, progress, cancel
        self._done = self._first = 0.0
        self._begin = time.monotonic()

    def begin(self) -> Stage:
        """The stage, told as begun. Raises Cancelled."""
        self.reach(0.0)
        return self

    def reach(self, done: float, solver: SolverProgress | None = None, calibration: Status | None = None) -> None:
        """``done`` of the total is reached. Raises Cancelled."""
        self._done = done
        if self._progress is not None:
            left = None
            if done > self._first:
                left = (time.monotonic() - self._begin) / (done - self._first) * max(0.0, self.total - done)
            self._progress(Progress(self.name, done, self.total, left, solver, calibration))
        check(self._cancel, self.name)

    def step(self) -> None:
        """One more step is done. Raises Cancelled."""
        self.reach(self._done + 1)

    def next(self, name: str) -> None:
        """One more step is done, and what follows has this name. Raises Cancelled."""
        self.name = name
        self.step()

    def of(self, name: str, done: float, total: float, calibration: Status | None = None) -> None:
        """``done`` of ``total`` is reached in what has this name; another name begins another stage. Raises Cancelled."""
        if name != self.name:
            self._begin, self._first = time.monotonic(), done
        self.name, self.total = name, total
        self.reach(done, calibration=calibration)


def check(cancel: Cancel | None, stage: str) -> None:
    """Raises Cancelled where the caller no longer wants the call."""
    if cancel is not None and cancel():
        raise Cancelled(f"cancelled during {stage}. What was finished is kept; call again to go on.")
