"""What a run of FreeFEM does with memory that it has freed: it keeps it.

The linear solver takes a hundred megabytes for every factorisation and gives them back. glibc hands pieces of that size to the
system at once, and the next factorisation gets them page by page, each filled with zeros: a tenth of its time or more.
"""

from __future__ import annotations

import os

# glibc's own names: no piece is mapped by itself, and the heap's end is given back above 16 GiB alone
KEPT = {"MALLOC_MMAP_MAX_": "0", "MALLOC_TRIM_THRESHOLD_": str(2**34)}


def environment() -> dict[str, str]:
    """What a run's environment gets; what the user has chosen stands. Other C libraries do not look at it."""
    return {name: os.environ.get(name) or value for name, value in KEPT.items()}
