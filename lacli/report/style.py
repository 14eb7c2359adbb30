"""Print settings that all figures share. (Colours of regions: contracts.labels.)"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

_SETTINGS: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 9.0,
    "axes.titlesize": 9.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.8,
    "legend.frameon": False,
    "savefig.dpi": 200,
    "figure.constrained_layout.use": True,
}


@contextmanager
def paper() -> Iterator[None]:
    """Matplotlib without a display, set for print (widths in inches: 3.5 for one column, 7.2 for two)."""
    import matplotlib

    with matplotlib.rc_context(_SETTINGS):
        matplotlib.use("agg", force=True)
        yield
