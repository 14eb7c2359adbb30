"""The participants of a study: BIDS' ``participants.csv``, an identifier a row, checked whole before anything runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import MappingProxyType

import numpy as np
import pandas as pd

from lacli.base.documents import brief
from lacli.base.errors import InputError, LacliError, TableError
from lacli.base.notes import note
from lacli.cohort.analysis.observations import check_identifier
from lacli.cohort.files import OWN, STATE
from lacli.contracts.labels import BODY_REGIONS
from lacli.contracts.tables.absent import check_column
from lacli.contracts.tables.columns import to_numbers
from lacli.contracts.tables.file import PARTICIPANT, read_frame
from lacli.contracts.targets import Targets, read_targets

ID = PARTICIPANT
PATHS = ("labels", "bundle", "ct", "images", "targets", "table", "scene", "uniform", "priors")
_FILES, _FOLDERS = ("labels", "targets", "table", "scene", "priors"), ("bundle", "uniform")  # of the others a path may be either
# columns of numbers that are known: unit, and what a patient can have
_NUMBERS = {"age": ("years", 0.0, 125.0), "heart_rate_bpm": ("beats a minute", 15.0, 400.0), "ed_volume_ml": ("mL", 1.0, 1500.0)}
_MISSING = ("n/a", "na", "")


@dataclass(frozen=True)
class Participant:
    """identifier; paths that are there, by the column's name (of ``PATHS``); other columns as text."""

    identifier: str
    paths: Mapping[str, Path]
    others: Mapping[str, str]

    def __reduce__(self) -> tuple[type, tuple[object, ...]]:
        """As it is sent to a cluster's workers: a mapping proxy cannot be."""
        return Participant, (self.identifier, dict(self.paths), dict(self.others))


def read_participants(path: Path) -> list[Participant]:
    """The participants of a CSV or Parquet table; paths are taken from the table's folder.

    Columns: ``participant_id``; ``labels`` or ``bundle``; ``images`` or ``targets``; or ``table`` (runs done elsewhere) with
    ``targets``; optional ``ct``, ``scene``, ``priors``, ``age`` and columns of one's own; ``n/a`` where not known. Raises
    TableError, one message with all that is wrong.
    """
    frame = read_frame(path, PATHS)
    if ID not in frame:
        raise TableError(f"{path}: no column {ID}; the columns are {', '.join(map(str, frame.columns[:40]))}.")
    wrong: list[str] = []
    found: list[Participant] = []
    seen: dict[str, str] = {}
    for row, cells in enumerate(frame.to_dict("records"), start=1):
        name = _text(cells[ID])
        try:
            check_identifier(name, f"row {row}")
        except TableError as error:
            wrong.append(str(error).rstrip("."))
            continue
        if name.lower() in OWN:
            wrong.append(f"row {row}: {name} is the name of one of the study's own files")
            continue
        if (other := seen.setdefault(name.lower(), name)) != name or name in [p.identifier for p in found]:
            wrong.append(f"row {row}: {name} stands twice (as {other}); folders would be one")
            continue
        found.append(_participant(path.parent, name, cells, wrong))
    if taken := [name for name in STATE if name in frame]:
        wrong.append(f"the study writes {', '.join(taken)} of each participant itself; give your column another name")
    for column in frame.columns:
        if column not in (ID, *PATHS, *_NUMBERS):
            _check_own(str(column), frame[column], str(path), wrong)
    if wrong:
        more = f" (and {len(wrong) - 8} more)" if len(wrong) > 8 else ""
        raise TableError(f"{path}: {'; '.join(wrong[:8])}{more}. Nothing was run.")
    return found


def _participant(home: Path, name: str, cells: Mapping[object, object], wrong: list[str]) -> Participant:
    paths, others = {}, {}
    for key, cell in cells.items():
        column, text = str(key), _text(cell)
        if column == ID or text.lower() in _MISSING:
            continue
        if column in PATHS:
            place = home / text
            if not place.exists():
                wrong.append(f"{name}: {column} {place} is not there")
            elif column in _FILES and not place.is_file():
                wrong.append(f"{name}: {column} {place} is no plain file")
            elif column in _FOLDERS and not place.is_dir():
                wrong.append(f"{name}: {column} {place} is no folder")
            paths[column] = place.absolute()
            continue
        if column in _NUMBERS and (words := _impossible(text, *_NUMBERS[column])):
            wrong.append(f"{name}: {column} is {brief(text)}, {words}")
        others[column] = text
    if "table" in paths:
        if "targets" not in paths:
            wrong.append(f"{name}: table (runs done elsewhere) needs targets")
        if "uniform" in paths:
            wrong.append(f"{name}: uniform (a bundle to simulate) does not go with table (runs done elsewhere)")
    else:
        if "labels" not in paths and "bundle" not in paths:
            wrong.append(f"{name}: neither labels (to mesh) nor bundle")
        if "images" not in paths and "targets" not in paths:
            wrong.append(f"{name}: neither images (to track) nor targets")
    if "priors" in paths and "targets" in paths:
        wrong.append(f"{name}: priors go into the targets of images that are tracked; state them in {paths['targets'].name}")
    return Participant(name, MappingProxyType(paths), MappingProxyType(others))


def check_targets(participants: Sequence[Participant], where: Path) -> None:
    """Whether targets that are given are of the same regions in all participants: statistics over them need complete tables.

    Raises TableError, InputError of a file that is none.
    """
    have = {
        p.identifier: {r for r in BODY_REGIONS if f"d_{r}_mm" in _targets(p).names} for p in participants if "targets" in p.paths
    }
    every = set().union(*have.values())
    for name, regions in have.items():
        if lacking := [r for r in BODY_REGIONS if r in every - regions]:
            other = next(n for n, found in have.items() if lacking[0] in found)
            raise TableError(
                f"{where}: the targets of {name} lack the displacement of {', '.join(lacking)}, which {other} has. Give it,"
                " or leave it out for all. Nothing was run."
            )


def _targets(participant: Participant) -> Targets:
    """A participant's targets. Raises InputError, with whose they are, where they cannot be read."""
    try:
        return read_targets(participant.paths["targets"])
    except LacliError as error:
        raise InputError(f"{participant.identifier}: targets {error} Nothing was run.") from None


def _impossible(text: str, unit: str, low: float, high: float) -> str:
    """Why a cell cannot be a number from low to high, in words; '' where it is one."""
    try:
        value = float(text)
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        return "not a number"
    return "" if low <= value <= high else f"out of {low:g} to {high:g} {unit}; write n/a where it is not known"


def _check_own(name: str, cells: pd.Series, where: str, wrong: list[str]) -> None:
    """A column of one's own, where it holds numbers: codes of missing values are said, for they would count as values."""
    if cells.dtype != bool and (values := to_numbers(cells)).notna().any():
        try:
            check_column(name, values.to_numpy(float), "column", "Write n/a where it is not known", partial(_told, where))
        except TableError as error:
            wrong.append(str(error))


def _told(where: str, text: str) -> None:
    note(f"{where}: {text}")


def _text(cell: object) -> str:
    if cell is None or (isinstance(cell, float) and np.isnan(cell)) or cell is pd.NA:
        return ""
    if isinstance(cell, float) and cell.is_integer():
        return str(int(cell))  # a column with a gap is read as floats
    return str(cell).strip()
