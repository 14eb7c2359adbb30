"""Runs of a simulator: the protocol, and a log in which a finished run is never asked for again."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np
import pandas as pd

from lacli.base.arrays import FloatArray
from lacli.base.errors import TableError
from lacli.base.files import replacing
from lacli.contracts.table import ERROR_SUFFIX, STATUS, RunTable, combine, input_values, read_frame


@dataclass(frozen=True)
class Outcome:
    """What came of a run: outputs by name, status ``done`` or ``failed``, the kind of failure, discretisation errors
    (one standard deviation, by output's name), CPU seconds."""

    outputs: dict[str, float]
    status: str = "done"
    kind: str = ""
    errors: dict[str, float] = field(default_factory=dict)
    cpu_s: float = float("nan")


class Simulator(Protocol):
    """Runs each row of a frame of inputs (columns named with units); yields (row number, outcome) as they finish."""

    def __call__(self, inputs: pd.DataFrame) -> Iterator[tuple[int, Outcome]]: ...


class RunLog:
    """A table of runs in a CSV file: inputs, outputs, status. Written whole after each run, so that it is always valid.

    A row is found again by its exact input values. Raises TableError for a file that holds something else.
    """

    def __init__(self, path: Path, inputs: Sequence[str], outputs: Sequence[str]) -> None:
        self.path, self.inputs, self.outputs = Path(path), tuple(inputs), tuple(outputs)
        self.rows: dict[tuple[float, ...], dict[str, object]] = {}
        if self.path.is_file():
            frame = read_frame(self.path)
            missing = [name for name in self.inputs if name not in frame.columns]
            if missing:
                raise TableError(
                    f"{self.path}: not a table of these runs, it has no column {', '.join(missing)}; choose another --out."
                )
            if not set(frame.columns) & {STATUS, *self.outputs}:
                return  # the points of a design that was not run
            x = input_values(frame[list(self.inputs)], str(self.path))
            for values, row in zip(x.tolist(), frame.to_dict("records"), strict=True):
                self.rows[tuple(values)] = {STATUS: "done"} | {str(k): v for k, v in row.items()}

    def run(self, simulator: Simulator, x: FloatArray, tick: Callable[[int, int], None] | None = None) -> None:
        """Make sure that every row of x (m, d) is in the log; tick(done, total) after each."""
        todo = [i for i, row in enumerate(x) if tuple(row.tolist()) not in self.rows]
        done = len(x) - len(todo)
        if tick is not None:
            tick(done, len(x))
        if not todo:
            return
        frame = pd.DataFrame(x[todo], columns=list(self.inputs))
        for index, outcome in simulator(frame):
            values = x[todo[index]].tolist()
            row: dict[str, object] = dict(zip(self.inputs, values, strict=True))
            row |= {name: outcome.outputs.get(name, np.nan) for name in self.outputs}
            row |= {name + ERROR_SUFFIX: outcome.errors[name] for name in self.outputs if name in outcome.errors}
            row |= {STATUS: outcome.status, "kind": outcome.kind, "cpu_s": outcome.cpu_s}
            self.rows[tuple(values)] = row
            self.save()
            done += 1
            if tick is not None:
                tick(done, len(x))

    def save(self) -> None:
        """Write the file, whole or not at all."""
        with replacing(self.path) as temporary:
            pd.DataFrame(list(self.rows.values())).to_csv(temporary, index=False)

    def frame(self, x: FloatArray) -> pd.DataFrame:
        """Rows of the log for the points x (m, d), in their order."""
        return pd.DataFrame([self.rows[tuple(row.tolist())] for row in x])

    def table(self, x: FloatArray, outputs: Sequence[str]) -> RunTable:
        """The checked table of the runs at x (m, d), in that order, with the named outputs."""
        frame = self.frame(x)
        return combine(frame, frame, input_names=self.inputs, output_names=outputs, where=str(self.path))
