"""Two tables of the same runs, row beside row: paired by their labels, never by position where labels disagree."""

from __future__ import annotations

import numpy as np
import pandas as pd

from lacli.base.errors import TableError
from lacli.contracts.tables.columns import LABELS, is_label, to_numbers


def pair(inputs: pd.DataFrame, outputs: pd.DataFrame, where: str) -> tuple[pd.DataFrame, pd.DataFrame, list[str]]:
    """The rows of both tables that belong together, in the order of the inputs, and what was done, in words.

    A label (run_id, id, ...) that both tables have and that names each run once pairs them; runs that only one table has
    are left out with a note. Without labels, rows belong together by their position.

    Raises TableError for unequal lengths without labels, and labels that pair nothing, or twice.
    """
    notes: list[str] = []
    shared = _shared_labels(inputs, outputs)
    for name, other in shared:
        a, b = _keys(inputs[name]), _keys(outputs[other])
        if a == b:
            if len(set(a)) == len(a):
                break
            continue  # a label that stands for several runs
        twice = next(((t, k, c) for t, k, c in (("inputs", a, name), ("outputs", b, other)) if len(set(k)) < len(k)), None)
        if twice is not None:
            row = _first_difference(a, b)
            table, keys, column = twice
            again = next(k for i, k in enumerate(keys) if k in keys[:i])
            raise TableError(
                f"{where}: {column} differs between the tables from row {row + 1} on, and cannot pair them: the {table} have"
                f" {again} more than once. Give each run a label of its own."
            )
        place = {key: i for i, key in enumerate(b)}
        rows = [i for i, key in enumerate(a) if key in place]
        if not rows:
            raise TableError(f"{where}: no run is in both tables: {name} {a[0]}, ... in one, {b[0]}, ... in the other.")
        notes.append(f"runs are paired by {name}: the tables have them in another order or number.")
        only = {"outputs": [k for k in a if k not in place], "inputs": [k for k in b if k not in set(a)]}
        for table, those in only.items():
            if those:
                some = ", ".join(those[:3]) + (", ..." if len(those) > 3 else "")
                notes.append(f"{len(those)} run(s) without {table} are left out ({name} {some}).")
        inputs = inputs.iloc[rows].reset_index(drop=True)
        outputs = outputs.iloc[[place[a[i]] for i in rows]].reset_index(drop=True)
        break
    if len(inputs) != len(outputs):
        raise TableError(
            f"{where}: {len(inputs)} rows of inputs but {len(outputs)} rows of outputs; each run needs one of each."
            " A column run_id in both tables would pair them."
        )
    if not shared:
        _check_other_labels(inputs, outputs, where)
    return inputs, outputs, notes


def _shared_labels(inputs: pd.DataFrame, outputs: pd.DataFrame) -> list[tuple[str, str]]:
    """Columns of both tables that label runs, of the same name but for its case, the one most meant for it first."""
    by_name = {str(n).strip().lower(): str(n) for n in outputs.columns if is_label(str(n))}
    found = [(str(n), by_name[lower]) for n in inputs.columns if (lower := str(n).strip().lower()) in by_name]
    found = [(n, m) for n, m in found if inputs[n].notna().any() and outputs[m].notna().any()]
    order = {name: i for i, name in enumerate(LABELS)}
    return sorted(found, key=lambda names: order.get(names[0].strip().lower(), len(order)))


def _keys(column: pd.Series) -> list[str]:
    """Labels as text: 7, 7.0 and '007' are three spellings of one number, and one label."""
    if column.isna().any():
        row = int(np.flatnonzero(column.isna().to_numpy())[0])
        raise TableError(f"column {column.name} labels the runs but is empty in row {row + 1}. Fill it in or remove it.")
    number = to_numbers(column)
    return [
        f"{value:.17g}" if np.isfinite(value) else str(text).strip()
        for value, text in zip(number.astype(float).tolist(), column.tolist(), strict=True)
    ]


def _first_difference(a: list[str], b: list[str]) -> int:
    return next((i for i, (p, q) in enumerate(zip(a, b, strict=False)) if p != q), min(len(a), len(b)))


def _check_other_labels(inputs: pd.DataFrame, outputs: pd.DataFrame, where: str) -> None:
    """Labels under two names that hold the same runs in another order."""
    for name in filter(is_label, map(str, inputs.columns)):
        for other in filter(is_label, map(str, outputs.columns)):
            if inputs[name].isna().any() or outputs[other].isna().any():
                continue
            a, b = _keys(inputs[name]), _keys(outputs[other])
            if a != b and sorted(a) == sorted(b):
                raise TableError(
                    f"{where}: {name} of the inputs and {other} of the outputs hold the same labels, in another order from row"
                    f" {_first_difference(a, b) + 1} on. Give both columns one name, and the runs are paired by it."
                )


def check_shared_columns(inputs: pd.DataFrame, outputs: pd.DataFrame, where: str) -> None:
    """A column of numbers that both tables have says the same in both, or the rows do not belong together."""
    for name in inputs.columns:
        if name not in outputs.columns or is_label(str(name)):
            continue
        a, b = (to_numbers(frame[name]).to_numpy(float) for frame in (inputs, outputs))
        with np.errstate(invalid="ignore"):  # one that is infinite in both
            differs = np.flatnonzero(np.abs(a - b) > 1e-6 * np.maximum(np.abs(a), np.abs(b)))
        if len(differs):
            i = int(differs[0])
            raise TableError(
                f"{where}: {name} is {a[i]:g} in the inputs and {b[i]:g} in the outputs, row {i + 1} ({len(differs)} such rows):"
                " these rows are not of the same run. A column run_id in both tables would pair them."
            )
