"""FreeFEM's process keeps what it has freed, so that a factorisation does not get its memory from the system anew."""

import os
import platform
import subprocess
import sys

import pytest

from lacli.freefem import memory
from lacli.freefem.program import find
from lacli.mechanics.deck import shell_script

PIECE, TIMES, PAGE = 1 << 26, 4, 4096
# pages that the system has given while a piece is taken, filled and freed again and again
ASKED = f"""
import ctypes, resource
c = ctypes.CDLL(None)
c.malloc.restype, c.malloc.argtypes, c.free.argtypes = ctypes.c_void_p, [ctypes.c_size_t], [ctypes.c_void_p]
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range({TIMES}):
    piece = c.malloc({PIECE})
    ctypes.memset(piece, 1, {PIECE})
    c.free(piece)
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def pages(**environment: str) -> int:
    clean = {name: value for name, value in os.environ.items() if name not in memory.KEPT}
    answer = subprocess.run([sys.executable, "-c", ASKED], capture_output=True, text=True, check=True, env=clean | environment)
    return int(answer.stdout)


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another C library")
def test_memory_that_was_freed_is_used_again() -> None:
    """Pages of one piece, not of four; huge pages, where the system gives them, are fewer both times."""
    kept, given_back = pages(**memory.environment()), pages()
    assert kept <= 1.1 * PIECE / PAGE
    assert given_back > 2 * kept


def test_a_users_choice_stands(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("MALLOC_MMAP_MAX_", raising=False)
    assert find().environment()["MALLOC_MMAP_MAX_"] == "0"
    monkeypatch.setenv("MALLOC_MMAP_MAX_", "100")
    assert find().environment()["MALLOC_MMAP_MAX_"] == "100"


def test_a_deck_run_by_hand_keeps_it_too() -> None:
    said = shell_script()
    assert all(f"export {name}=" in said for name in memory.KEPT)
