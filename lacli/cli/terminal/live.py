"""The line that a running simulation shows on standard error: phase, load, Newton, time left."""

from __future__ import annotations

import math
import time
from types import TracebackType
from typing import Any

from rich.live import Live
from rich.text import Text

from lacli.cli.terminal.console import err


class LiveLine:
    """Takes the simulation's progress events; where standard error is no terminal, prints a line a phase."""

    def __init__(self) -> None:
        self._start = time.monotonic()
        self._phase, self._phase_start = "", self._start
        self._event: Any = None
        self._live = Live(get_renderable=self._line, console=err, refresh_per_second=4, transient=True)

    def __enter__(self) -> LiveLine:
        if err.is_terminal:
            self._live.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if err.is_terminal:
            self._live.stop()

    def __call__(self, event: Any) -> None:
        """event: has phase, load, newton, residual, minj (NaN where not given)."""
        if event.phase != self._phase:
            self._phase, self._phase_start = event.phase, time.monotonic()
            if not err.is_terminal:
                err.print(f"{time.monotonic() - self._start:6.1f} s  {event.phase}", highlight=False)
        self._event = event

    def _line(self) -> Text:
        now = time.monotonic()
        if self._event is None:
            return Text(f"starting, {now - self._start:.0f} s")
        return Text(describe(self._event, now - self._start, now - self._phase_start))


def describe(event: Any, elapsed: float, in_phase: float) -> str:
    """One line on an event; ``elapsed`` seconds since the start, ``in_phase`` since the phase began."""
    words = [event.phase or "running"]
    if math.isfinite(event.load):
        words.append(f"load {100 * event.load:.0f} %")
    if math.isfinite(event.newton):
        words.append(f"Newton {event.newton:.0f}")
    if math.isfinite(event.residual):
        words.append(f"residual {event.residual:.1e}")
    if math.isfinite(event.minj):
        words.append(f"min J {event.minj:.2f}")
    words.append(f"{elapsed:.0f} s")
    if math.isfinite(event.load) and 0.02 < event.load < 1:
        words.append(f"about {in_phase * (1 - event.load) / event.load:.0f} s left in this phase")
    return "  ".join(words)
