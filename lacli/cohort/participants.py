"""The participants of a study: BIDS' ``participants.csv``, an identifier a row, checked whole before anything runs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import numpy as np
import pandas as pd

from lacli.base.documents import brief
from lacli.base.errors import TableError
from lacli.cohort.analysis.observations import check_identifier
from lacli.contracts.tables.file import read_frame

ID = "participant_id"
PATHS = ("labels", "bundle", "ct", "images", "targets", "table", "scene")
_NUMBERS = ("age", "heart_rate_bpm", "ed_volume_ml")
_MISSING = ("n/a", "na", "")


@dataclass(frozen=True)
class Participant:
    """identifier; paths that are there, by the column's name (of ``PATHS``); other columns as text."""

    identifier: str
    paths: Mapping[str, Path]
    others: Mapping[str, str]


def read_participants(path: Path) -> list[Participant]:
    """The participants of a CSV or Parquet table; paths are taken from the table's folder.

    Columns: ``participant_id``; ``labels`` or ``bundle``; ``images`` or ``targets``; or ``table`` (runs done elsewhere) with
    ``targets``; optional ``ct``, ``scene``, ``age`` and columns of one's own; ``n/a`` where not known. Raises TableError, one
    message with all that is wrong.
    """
    frame = read_frame(path)
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
        if (other := seen.setdefault(name.lower(), name)) != name or name in [p.identifier for p in found]:
            wrong.append(f"row {row}: {name} stands twice (as {other}); folders would be one")
            continue
        found.append(_participant(path.parent, name, cells, wrong))
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
            paths[column] = place.absolute()
            continue
        if column in _NUMBERS and not _is_number(text):
            wrong.append(f"{name}: {column} is {brief(text)}, not a number")
        others[column] = text
    if "table" in paths:
        if "targets" not in paths:
            wrong.append(f"{name}: table (runs done elsewhere) needs targets")
    else:
        if "labels" not in paths and "bundle" not in paths:
            wrong.append(f"{name}: neither labels (to mesh) nor bundle")
        if "images" not in paths and "targets" not in paths:
            wrong.append(f"{name}: neither images (to track) nor targets")
    return Participant(name, MappingProxyType(paths), MappingProxyType(others))


def _text(cell: object) -> str:
    if cell is None or (isinstance(cell, float) and np.isnan(cell)) or cell is pd.NA:
        return ""
    if isinstance(cell, float) and cell.is_integer():
        return str(int(cell))  # a column with a gap is read as floats
    return str(cell).strip()


def _is_number(text: str) -> bool:
    try:
        return bool(np.isfinite(float(text)))
    except ValueError:
        return False
