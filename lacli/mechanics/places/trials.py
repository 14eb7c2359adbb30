"""Runs that the machine ended: tried again, and given up with the reason after the third time."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from lacli.base.errors import LacliError, StorageError
from lacli.base.notes import note
from lacli.base.processes.machine import memory_limit
from lacli.contracts.failures import MACHINE, MOST_ATTEMPTS
from lacli.contracts.identity import run_key
from lacli.contracts.scene import Scene

if TYPE_CHECKING:
    from lacli.mechanics.simulation import RunResult


class Trials:
    """How often, and how, the machine ended each run of a series; memory (MB) that each was seen to take."""

    def __init__(self, scenes: Sequence[Scene], root: Path) -> None:
        self.scenes, self.root = scenes, root
        self.kinds: dict[int, list[str]] = defaultdict(list)
        self.memory_mb: dict[int, float] = defaultdict(float)
        self.alone: set[int] = set()  # runs that had too little memory beside others

    def ended(self, index: int, kind: str, message: str, memory_mb: float = 0.0, last: bool = False) -> RunResult | None:
        """The machine ended run ``index``: None, it shall be tried again, or the result that gives it up (``last``: at once).

        Raises StorageError where the disk is full, which would end every other run as well.
        """
        if kind == "disk_full":
            raise StorageError(message)
        self.memory_mb[index] = max(self.memory_mb[index], memory_mb)
        self.kinds[index].append(kind)
        if kind in ("out_of_memory", "killed"):
            self.alone.add(index)
        if not last and len(self.kinds[index]) < MOST_ATTEMPTS:
            note(f"run {run_key(self.scenes[index])}: {message} Tried once more.", once=False)
            return None
        words = f"{self._account(index)} {message}{self._memory(index)}"
        return _given_up(self.scenes[index], self.root, kind, words, self.memory_mb[index])

    def _account(self, index: int) -> str:
        counted = Counter(self.kinds[index])
        times = ", ".join(f"{MACHINE[kind]}: {n} x" if n > 1 else MACHINE[kind] for kind, n in counted.items())
        return f"Given up, the machine ended it ({times}); nothing of it is kept."

    def _memory(self, index: int) -> str:
        if self.memory_mb[index] < 1 or "ulimit" in memory_limit():
            return ""
        return f" It was seen to take {self.memory_mb[index]:.0f} MB; {memory_limit()}."


def _given_up(scene: Scene, root: Path, kind: str, message: str, memory_mb: float) -> RunResult:
    from lacli.mechanics.simulation import RunResult

    key = run_key(scene)
    manifest = {
        "key": key, "status": "failed", "kind": kind, "message": message, "attempts": MOST_ATTEMPTS, "peak_memory_mb": memory_mb,
    }  # fmt: skip
    return RunResult(key, root / key, "failed", kind, message, {}, manifest)


def portable(error: Exception) -> Exception:
    """An error as another process shall see it; of a bug, with its traceback in the text."""
    if isinstance(error, LacliError):
        kind = type(error)
        return kind(str(error)) if kind.__init__ is Exception.__init__ else LacliError(str(error))
    import traceback

    return RuntimeError("".join(traceback.format_exception(error)))
