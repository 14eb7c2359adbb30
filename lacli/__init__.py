"""Regional stiffness of the left atrium: anatomy, mechanics, inference.

The verbs and types listed in ``__all__`` are the whole public interface; each is loaded when it is first used, so that
``import lacli`` is quick. Lengths are in mm, volumes in mL, pressures in mmHg, stiffness in kPa, times in s, as names say.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

from lacli.base.version import __version__

if TYPE_CHECKING:
    from lacli.anatomy.segmentation.road import Options as SegmentationOptions
    from lacli.anatomy.segmentation.road import Segmented
    from lacli.api.anatomy import FatSegmentation, Meshing, Synthesis, fat, mesh, synthesize
    from lacli.api.calibration import Calibrated, Recovered, calibrate, recover
    from lacli.api.design import Design, design
    from lacli.api.inference import Emulation, Matching, NothingLeft, Sensitivity, emulate, match, sensitivity
    from lacli.api.mechanics import Tradeoff, doctor, read_deck, rerun, simulate, tradeoff, verify, write_deck
    from lacli.api.motion import Tracking, track
    from lacli.api.posterior import Posterior, posterior
    from lacli.api.progress import Progress
    from lacli.api.questions import study
    from lacli.api.segmentation import segment
    from lacli.api.study import Cohort, Report, compare, plan_cohort, run_cohort, stats, write_report, write_slurm
    from lacli.api.validation import validate
    from lacli.base.errors import Cancelled, LacliError
    from lacli.calibration.calibration import Settings as CalibrationSettings
    from lacli.cohort.studies.laplace import LaplaceStudy
    from lacli.cohort.studies.thickness import ThicknessStudy
    from lacli.contracts.scene import Scene, load_scene
    from lacli.contracts.tables.table import RunTable, read_one, read_runs
    from lacli.contracts.targets import Targets, read_targets
    from lacli.inference.box import Box, make_box, read_box
    from lacli.inference.emulation.emulator_set import EmulatorSet, load_emulators, save_emulators
    from lacli.inference.sampling.posterior import Settings as SamplingSettings
    from lacli.mechanics.installation import Check as InstallationCheck
    from lacli.mechanics.simulation import RunResult
    from lacli.motion.check.validation import Validation
    from lacli.verification.problems import Check as VerificationCheck

__all__ = [
    "Box",
    "Calibrated",
    "CalibrationSettings",
    "Cancelled",
    "Cohort",
    "Design",
    "Emulation",
    "EmulatorSet",
    "FatSegmentation",
    "InstallationCheck",
    "LacliError",
    "LaplaceStudy",
    "Matching",
    "Meshing",
    "NothingLeft",
    "Posterior",
    "Progress",
    "Recovered",
    "Report",
    "RunResult",
    "RunTable",
    "SamplingSettings",
    "Scene",
    "SegmentationOptions",
    "Segmented",
    "Sensitivity",
    "Synthesis",
    "Targets",
    "ThicknessStudy",
    "Tracking",
    "Tradeoff",
    "Validation",
    "VerificationCheck",
    "__version__",
    "calibrate",
    "compare",
    "design",
    "doctor",
    "emulate",
    "fat",
    "load_emulators",
    "load_scene",
    "make_box",
    "match",
    "mesh",
    "plan_cohort",
    "posterior",
    "read_box",
    "read_deck",
    "read_one",
    "read_runs",
    "read_targets",
    "recover",
    "rerun",
    "run_cohort",
    "save_emulators",
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
    "write_deck",
    "write_report",
    "write_slurm",
]

_HOMES = {
    "lacli.anatomy.segmentation.road": ("Segmented",),
    "lacli.api.anatomy": ("FatSegmentation", "Meshing", "Synthesis", "fat", "mesh", "synthesize"),
    "lacli.api.calibration": ("Calibrated", "Recovered", "calibrate", "recover"),
    "lacli.api.design": ("Design", "design"),
    "lacli.api.inference": ("Emulation", "Matching", "NothingLeft", "Sensitivity", "emulate", "match", "sensitivity"),
    "lacli.api.mechanics": ("Tradeoff", "doctor", "read_deck", "rerun", "simulate", "tradeoff", "verify", "write_deck"),
    "lacli.api.motion": ("Tracking", "track"),
    "lacli.api.posterior": ("Posterior", "posterior"),
    "lacli.api.progress": ("Progress",),
    "lacli.api.questions": ("study",),
    "lacli.api.segmentation": ("segment",),
    "lacli.api.study": ("Cohort", "Report", "compare", "plan_cohort", "run_cohort", "stats", "write_report", "write_slurm"),
    "lacli.api.validation": ("validate",),
    "lacli.base.errors": ("Cancelled", "LacliError"),
    "lacli.cohort.studies.laplace": ("LaplaceStudy",),
    "lacli.cohort.studies.thickness": ("ThicknessStudy",),
    "lacli.contracts.scene": ("Scene", "load_scene"),
    "lacli.contracts.tables.table": ("RunTable", "read_one", "read_runs"),
    "lacli.contracts.targets": ("Targets", "read_targets"),
    "lacli.inference.box": ("Box", "make_box", "read_box"),
    "lacli.inference.emulation.emulator_set": ("EmulatorSet", "load_emulators", "save_emulators"),
    "lacli.motion.check.validation": ("Validation",),
    "lacli.mechanics.simulation": ("RunResult",),
}
_HOME = {name: (home, name) for home, names in _HOMES.items() for name in names} | {
    "CalibrationSettings": ("lacli.calibration.calibration", "Settings"),
    "InstallationCheck": ("lacli.mechanics.installation", "Check"),
    "SamplingSettings": ("lacli.inference.sampling.posterior", "Settings"),
    "SegmentationOptions": ("lacli.anatomy.segmentation.road", "Options"),
    "VerificationCheck": ("lacli.verification.problems", "Check"),
}


def __getattr__(name: str) -> object:
    if name not in _HOME:
        raise AttributeError(f"module 'lacli' has no attribute {name!r}")
    home, there = _HOME[name]
    return getattr(importlib.import_module(home), there)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
