"""A design's table: where it may go, how it is written, and what a table of earlier runs teaches it."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pandas as pd

from lacli.base.arrays import BoolArray, FloatArray
from lacli.base.errors import TableError, UsageError
from lacli.base.files import replacing
from lacli.contracts.identity import Identity, conflict, parse_identity, settle
from lacli.contracts.tables.columns import run_states
from lacli.contracts.tables.table import STATUS, input_values, read_frame
from lacli.inference.box import RANGES, Box
from lacli.inference.emulation.feasibility import FEWEST_FAILURES, learn
from lacli.inference.runs import obstacle

IDENTITY = "lacli_identity"  # in the metadata of a Parquet table


def place_of_runs(table: Path, identity: Identity, fresh: bool) -> Path:
    """Where the runs go: ``table``, or with ``fresh`` a place of their own where it holds others. Raises UsageError."""

    def in_the_way(place: Path) -> str:
        words = obstacle(log_of(place), identity)
        if not words and log_of(place) != place and place.is_file():
            words = conflict(written_from(place), identity, "runs")
        return words

    return settle(table, in_the_way, fresh, table=True)


def log_of(table: Path) -> Path:
    """Where rows are noted as they finish: the table itself, or a CSV file beside a Parquet one."""
    return table.with_suffix(".csv") if table.suffix.lower() in (".parquet", ".pq") else table


def place_of_points(table: Path, box: Box, fresh: bool) -> Path:
    """Where points alone go: never onto a table that holds more than points. Raises UsageError."""

    def in_the_way(place: Path) -> str:
        if not place.is_file():
            return ""
        try:
            frame = read_frame(place)
        except TableError as error:
            return f"holds something else ({error})"
        more = [name for name in frame.columns if name not in (*box.names, *RANGES)]
        if not more:
            return ""
        return f"holds {len(frame)} rows with {', '.join(more[:3])}, which points alone would replace"

    return settle(table, in_the_way, fresh, table=True)


def write(frame: pd.DataFrame, table: Path, identity: Identity | None) -> None:
    """The table as CSV or Parquet; what the runs were made from in the Parquet file's metadata."""
    with replacing(table) as temporary:
        if table.suffix.lower() in (".parquet", ".pq"):
            if identity is not None:
                frame.attrs = {IDENTITY: identity.document()}
            frame.to_parquet(temporary, index=False)
        else:
            frame.to_csv(temporary, index=False)


def written_from(table: Path) -> Identity | None:
    """The identity in a Parquet table's metadata; None where there is none."""
    try:
        return parse_identity(json.dumps(read_frame(table).attrs.get(IDENTITY)))
    except TableError:
        return None


def feasibility(runs: Path | None, box: Box) -> tuple[Callable[[FloatArray], BoolArray] | None, str]:
    """What earlier failures teach: (accept or None, sentence or empty)."""
    if runs is None:
        return None, ""
    frame = read_frame(runs)
    missing = [name for name in (*box.names, STATUS) if name not in frame.columns]
    if missing:
        raise UsageError(f"{runs}: no column {', '.join(missing)}; it must hold the inputs and a status of each run.")
    states = run_states(frame, str(runs))
    assert states is not None  # it has a status
    ok, failed = states
    if not (ok | failed).any():
        return None, f"the machine ended every run in {runs}: that tells nothing of where one fails."
    x = input_values(frame[list(box.names)], str(runs))
    model = learn(box, x[ok], x[failed])
    if model is None:
        if not ok.any():
            return None, f"no run in {runs} finished: nothing tells where one would; the design is spread over the whole box."
        return None, f"{int(failed.sum())} failed runs in {runs}: fewer than {FEWEST_FAILURES} teach nothing."
    return model.accept, model.describe()
