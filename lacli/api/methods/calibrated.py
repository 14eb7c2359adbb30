"""What calibrations give, whatever their method."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from lacli.api.progress import Cancel, OnProgress
    from lacli.calibration.calibration import Calibration
    from lacli.calibration.sequential.result import Sequential
    from lacli.calibration.synthetic_truth import Recovery
    from lacli.inference.box import Box


@dataclass(frozen=True)
class Work:
    """How a calibration is worked at, whatever its method; each as the argument of ``lacli.calibrate`` of its name."""

    box: Box | None = None
    store: Path | None = None
    workers: int | None = None
    scheduler: str | None = None
    sensitivities: bool = True
    fresh: bool = False
    retry: bool = False
    discretisation: bool = True
    figures: bool = False
    progress: OnProgress | None = None
    cancel: Cancel | None = None
    cheap: tuple[str, ...] = ()
    warm: bool = False


@dataclass(frozen=True)
class Calibrated:
    """A calibration, the folder of its files, and how far it may be believed.

    result: ``Sequential`` or, by the published method, ``Calibration``; both have the most probable point ``map_x`` (d,), the
    ``chain``, the ``table`` of the posterior by input and the ``fit`` by feature, in the units of their names. notes: what was
    met on the way; warnings: what a user must know of the answer; refused: why it is none, empty where it is one; pictures:
    those drawn.
    """

    folder: Path
    result: Calibration | Sequential
    notes: tuple[str, ...]
    warnings: tuple[str, ...]
    refused: str
    pictures: tuple[Path, ...]


@dataclass(frozen=True)
class Recovered:
    """Calibrations against a simulation at known parameters, one by noise level, and the folder of their files.

    Rows of a level are in the units of the inputs' names: truth, 95 % interval, most probable value, and whether the truth
    is inside.
    """

    folder: Path
    levels: tuple[Recovery, ...]
    pictures: tuple[Path, ...]
