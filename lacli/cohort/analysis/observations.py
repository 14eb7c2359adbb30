"""A cohort's tidy table: a row a patient and region, numbers in the other columns; checked before anything is computed."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from lacli.base.arrays import FloatArray
from lacli.base.documents import brief
from lacli.base.errors import TableError, UsageError
from lacli.base.notes import note
from lacli.contracts.tables.absent import check_column
from lacli.contracts.tables.checks import check_sizes
from lacli.contracts.tables.columns import numbers, to_numbers
from lacli.contracts.tables.file import read_frame

_FAR = 4.0  # of a posterior's sds: so far from its mean no most probable value lies
MOST_DRAWS = 5_000_000
# an identifier becomes a folder's name: no separators, no leading dot or dash
IDENTIFIER = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.\-]{0,63}")
ERROR = "_sd"


@dataclass(frozen=True)
class Observations:
    """A complete table. values: by name, (patients, regions); errors: covariances (patients, regions, regions) of those values
    that are posterior means; draws: (draws, patients, regions) joint posterior draws where given; notes: what was left out."""

    patients: tuple[str, ...]
    regions: tuple[str, ...]
    values: dict[str, FloatArray]
    errors: dict[str, FloatArray]
    draws: dict[str, FloatArray]
    where: str
    notes: tuple[str, ...] = ()


def read_observations(
    path: Path, names: Sequence[str], patient: str = "participant_id", region: str = "region", draws: Path | None = None
) -> Observations:
    """The columns ``names`` of a CSV or Parquet table, and ``<name>_sd``, the posterior's standard deviation, where it is there.

    draws: a table of joint posterior draws (columns patient, region, ``draw`` and some of ``names``): their covariance between
    a patient's regions takes the place of ``<name>_sd``. A region of which a column is empty in all patients is left out, with
    a note. Raises TableError where a cell is empty or no number, an identifier is
    none or stands twice, or patients have different regions; UsageError where a column is missing.
    """
    frame = read_frame(path, (patient, region))
    _check_columns(frame, [patient, region, *names], path)
    ids, regions = _labels(frame, patient, region, path)
    twice = pd.Series(zip(ids, regions, strict=True)).duplicated().to_numpy()
    if twice.any():
        row = int(twice.argmax())
        raise TableError(f"{path}: {ids[row]}, {regions[row]}: two rows (the second is row {row + 1}). Keep one.")
    left, notes = _left_out(frame, regions, names)
    kept = [row for row, level in enumerate(regions) if level not in left]
    frame, ids, regions = frame.iloc[kept], [ids[row] for row in kept], [regions[row] for row in kept]
    patients, levels = tuple(dict.fromkeys(ids)), tuple(dict.fromkeys(regions))
    if len(patients) < 2:
        raise TableError(f"{path}: one patient ({patients[0]}); statistics over patients need at least 2.")
    for name in patients:
        have = {r for i, r in zip(ids, regions, strict=True) if i == name}
        if have != set(levels):
            lacking = ", ".join(r for r in levels if r not in have)
            raise TableError(f"{path}: {name} has no row for {lacking}, which others have. Add it, or leave that out for all.")
    place = ([patients.index(i) for i in ids], [levels.index(r) for r in regions])
    values, errors = {}, {}
    for name in names:
        values[name] = _filled(column(frame, name, path), place, (len(patients), len(levels)))
        if name + ERROR in frame:
            sd = _filled(column(frame, name + ERROR, path), place, (len(patients), len(levels)))
            if (sd < 0).any():
                raise TableError(f"{path}: {name + ERROR} holds a negative standard deviation.")
            errors[name] = sd[:, :, None] ** 2 * np.eye(len(levels))
    found: dict[str, FloatArray] = {}
    if draws is not None:
        found = _read_draws(draws, names, patient, region, patients, levels, left)
        for name, of in found.items():
            _check_draws(draws, name, of, values[name], patients, levels)
        errors |= {name: _covariances(d) for name, d in found.items()}
    return Observations(patients, levels, values, errors, found, str(path), notes)


def _left_out(frame: pd.DataFrame, regions: Sequence[str], names: Sequence[str]) -> tuple[set[str], tuple[str, ...]]:
    """Regions of which one of the columns has nothing at all, where it has something of others; and words on them."""
    left, said = set[str](), list[str]()
    for name in names:
        known = {level for level, empty in zip(regions, frame[name].isna(), strict=True) if not empty}
        if known and (lacking := [level for level in dict.fromkeys(regions) if level not in known]):
            left |= set(lacking)
            said.append(f"{name} is not known of {', '.join(lacking)}: left out.")
    return (left, tuple(said)) if left < set(regions) else (set(), ())


def column(frame: pd.DataFrame, name: str, path: Path) -> FloatArray:
    """The column's finite numbers. Raises TableError, which names the row."""
    if pd.api.types.is_bool_dtype(frame[name].dtype) or pd.api.types.is_datetime64_any_dtype(frame[name].dtype):
        numbers(frame[[name]], f"{path}")  # which says what they are
    values: FloatArray = to_numbers(frame[name]).to_numpy(float)
    bad = ~np.isfinite(values)
    if bad.any():
        row = int(bad.argmax())
        cell, row = frame[name].iloc[row], int(frame.index[row])  # the table's own, whatever is left out of it
        cell = cell.item() if hasattr(cell, "item") else cell
        what = "is empty" if pd.isna(cell) else f"holds {brief(cell)}, which is not a finite number"
        raise TableError(f"{path}: {name}, row {row + 1} {what}. Fill it in, or leave the patient out.")
    check_sizes([name], values[:, None], f"{path}:")
    check_column(name, values, f"{path}:", "Fill it in, or leave the patient out.", note)
    return values


def check_identifier(name: str, where: str) -> str:
    """The identifier. Raises TableError where it could not be a folder's name."""
    if not IDENTIFIER.fullmatch(name):
        raise TableError(f"{where}: {brief(name)} is no identifier: letters, digits, _ . and - only, a letter or digit first.")
    return name


def _check_columns(frame: pd.DataFrame, names: Sequence[str], path: Path) -> None:
    missing = [name for name in dict.fromkeys(names) if name not in frame]
    if missing:
        there = ", ".join(map(str, frame.columns[:40]))
        raise UsageError(f"{path}: no column {', '.join(missing)}; the columns are {there}.")


def _labels(frame: pd.DataFrame, patient: str, region: str, path: Path) -> tuple[list[str], list[str]]:
    labels = []
    for name in (patient, region):
        empty = frame[name].isna().to_numpy()
        if empty.any():
            raise TableError(f"{path}: {name}, row {int(empty.argmax()) + 1} is empty.")
        labels.append([str(v).strip() for v in frame[name]])
    for row, name in enumerate(labels[0]):
        check_identifier(name, f"{path}: {patient}, row {row + 1}")
    return labels[0], labels[1]


def _filled(column: FloatArray, place: tuple[list[int], list[int]], shape: tuple[int, int]) -> FloatArray:
    grid = np.empty(shape)
    grid[place] = column
    return grid


def _read_draws(
    path: Path,
    names: Sequence[str],
    patient: str,
    region: str,
    patients: tuple[str, ...],
    regions: tuple[str, ...],
    left: Collection[str] = (),
) -> dict[str, FloatArray]:
    """Of the regions but for those that are ``left`` out."""
    frame = read_frame(path, (patient, region))
    there = [name for name in names if name in frame]
    if not there:
        raise UsageError(f"{path}: no draws of {', '.join(names)}; the columns are {', '.join(map(str, frame.columns[:40]))}.")
    _check_columns(frame, [patient, region, "draw"], path)
    ids, levels = _labels(frame, patient, region, path)
    kept = [row for row, level in enumerate(levels) if level not in left]
    frame, ids, levels = frame.iloc[kept], [ids[row] for row in kept], [levels[row] for row in kept]
    numbers, which = np.unique(frame["draw"].to_numpy(), return_inverse=True)
    shape = (len(numbers), len(patients), len(regions))
    if int(np.prod(shape)) > MOST_DRAWS:
        raise TableError(f"{path}: {len(numbers):,} draws; at most {MOST_DRAWS // (shape[1] * shape[2]):,} are read. Thin them.")
    unknown = (set(ids) - set(patients)) | (set(levels) - set(regions))
    if unknown:
        raise TableError(f"{path}: {', '.join(sorted(unknown)[:5])} is not in the table of values.")
    index = (which, [patients.index(i) for i in ids], [regions.index(r) for r in levels])
    counts = np.zeros(shape, int)
    np.add.at(counts, tuple(np.asarray(i) for i in index), 1)
    if len(numbers) < 50 or (counts != 1).any():
        raise TableError(
            f"{path}: needs each draw once for every patient and region, at least 50 draws; there are {len(numbers)}."
        )
    result = {}
    for name in there:
        grid = np.empty(shape)
        grid[index] = column(frame, name, path)
        result[name] = grid
    return result


def _check_draws(
    path: Path, name: str, draws: FloatArray, values: FloatArray, patients: tuple[str, ...], regions: tuple[str, ...]
) -> None:
    """Raises TableError where the table's value is none that its draws (draws, patients, regions) could have."""
    mean, sd = draws.mean(axis=0), draws.std(axis=0)
    off = np.abs(values - mean) - _FAR * sd - 1e-9 * np.abs(mean)
    i, j = np.unravel_index(int(off.argmax()), off.shape)
    if off[i, j] > 0:
        raise TableError(
            f"{path}: draws of {name} of {patients[i]}, {regions[j]} are {mean[i, j]:.4g} +- {sd[i, j]:.2g}, the table has "
            f"{values[i, j]:.4g}: they are of another posterior, or in another unit."
        )


def _covariances(draws: FloatArray) -> FloatArray:
    d = draws - draws.mean(axis=0)
    covariances: FloatArray = np.einsum("dpi,dpj->pij", d, d) / (len(d) - 1)
    return covariances
