"""Regional stiffness of the left atrium: anatomy, mechanics, inference.

A verb for each command, and the types that every call meets; what else verbs take and give, and what reads their files, is in
``lacli.types``. That is the whole public interface. Each name is loaded when it is first used, so that ``import lacli`` is
quick. Lengths are in mm, volumes in mL, pressures in mmHg, stiffness in kPa, times in s, as names say.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from lacli.base.lazy import names_from
from lacli.base.version import __version__

if TYPE_CHECKING:
    from lacli.api.anatomy import fat, mesh, synthesize
    from lacli.api.calibration import calibrate
    from lacli.api.cohort import run_cohort
    from lacli.api.design import design
    from lacli.api.inference import emulate, match, sensitivity
    from lacli.api.mechanics import doctor, simulate, tradeoff, verify
    from lacli.api.motion import track
    from lacli.api.posterior import posterior
    from lacli.api.progress import Progress
    from lacli.api.questions import study
    from lacli.api.segmentation import segment
    from lacli.api.study import compare, stats, write_report
    from lacli.api.validation import validate
    from lacli.base.errors import Cancelled, LacliError
    from lacli.contracts.scene import Scene
    from lacli.contracts.targets import Targets
    from lacli.inference.box import Box

__all__ = [
    "Box",
    "Cancelled",
    "LacliError",
    "Progress",
    "Scene",
    "Targets",
    "__version__",
    "calibrate",
    "compare",
    "design",
    "doctor",
    "emulate",
    "fat",
    "match",
    "mesh",
    "posterior",
    "run_cohort",
    "segment",
    "sensitivity",
    "simulate",
    "stats",
    "study",
    "synthesize",
    "track",
    "tradeoff",
    "validate",
    "verify",
    "write_report",
]

__getattr__ = names_from(
    __name__,
    {
        "lacli.api.anatomy": ("fat", "mesh", "synthesize"),
        "lacli.api.calibration": ("calibrate",),
        "lacli.api.cohort": ("run_cohort",),
        "lacli.api.design": ("design",),
        "lacli.api.inference": ("emulate", "match", "sensitivity"),
        "lacli.api.mechanics": ("doctor", "simulate", "tradeoff", "verify"),
        "lacli.api.motion": ("track",),
        "lacli.api.posterior": ("posterior",),
        "lacli.api.progress": ("Progress",),
        "lacli.api.questions": ("study",),
        "lacli.api.segmentation": ("segment",),
        "lacli.api.study": ("compare", "stats", "write_report"),
        "lacli.api.validation": ("validate",),
        "lacli.base.errors": ("Cancelled", "LacliError"),
        "lacli.contracts.scene": ("Scene",),
        "lacli.contracts.targets": ("Targets",),
        "lacli.inference.box": ("Box",),
    },
)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
