"""What lacli tells besides its results: notes on standard error, each once, and what a long silent step is doing."""

from __future__ import annotations

import contextlib
import logging
import threading
from collections.abc import Iterator

_logger = logging.getLogger("lacli")
_told: set[str] = set()
_PATIENCE_S = 3.0


def note(text: str, once: bool = True) -> None:
    """Tell ``text`` (a warning of the logger ``lacli``); the same text once a process."""
    if once and text in _told:
        return
    _told.add(text)
    _logger.warning("%s", text)


@contextlib.contextmanager
def slow(text: str, after_s: float = _PATIENCE_S) -> Iterator[None]:
    """Tell what is being done if the block takes longer than ``after_s`` seconds."""
    timer = threading.Timer(after_s, note, (text, False))
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
