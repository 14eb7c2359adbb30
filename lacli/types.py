"""The types that the verbs of ``lacli`` take and give, and what reads and writes their files.

Lengths are in mm, volumes in mL, pressures in mmHg, stiffness in kPa, times in s, as names say; what a table or a box of a user's
own holds keeps the units of its names. Each name is loaded when it is first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from lacli.base.lazy import names_from

if TYPE_CHECKING:
    from lacli.anatomy.segmentation.road import Options as SegmentationOptions
    from lacli.anatomy.segmentation.road import Segmented
    from lacli.api.anatomy import FatSegmentation, Meshing, Synthesis
    from lacli.api.cohort import Cohort
    from lacli.api.design import Design
    from lacli.api.inference import Emulation, Matching, NothingLeft, Sensitivity
    from lacli.api.mechanics import Tradeoff, read_deck, rerun, write_deck
    from lacli.api.methods.calibrated import Calibrated, Recovered
    from lacli.api.methods.numerics import CalibrationTradeoff
    from lacli.api.motion import Tracking
    from lacli.api.posterior import Posterior
    from lacli.api.study import Report
    from lacli.calibration.calibration import Settings as PublishedSettings
    from lacli.calibration.price import Price
    from lacli.calibration.sequential.draw.information import Forecast
    from lacli.calibration.sequential.search import Settings as SequentialSettings
    from lacli.cohort.studies.laplace import LaplaceStudy
    from lacli.cohort.studies.thickness import ThicknessStudy
    from lacli.contracts.scene import load_scene
    from lacli.contracts.tables.table import RunTable, read_one, read_runs
    from lacli.contracts.targets import read_targets
    from lacli.inference.box import make_box, read_box
    from lacli.inference.emulation.emulator_set import EmulatorSet, load_emulators, save_emulators
    from lacli.inference.sampling.posterior import Settings as SamplingSettings
    from lacli.mechanics.installation import Check as InstallationCheck
    from lacli.mechanics.simulation import RunResult
    from lacli.motion.check.validation import Validation
    from lacli.verification.problems import Check as VerificationCheck

__all__ = [
    "Calibrated",
    "CalibrationTradeoff",
    "Cohort",
    "Design",
    "Emulation",
    "EmulatorSet",
    "FatSegmentation",
    "Forecast",
    "InstallationCheck",
    "LaplaceStudy",
    "Matching",
    "Meshing",
    "NothingLeft",
    "Posterior",
    "Price",
    "PublishedSettings",
    "Recovered",
    "Report",
    "RunResult",
    "RunTable",
    "SamplingSettings",
    "SegmentationOptions",
    "Segmented",
    "Sensitivity",
    "SequentialSettings",
    "Synthesis",
    "ThicknessStudy",
    "Tracking",
    "Tradeoff",
    "Validation",
    "VerificationCheck",
    "load_emulators",
    "load_scene",
    "make_box",
    "read_box",
    "read_deck",
    "read_one",
    "read_runs",
    "read_targets",
    "rerun",
    "save_emulators",
    "write_deck",
]

__getattr__ = names_from(
    __name__,
    {
        "lacli.anatomy.segmentation.road": ("Options as SegmentationOptions", "Segmented"),
        "lacli.api.anatomy": ("FatSegmentation", "Meshing", "Synthesis"),
        "lacli.api.cohort": ("Cohort",),
        "lacli.api.design": ("Design",),
        "lacli.api.inference": ("Emulation", "Matching", "NothingLeft", "Sensitivity"),
        "lacli.api.mechanics": ("Tradeoff", "read_deck", "rerun", "write_deck"),
        "lacli.api.methods.calibrated": ("Calibrated", "Recovered"),
        "lacli.api.methods.numerics": ("CalibrationTradeoff",),
        "lacli.api.motion": ("Tracking",),
        "lacli.api.posterior": ("Posterior",),
        "lacli.api.study": ("Report",),
        "lacli.calibration.calibration": ("Settings as PublishedSettings",),
        "lacli.calibration.price": ("Price",),
        "lacli.calibration.sequential.draw.information": ("Forecast",),
        "lacli.calibration.sequential.search": ("Settings as SequentialSettings",),
        "lacli.cohort.studies.laplace": ("LaplaceStudy",),
        "lacli.cohort.studies.thickness": ("ThicknessStudy",),
        "lacli.contracts.scene": ("load_scene",),
        "lacli.contracts.tables.table": ("RunTable", "read_one", "read_runs"),
        "lacli.contracts.targets": ("read_targets",),
        "lacli.inference.box": ("make_box", "read_box"),
        "lacli.inference.emulation.emulator_set": ("EmulatorSet", "load_emulators", "save_emulators"),
        "lacli.inference.sampling.posterior": ("Settings as SamplingSettings",),
        "lacli.mechanics.installation": ("Check as InstallationCheck",),
        "lacli.mechanics.simulation": ("RunResult",),
        "lacli.motion.check.validation": ("Validation",),
        "lacli.verification.problems": ("Check as VerificationCheck",),
    },
)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
