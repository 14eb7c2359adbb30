"""Kinds of failure that are the machine's and not the simulator's: no results, nothing is learnt from them."""

from __future__ import annotations

# asked for again, such a run is done again
TRANSIENT_KINDS = frozenset({"killed", "out_of_memory", "disk_full", "lost_worker", "cancelled"})
# after so many of them for one point it is no accident: stop, and say what would help
MOST_ATTEMPTS = 3
