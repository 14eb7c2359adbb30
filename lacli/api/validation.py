"""A simulation's transients against the tracked motion, in one call."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from lacli.base.documents import brief, read_json
from lacli.base.errors import InputError, UsageError

if TYPE_CHECKING:
    import pandas as pd

    from lacli.motion.check.validation import Validation


def validate(run: Path, motion: Path, *, targets: Path | None = None, out: Path | None = None) -> Validation:
    """How far a run, at the MAP for example, is from the tracked motion in every frame, those not used for calibration apart.

    run: folder of a simulation whose steps reach over the frames; motion: folder of `lacli track`; targets: the file that was
    calibrated to, default the motion's. ``by_frame`` and ``by_kind`` of the result are tables of root mean squares, units in the
    features' names (mm, mL). out: folder for validation.csv, validation_kinds.csv and validation.png. Raises InputError,
    TableError, UsageError, StorageError.
    """
    from lacli.base.files import check_folder, replacing
    from lacli.contracts.targets import read_targets
    from lacli.motion.check.validation import compare
    from lacli.report.validation_figures import transients

    if out is not None:
        check_folder(out)
        if out.resolve() in (run.resolve(), motion.resolve()):
            raise UsageError(f"{out}: results have their own folder; choose another than the run's and the motion's.")
    simulated, tracked = _table(run / "transients.csv"), _table(motion / "transients.csv")
    sd, es, shrinkage, closed = _tracking(motion / "tracking.json")
    names = read_targets(targets or motion / "targets.toml").names
    try:
        found = compare(simulated, tracked, sd, names, es, shrinkage, closed)
    except InputError as error:
        raise InputError(f"{run} against {motion}: {error}") from error
    _tell_end_systole(run, simulated, motion, es)
    if out is not None:
        for name, table in (("validation.csv", found.by_frame()), ("validation_kinds.csv", found.by_kind())):
            with replacing(out / name) as temporary:
                table.to_csv(temporary, index=False)
        with replacing(out / "validation.png") as temporary:
            transients(found, temporary)
    return found


def _tell_end_systole(run: Path, simulated: pd.DataFrame, motion: Path, tracked_es: float) -> None:
    from lacli.base.notes import note
    from lacli.contracts.targets import SAME_ES

    if not {"phase", "time"} <= set(simulated) or not (simulated["phase"] == "reservoir").any():
        return  # not of `lacli simulate`
    own = float(simulated.loc[simulated["phase"] == "reservoir", "time"].max())
    if abs(own - tracked_es) > SAME_ES:
        note(
            f"{run}: end-systole is at {own:.3g} of the cycle, in {motion} at {tracked_es:.3g}: frames were simulated at other "
            f"pressures than they were imaged at. Simulate with motion.es_time={tracked_es:.3g}, or, where the annulus moves as "
            "the bundle says, track with --update-bundle."
        )


def _tracking(path: Path) -> tuple[dict[str, float], float, dict[str, dict[str, float]] | None, bool]:
    """The features' sd, the time of end-systole, the shrinkage (or None), and whether a drift was corrected: as tracking.json
    tells. Raises InputError."""
    info = read_json(path)
    sd, phases, shrinkage = (info.get(key) if isinstance(info, dict) else None for key in ("sd", "phases", "shrinkage"))
    if not isinstance(sd, dict) or not isinstance(phases, dict) or not _is_number(phases.get("es")):
        raise InputError(f"{path}: no sd or phases in it; track again.")
    if wrong := next((name for name, value in sd.items() if not _is_number(value)), None):
        raise InputError(f"{path}: sd.{wrong} is {brief(sd[wrong])}, not a number; track again.")
    parts = shrinkage.values() if isinstance(shrinkage, dict) else () if shrinkage is None else (None,)
    # without ``regional`` where an older version tracked
    told = ({"regional": 0.0, **part} if isinstance(part, dict) else {} for part in parts)
    if not all(_is_number(part.get(name)) for part in told for name in ("sd", "share", "regional")):
        raise InputError(f"{path}: its shrinkage is damaged; track again.")
    return {name: float(value) for name, value in sd.items()}, float(phases["es"]), shrinkage, info.get("closure_mm") is not None


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _table(path: Path) -> pd.DataFrame:
    import pandas as pd

    try:
        return pd.read_csv(path)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; give the folder of a run, and that of `lacli track`.") from None
    except (OSError, ValueError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read as a table ({str(error)[:120]}).") from None
