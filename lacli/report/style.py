"""Colours and print settings that all figures share."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

# Okabe and Ito's palette: told apart by colour-blind readers, and in this order by their grey value too
REGION_COLOURS: dict[str, str] = {
    "anterior": "#0072B2",
    "posterior": "#D55E00",
    "septum": "#009E73",
    "lateral": "#CC79A7",
    "roof": "#E69F00",
}
RING_COLOUR = "#8C8C8C"
PLANE_COLOUR = "#E4E4E4"

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
