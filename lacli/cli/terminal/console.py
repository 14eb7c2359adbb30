"""What every command shares at the terminal: standard error for people, one JSON document on standard output."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

if TYPE_CHECKING:
    from lacli.api import progress as api

# what is shown holds names of the user's, columns and paths: brackets and colons in them are no marks of ours
out = Console(markup=False, emoji=False)
err = Console(stderr=True, markup=False, emoji=False)


def fail(error: Exception) -> None:
    """Print an expected error to standard error, one clear message."""
    err.print(Text.assemble(("lacli:", "bold red"), f" {error}"), soft_wrap=True)


def _plain(value: Any) -> Any:
    """Numbers, strings, lists, dicts only; a non-finite number becomes null (JSON has none)."""
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(v) for v in value]
    if hasattr(value, "tolist"):
        return _plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if value is None or isinstance(value, (str, int, float, bool)):
        return value
    return str(value)


def print_json(document: Any) -> None:
    """Write one JSON document to standard output."""
    sys.stdout.write(json.dumps(_plain(document), indent=2) + "\n")


def print_table(title: str, columns: list[str], rows: list[list[Any]]) -> None:
    """Print a table to standard output; floats with four significant digits."""
    table = Table(title=title, title_justify="left", header_style="bold")
    for index, column in enumerate(columns):
        # names stay whole where there is little room; numbers have it anyway
        table.add_column(column, justify="left" if index == 0 else "right", no_wrap=index == 0)
    for row in rows:
        table.add_row(*[f"{cell:.4g}" if isinstance(cell, float) else str(cell) for cell in row])
    out.print(table)


@contextmanager
def progress() -> Iterator[Progress]:
    """A progress display on standard error with elapsed time and time left."""
    with Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        TextColumn("{task.completed:.0f}/{task.total:.0f}"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        console=err,
        transient=True,
        disable=not err.is_terminal,  # elsewhere it would leave empty lines
    ) as bar:
        yield bar


@contextmanager
def stages() -> Iterator[Callable[[api.Progress], None]]:
    """What shows the progress of a call of the library, a bar for each of its stages."""
    with progress() as bar:
        tasks: dict[str, Any] = {}

        def show(event: api.Progress) -> None:
            if event.stage not in tasks:
                tasks[event.stage] = bar.add_task(event.stage, total=event.total)
            bar.update(tasks[event.stage], completed=event.done)

        yield show


@contextmanager
def one_bar(text: str) -> Iterator[Callable[[api.Progress], None]]:
    """What shows the progress of a call of the library in one bar, whose words are the stage's; ``text`` until it begins."""
    with progress() as bar:
        task = bar.add_task(text, total=1)

        def show(event: api.Progress) -> None:
            bar.update(task, description=event.stage, completed=event.done, total=event.total)

        yield show
