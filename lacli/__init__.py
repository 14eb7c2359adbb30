"""Regional stiffness of the left atrium: anatomy, mechanics, inference.

The verbs and types listed in ``__all__`` are the whole public interface; each is loaded when it is first used, so that
``import lacli`` is quick. Lengths are in mm, volumes in mL, pressures in mmHg, stiffness in kPa, times in s, as names say.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

from lacli.base.version import __version__

if TYPE_CHECKING:
    from lacli.anatomy.segmentation.road import SegmentationOptions, Segmented
    from lacli.api.anatomy import Meshing, mesh
    from lacli.api.inference import Emulation, Matching, NothingLeft, Sensitivity, emulate, match, sensitivity
    from lacli.api.mechanics import read_deck, rerun, simulate, write_deck
    from lacli.api.progress import Progress
    from lacli.api.segmentation import segment
    from lacli.api.study import Report, compare, stats, write_report
    from lacli.api.validation import validate
    from lacli.base.errors import Cancelled, LacliError
    from lacli.contracts.scene import Scene, load_scene
    from lacli.contracts.tables.table import RunTable, read_runs
    from lacli.contracts.targets import Targets, read_targets
    from lacli.inference.box import Box, make_box, read_box
    from lacli.inference.emulation.emulator_set import EmulatorSet, load_emulators, save_emulators
    from lacli.mechanics.simulation import RunResult
    from lacli.motion.validation import Validation

__all__ = [
    "Box",
    "Cancelled",
    "Emulation",
    "EmulatorSet",
    "LacliError",
    "Matching",
    "Meshing",
    "NothingLeft",
    "Progress",
    "Report",
    "RunResult",
    "RunTable",
    "Scene",
    "SegmentationOptions",
    "Segmented",
    "Sensitivity",
    "Targets",
    "Validation",
    "__version__",
    "compare",
    "emulate",
    "load_emulators",
    "load_scene",
    "make_box",
    "match",
    "mesh",
    "read_box",
    "read_deck",
    "read_runs",
    "read_targets",
    "rerun",
    "save_emulators",
    "segment",
    "sensitivity",
    "simulate",
    "stats",
    "validate",
    "write_deck",
    "write_report",
]

_HOMES = {
    "lacli.anatomy.segmentation.road": ("SegmentationOptions", "Segmented"),
    "lacli.api.anatomy": ("Meshing", "mesh"),
    "lacli.api.inference": ("Emulation", "Matching", "NothingLeft", "Sensitivity", "emulate", "match", "sensitivity"),
    "lacli.api.mechanics": ("read_deck", "rerun", "simulate", "write_deck"),
    "lacli.api.progress": ("Progress",),
    "lacli.api.segmentation": ("segment",),
    "lacli.api.study": ("Report", "compare", "stats", "write_report"),
    "lacli.api.validation": ("validate",),
    "lacli.base.errors": ("Cancelled", "LacliError"),
    "lacli.contracts.scene": ("Scene", "load_scene"),
    "lacli.contracts.tables.table": ("RunTable", "read_runs"),
    "lacli.contracts.targets": ("Targets", "read_targets"),
    "lacli.inference.box": ("Box", "make_box", "read_box"),
    "lacli.inference.emulation.emulator_set": ("EmulatorSet", "load_emulators", "save_emulators"),
    "lacli.mechanics.simulation": ("RunResult",),
    "lacli.motion.validation": ("Validation",),
}
_HOME = {name: home for home, names in _HOMES.items() for name in names}


def __getattr__(name: str) -> object:
    if name not in _HOME:
        raise AttributeError(f"module 'lacli' has no attribute {name!r}")
    return getattr(importlib.import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
