"""Tables as files, CSV or Parquet: bounded before they are read, the header line checked."""

from __future__ import annotations

import csv
import io
import re
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from lacli.base.errors import TableError

PARTICIPANT = "participant_id"  # its cells are words in every table
# a table of runs is small; what is larger is another kind of file
MOST_ROWS = 200_000
MOST_COLUMNS = 10_000  # 300 outputs and their derivatives by 30 inputs
MOST_BYTES = 512 << 20
_MOST_CELLS = 20_000_000
_LONGEST_HEADER = 1 << 20
_PARQUET = (".parquet", ".pq")
_LONGEST_FOOTER = 16 << 20
# before 3.1, pandas does not read every float's digits back to the same float on its own; since then the wish is deprecated
_EXACT: dict[str, Any] = {} if tuple(map(int, pd.__version__.split(".")[:2])) >= (3, 1) else {"float_precision": "round_trip"}


def read_frame(path: Path, text: Sequence[str] = ()) -> pd.DataFrame:
    """Read a CSV or Parquet table.

    text: columns whose cells are words, whatever they look like (``007``, ``1e3``), beside ``participant_id``.
    Raises TableError if the file is missing, too large, empty or not a table with unique column names.
    """
    path = Path(path)
    if not path.is_file():
        raise TableError(f"{path}: no such table. Give a .csv or .parquet file with one run a row.")
    parquet = path.suffix.lower() in _PARQUET
    try:
        (_check_parquet if parquet else _check_csv)(path)
        if parquet:
            frame = pd.read_parquet(path)
        else:
            with warnings.catch_warnings():  # cells beyond the header's would be dropped, or else taken as names of the rows
                warnings.simplefilter("error", pd.errors.ParserWarning)
                frame = pd.read_csv(
                    path, skipinitialspace=True, index_col=False, low_memory=False, encoding="utf-8-sig",
                    dtype={name: str for name in _header_cells(path) if name.strip() in (PARTICIPANT, *text)}, **_EXACT,
                )  # fmt: skip
    except TableError:
        raise
    except pd.errors.ParserWarning as error:
        raise TableError(
            f"{path}: the rows have more cells than the header line. Separate columns by commas, write decimals with points."
        ) from error
    except UnicodeDecodeError as error:
        with path.open("rb") as stream:
            wide = stream.read(2) in (b"\xff\xfe", b"\xfe\xff")
        raise TableError(f"{path}: the text is {'UTF-16' if wide else 'not UTF-8'}; save it as CSV in UTF-8.") from error
    except Exception as error:
        words = " ".join(str(error).split())[:300]
        raise TableError(f"{path}: cannot be read as a table ({words}). Use CSV with a header line, or Parquet.") from error
    if not parquet and frame.shape[1]:  # pandas would rename the second of two columns of one name
        frame.columns = [name or f"Unnamed: {i}" for i, name in enumerate(_header_names(path))][: frame.shape[1]]
    frame.columns = [str(name).strip() for name in frame.columns]
    if frame.empty or frame.shape[1] == 0:
        raise TableError(f"{path}: the table is empty. It needs a header line and rows below it.")
    if parquet:
        frame = frame.reset_index(drop=True)
    twice = sorted(set(frame.columns[frame.columns.duplicated()]))
    if twice:
        raise TableError(f"{path}: column {', '.join(twice)} occurs twice. Rename or remove one.")
    if numbers := [str(name) for name in frame.columns if _is_number(name)]:
        raise TableError(
            f"{path}: the first line holds numbers, not column names ({listed(numbers)}). Add a header line with names and units."
        )
    return frame


def _check_csv(path: Path) -> None:
    size = path.stat().st_size
    if size > MOST_BYTES:
        raise TableError(f"{path}: {size / 1e6:,.0f} MB; a table of at most {MOST_BYTES / 1e6:,.0f} MB is read. {_FEWER}")
    names = _header_names(path)
    with path.open("rb") as stream:
        rows = sum(block.count(b"\n") + block.count(b"\r") for block in iter(lambda: stream.read(1 << 20), b""))
        stream.seek(0)
        if b"\r\n" in stream.read(1 << 20):
            rows //= 2
    _check_size(path, rows, len(names))
    if len(names) == 1:
        for mark, word in ((";", "semicolons"), ("\t", "tabs"), ("|", "bars")):
            if mark in names[0]:
                raise TableError(f"{path}: columns are separated by {word}. Separate them by commas, write decimals with points.")


_FEWER = "Keep the runs and the columns that are needed."


def _check_size(path: Path, rows: int, columns: int) -> None:
    if rows > MOST_ROWS + 1:
        raise TableError(f"{path}: about {rows:,} rows; a table of at most {MOST_ROWS:,} is read. {_FEWER}")
    if columns > MOST_COLUMNS:
        raise TableError(f"{path}: {columns:,} columns; a table of at most {MOST_COLUMNS:,} is read. {_FEWER}")
    if rows * columns > _MOST_CELLS:
        raise TableError(f"{path}: about {rows * columns:,} cells; a table of at most {_MOST_CELLS:,} is read. {_FEWER}")


def _header_names(path: Path) -> list[str]:
    return [name.strip() for name in _header_cells(path)]


def _header_cells(path: Path) -> list[str]:
    """The cells of the first line that is not empty."""
    with path.open("rb") as stream:
        start = stream.read(_LONGEST_HEADER + 1)
    # as pandas does: a line of blanks is an empty one
    text = re.sub(r"\A(?:[ \t]*[\r\n]+)+", "", start.decode("utf-8-sig", errors="replace"))
    row = next(csv.reader(io.StringIO(text, newline=""), skipinitialspace=True), [])
    if len(start) > _LONGEST_HEADER and len(text) == len("".join(row)) + len(row) - 1:
        raise TableError(f"{path}: the first line is longer than {_LONGEST_HEADER:,} bytes; it should name the columns.")
    return row


def _check_parquet(path: Path) -> None:
    with path.open("rb") as stream:
        size = stream.seek(0, io.SEEK_END)
        if size < 12:
            raise TableError(f"{path}: cannot be read as a table (it ends early). Use CSV with a header line, or Parquet.")
        stream.seek(-8, io.SEEK_END)
        tail = stream.read(8)
    footer = int.from_bytes(tail[:4], "little")
    if tail[4:] != b"PAR1" or footer > size:
        raise TableError(
            f"{path}: cannot be read as a table (not Parquet, or cut short). Use CSV with a header line, or Parquet."
        )
    if footer > _LONGEST_FOOTER:
        raise TableError(f"{path}: its list of columns takes {footer / 1e6:,.0f} MB; at most {MOST_COLUMNS:,} columns are read.")
    from pyarrow import parquet

    data = parquet.read_metadata(path)
    _check_size(path, data.num_rows, data.num_columns)
    taken = sum(data.row_group(i).total_byte_size for i in range(data.num_row_groups))
    if taken > MOST_BYTES:
        raise TableError(f"{path}: {taken / 1e6:,.0f} MB unpacked; at most {MOST_BYTES / 1e6:,.0f} MB are read. {_FEWER}")


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def listed(names: Sequence[str], most: int = 12) -> str:
    """Names for a message, the first few of many."""
    return ", ".join(str(name) for name in names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")
