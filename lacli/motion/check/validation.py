"""Simulated against tracked transients: root mean squares by frame and by kind of feature, frames not used apart."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy.interpolate import CubicSpline

from lacli.base.arrays import BoolArray, FloatArray
from lacli.base.errors import InputError
from lacli.contracts.features import KEYS, family, kind_of, parse
from lacli.contracts.tables.columns import numbers
from lacli.motion.errors.drift import widened
from lacli.motion.errors.shrinkage import spread

SAME_TIME = 0.02  # of the cycle: a target so near to a frame has used it
_KINDS = ("volume", "d_global", "d", "n", "a", "b", "area_strain", "fibre_strain")


@dataclass(frozen=True)
class Validation:
    """Tracked frames within the simulated part of the cycle.

    times (f,): fractions of the RR interval; keys (k,); simulated, tracked (f, k): volumes as change from end-diastole; sd (f, k)
    of the tracked, NaN where not known; used (f, k): whether a target of the calibration stood at this frame in this feature.
    left_out: tracked frames that the simulation does not reach.
    """

    times: FloatArray
    keys: tuple[str, ...]
    simulated: FloatArray
    tracked: FloatArray
    sd: FloatArray
    used: BoolArray
    left_out: int

    def by_frame(self) -> pd.DataFrame:
        """A row per frame: time, whether any of it was used, root mean square of the difference over the features of each kind,
        in the features' units, and of the difference over the tracked motion's sd ("in_sd")."""
        difference = self.simulated - self.tracked
        rows = []
        for i, time in enumerate(self.times):
            row: dict[str, float | bool] = {"time": float(time), "used": bool(self.used[i].any())}
            for kind, columns in self._kinds().items():
                row[kind] = _rms(difference[i, columns])
            known = np.isfinite(self.sd[i])
            row["in_sd"] = _rms(difference[i, known] / self.sd[i, known]) if known.any() else float("nan")
            rows.append(row)
        return pd.DataFrame(rows)

    def by_kind(self) -> pd.DataFrame:
        """A row per kind of feature: root mean square over what the calibration used and over what it did not; NaN for none."""
        difference = self.simulated - self.tracked
        rows = []
        for kind, columns in self._kinds().items():
            used, value = self.used[:, columns], difference[:, columns]
            rows.append({"kind": kind, "unit": KEYS[self.keys[columns[0]]].unit or "1", "used": _rms(value[used]),
                         "not_used": _rms(value[~used]), "values_used": int(used.sum()), "values": int(used.size)})  # fmt: skip
        return pd.DataFrame(rows)

    def _kinds(self) -> dict[str, list[int]]:
        kinds = [kind_of(key)[0] for key in self.keys]
        found = {kind: [j for j, k in enumerate(kinds) if k == kind] for kind in _KINDS}
        return {kind: columns for kind, columns in found.items() if columns}


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if np.size(values) else float("nan")


def compare(
    simulated: pd.DataFrame,
    tracked: pd.DataFrame,
    sd: Mapping[str, float],
    targets: Iterable[str] = (),
    es_time: float | None = None,
    shrinkage: Mapping[str, Mapping[str, float]] | None = None,
    closed: bool = False,
) -> Validation:
    """A simulation's transients (a row per state, ``time`` from end-diastole on) against a tracked motion's (a row per frame).

    targets: names that the calibration used (``n_roof_mm@0.3``); one without a time is of ``es_time``, whose nearest frame counts
    as used. sd, shrinkage: of the tracked features, as in tracking.json; closed: whether its drift was corrected. Between
    simulated states a cubic spline is taken. Volumes are compared by their change from end-diastole, since mesh and image may
    enclose a little more or less there. Raises InputError where the tables lack times, share no feature or frame, or hold a word
    for a number.
    """
    keys = tuple(key for key in tracked if key in KEYS and key in simulated)
    told = {"simulated": simulated, "tracked": tracked}
    simulated, tracked = (_read(table, keys, f"the {name} transients") for name, table in told.items())
    if not keys:
        raise InputError(
            "the simulated and the tracked transients share no feature; are they of `lacli simulate` and `lacli track`?"
        )
    t, all_times = simulated["time"].to_numpy(), tracked["time"].to_numpy()
    later = all_times > 0.0
    here = later & (all_times >= t[0]) & (all_times <= t[-1] + 1e-9)
    if not here.any():
        raise InputError(f"no tracked frame after end-diastole lies in the simulated part of the cycle ({t[0]:g} to {t[-1]:g}).")
    values = [table[list(keys)].to_numpy(copy=True) for table in (simulated, tracked)]
    for array in values:
        for j, key in enumerate(keys):
            if key == "volume_ml":
                array[:, j] -= array[0, j]
        if not np.isfinite(array).all():
            raise InputError("the transients have a value that is not finite.")
    at = np.clip(all_times[here], t[0], t[-1])
    course = CubicSpline(t, values[0], axis=0) if len(t) > 3 else None
    got = course(at) if course is not None else np.column_stack([np.interp(at, t, column) for column in values[0].T])
    given = values[1][here]
    changes = given - values[1][0]
    wider = widened(all_times[here], closed)
    error = np.column_stack(
        [spread(key, wider * float(sd.get(key, np.nan)), changes[:, j], shrinkage) for j, key in enumerate(keys)]
    )
    error[~(error > 0)] = np.nan
    used = _used(all_times[here], keys, targets, es_time)
    return Validation(all_times[here], keys, np.asarray(got), given, error, used, int(later.sum() - here.sum()))


def _read(table: pd.DataFrame, keys: tuple[str, ...], what: str) -> pd.DataFrame:
    """Times and features as numbers, of a table that has times."""
    found = numbers(table[["time", *keys]], what) if "time" in table else None
    if found is None or len(found) < 2 or not np.all(np.diff(found["time"].to_numpy()) > 0):
        raise InputError(f"{what} need a column time that increases over two rows or more.")
    return found


def _used(times: FloatArray, keys: tuple[str, ...], targets: Iterable[str], es_time: float | None) -> BoolArray:
    used = np.zeros((len(times), len(keys)), dtype=bool)
    for name in targets:
        try:
            _, moment = parse(name)
        except ValueError:
            continue  # a target of the user's own
        key = family(name)
        at = es_time if moment is None else moment
        if key not in keys or at is None:
            continue
        nearest = int(np.argmin(np.abs(times - at)))
        if moment is None or abs(times[nearest] - at) <= SAME_TIME:
            used[nearest, keys.index(key)] = True
    return used
