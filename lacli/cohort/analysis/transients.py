"""A patient's transients: the image's, those of the calibration's first runs, and the run's at the most probable point."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from lacli.base.arrays import FloatArray
from lacli.base.documents import read_json, read_toml
from lacli.contracts.features import SAME_TIME, parse
from lacli.contracts.labels import BODY_REGIONS
from lacli.contracts.parameters import QUANTITIES
from lacli.contracts.tables.file import read_frame
from lacli.motion.errors.courses import course

KEYS = ("volume_ml", "d_global_mm", *(f"d_{region}_mm" for region in BODY_REGIONS))
_CHEAP, _RUNS, _STORE = "runs_cheap.csv", "runs.csv", "runs"
_GRID = np.linspace(0.0, 1.0, 41)
_BAND = (2.5, 97.5)  # percent of the first runs; of few, all of them


def transients(
    patient: str, folder: Path, result: Mapping[str, Any], moments: Sequence[Mapping[str, Any]] = ()
) -> list[dict[str, Any]]:
    """A row a feature and time (fraction of RR): phase; image with its sd, from the tracked motion in the patient's ``folder``
    or, without one, the targets ``moments`` (as ``fits.courses`` gives them) alone; of the calibration's first runs the number,
    2.5 and 97.5 % and median; the value at the most probable point; whether anything was a target then (``used``).
    Values in the features' units, None where not known.

    Runs are known at their own times only, and where the calibration keeps them in its folder. Raises InputError, TableError.
    """
    simulated = _Simulated.of(folder / "calibration", result)
    image = _image(folder / "motion", simulated.times)
    phases = simulated.phases
    if image is not None:
        phases = read_json(folder / "motion" / "tracking.json")["phases"]
    # a frame is held out only where no feature of it, be it none of these, was a target
    targets = [float(row["time"]) for row in moments] + _of_end_systole(result, simulated.phases)
    rows = []
    for key in KEYS:
        seen = {row["time"]: (row["target"], row["sd"]) for row in moments if row["feature"] == key}
        if image is not None:
            seen = dict(zip(image[0].tolist(), zip(*image[1][key], strict=True), strict=True)) if key in image[1] else {}
        for time in _joined([*seen, *simulated.times]):
            value, sd = next((pair for at, pair in seen.items() if abs(at - time) < SAME_TIME), (None, None))
            row = {"participant_id": patient, "feature": key, "time": time, "phase": _phase(time, phases),
                   "used": any(abs(at - time) < SAME_TIME for at in targets), "image": value, "image_sd": sd,
                   **simulated.at(key, time)}  # fmt: skip
            rows.append(row)
    return rows


def _of_end_systole(result: Mapping[str, Any], phases: Mapping[str, float]) -> list[float]:
    """Its time in the runs where a target was of it; none where that is not known."""
    for fit in result["fit"] if "es" in phases else ():
        with contextlib.suppress(ValueError):  # a target of the user's own
            if parse(str(fit["feature"]))[1] is None:
                return [phases["es"]]
    return []


def over_transients(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """By patient and time of the run at the most probable point after end-diastole: its phase, whether any of it was a target
    (``used``; what was not is held out), root mean square of run less image over the regions' displacements (mm), and that of the
    volume (mL); also over the times of a phase, used and held out apart, time None."""
    frame = pd.DataFrame(list(rows))
    if frame.empty:
        return []
    frame = frame.assign(used=frame.groupby(["participant_id", "time"])["used"].transform("any"))
    frame = frame[(frame["time"] > 0.0) & frame["at_map"].notna() & frame["image"].notna()]
    frame = frame.assign(off=frame["at_map"].astype(float) - frame["image"].astype(float))
    found = []
    for (patient, time, phase, told), mine in frame.groupby(["participant_id", "time", "phase", "used"], sort=False):
        found.append({"participant_id": patient, "time": time, "phase": phase, "used": told, **_misfit(mine)})
    for (patient, phase, told), mine in frame.groupby(["participant_id", "phase", "used"], sort=False):
        found.append({"participant_id": patient, "time": None, "phase": phase, "used": told, **_misfit(mine)})
    return sorted(found, key=lambda r: (str(r["participant_id"]), r["time"] is None, r["time"] or 0.0))


def _misfit(frame: pd.DataFrame) -> dict[str, Any]:
    found: dict[str, Any] = {}
    regional = frame["feature"].isin([f"d_{region}_mm" for region in BODY_REGIONS])
    for name, here in (("rmse_mm", regional), ("volume_rmse_ml", frame["feature"] == "volume_ml")):
        off = frame.loc[here, "off"].to_numpy(float)
        found[name] = float(np.sqrt((off**2).mean())) if len(off) else None
    return found


def _joined(times: Sequence[float]) -> list[float]:
    """Rising, those that have one name once."""
    found: list[float] = []
    for time in sorted(map(float, times)):
        if not found or time - found[-1] >= SAME_TIME:
            found.append(time)
    return found


def _image(motion: Path, times: Sequence[float]) -> tuple[FloatArray, dict[str, tuple[list[float], list[float]]]] | None:
    """Of a tracked motion: times, and values with their sd by feature; None where there is none."""
    if not (motion / "tracking.json").is_file() or not (motion / "transients.csv").is_file():
        return None
    info, frame = read_json(motion / "tracking.json"), read_frame(motion / "transients.csv")
    at = np.array(_joined([*_GRID, *times, float(info["phases"]["es"])]))
    found = {}
    for key in KEYS:
        if key in frame and key in info["sd"]:
            value, sd = course(frame, info, key, at)
            found[key] = (value.tolist(), sd.tolist())
    return at, found


def at_end_systole(motion: Path) -> dict[str, tuple[float, float]]:
    """Of a tracked motion's folder: value and sd at its end-systole by feature (mm, mL); empty where there is none."""
    if (image := _image(motion, ())) is None:
        return {}
    here = int(np.argmin(np.abs(image[0] - float(read_json(motion / "tracking.json")["phases"]["es"]))))
    return {key: (values[here], sd[here]) for key, (values, sd) in image[1].items()}


def _phase(time: float, phases: Mapping[str, float]) -> str:
    """Of a time; end-systole is the reservoir's end."""
    if not phases:
        return ""
    if time <= phases["es"] + SAME_TIME:
        return "reservoir"
    if time <= phases.get("conduit_end", 1.0):
        return "conduit"
    return "diastasis" if time < phases["booster_start"] else "booster"


class _Simulated:
    """Transients of a calibration's runs: of the first ones, and of the one at the most probable point, all at ``times``."""

    def __init__(self, first: Sequence[pd.DataFrame], best: pd.DataFrame | None) -> None:
        self.first, self.best = list(first), best
        known = [*self.first, *([best] if best is not None else [])]
        self.times: list[float] = _joined([time for frame in known for time in frame["time"].tolist()])
        self.phases: dict[str, float] = {}
        if best is not None and "phase" in best:
            self.phases = {"es": float(best.loc[best["phase"] == "reservoir", "time"].max())}

    @classmethod
    def of(cls, calibration: Path, result: Mapping[str, Any]) -> _Simulated:
        """From the runs that the calibration keeps in its folder; those that are gone are left out."""
        inputs = [str(row["input"]) for row in result["posterior"]]
        tables = {name: _table(calibration / name, inputs) for name in (_RUNS, _CHEAP)}
        kept = _stored(calibration / _STORE, inputs)
        if tables[_RUNS] is None or not kept:
            return cls((), None)
        design = tables[_RUNS] if tables[_CHEAP] is None else tables[_CHEAP]
        first = [f for f in (_transients(row, inputs, kept) for row in _first(_records(design), result)) if f is not None]
        rows = _finished(_records(tables[_RUNS]))
        best = [row.get("map") for row in result["posterior"]]
        if not rows or any(value is None for value in best):
            return cls(first, None)
        sd = [max(float(row.get("sd") or 0.0), 1e-300) for row in result["posterior"]]
        away = [max(abs(float(row[n]) - b) / s for n, b, s in zip(inputs, best, sd, strict=True)) for row in rows]
        nearest = int(np.argmin(away))
        # the answer is a run of the calibration's own: one beside it would be another answer
        return cls(first, _transients(rows[nearest], inputs, kept) if away[nearest] < 1e-3 else None)

    def at(self, key: str, time: float) -> dict[str, Any]:
        """What the runs say of a feature at a time."""
        values = [v for v in (_value(frame, key, time) for frame in self.first) if v is not None]
        low, middle, high = np.percentile(values, [_BAND[0], 50.0, _BAND[1]]) if values else (None, None, None)
        if 0 < len(values) < 40:
            low, high = min(values), max(values)
        best = None if self.best is None else _value(self.best, key, time)
        return {"first_runs": len(values), "first_low": low, "first_median": middle, "first_high": high, "at_map": best}


def _value(frame: pd.DataFrame, key: str, time: float) -> float | None:
    here = np.flatnonzero(np.abs(frame["time"].to_numpy(float) - time) < SAME_TIME)
    return float(frame[key].iloc[here[0]]) if len(here) and key in frame else None


def _table(file: Path, inputs: Sequence[str]) -> pd.DataFrame | None:
    """Inputs, state and CPU seconds of the runs of a calibration's table, in their order; None where it tells no inputs."""
    frame = read_frame(file) if file.is_file() else None
    if frame is None or "status" not in frame or not set(inputs) <= set(frame.columns):
        return None
    return frame[[*inputs, "status", *(name for name in ("cpu_s",) if name in frame)]]


def _records(frame: pd.DataFrame | None) -> list[dict[str, Any]]:
    return [] if frame is None else [{str(k): v for k, v in row.items()} for row in frame.to_dict("records")]


def _finished(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    return [row for row in rows if row["status"] == "done"]


def _first(rows: Sequence[dict[str, Any]], result: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The finished ones of the runs that the calibration began with: its first wave, or what its search set out from."""
    if waves := result.get("waves"):
        return _finished(rows)[: int(waves[0]["runs"])]
    # the search counts its failed runs too
    return _finished(rows[: int(next(iter((result.get("runs_by_stage") or {}).values()), 0))])


def _stored(store: Path, inputs: Sequence[str]) -> dict[tuple[float, ...], list[Path]]:
    """Folders of finished runs by the values of their inputs."""
    found: dict[tuple[float, ...], list[Path]] = {}
    if not all(name in QUANTITIES for name in inputs):
        return found
    keys = [QUANTITIES[name].key.split(".") for name in inputs]
    for scene in sorted(store.glob("*/scene.toml")):
        if (scene.parent / "transients.csv").is_file():
            found.setdefault(_named([_at(read_toml(scene), key) for key in keys]), []).append(scene.parent)
    return found


def _at(document: Any, key: Sequence[str]) -> float:
    for part in key:
        document = document.get(part) if isinstance(document, dict) else None
    return float(document) if isinstance(document, (int, float)) else float("nan")


def _named(values: Sequence[float]) -> tuple[float, ...]:
    """Values as they are found again, whoever wrote them as text."""
    return tuple(float(f"{value:.10g}") for value in values)


def _transients(
    row: Mapping[str, Any], inputs: Sequence[str], kept: Mapping[tuple[float, ...], list[Path]]
) -> pd.DataFrame | None:
    """Of a row's run; None where it is not kept. Of two fidelities at one place, that whose CPU seconds are the row's."""
    places = kept.get(_named([float(row[name]) for name in inputs]), [])
    if len(places) > 1:
        cost = [float(read_json(place / "manifest.json").get("cpu_s") or np.nan) for place in places]
        off = np.abs(np.array(cost) - float(row.get("cpu_s", np.nan)))
        places = [places[int(np.nanargmin(off))]] if np.isfinite(off).any() else places[:1]
    return read_frame(places[0] / "transients.csv") if places else None
