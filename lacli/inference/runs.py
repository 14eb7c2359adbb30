"""Runs of a simulator: the protocol, and a log in which a finished run is never asked for again."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import pandas as pd

from lacli.base.arrays import FloatArray
from lacli.base.errors import LacliError, TableError, UsageError
from lacli.base.files import replacing
from lacli.base.notes import note
from lacli.base.processes.process import memory_mb
from lacli.contracts import failures
from lacli.contracts.identity import Identity, beside, conflict, identify, read_identity, write_identity
from lacli.contracts.tables.gradients import name_of as gradient_name
from lacli.contracts.tables.table import ERROR_SUFFIX, SPREAD_SUFFIX, STATUS, RunTable, combine, input_values, read_frame

KIND, ATTEMPTS, MESSAGE, MEMORY = "kind", "attempts", "message", "peak_memory_mb"


@dataclass(frozen=True)
class Outcome:
    """What came of a run: outputs by name, status ``done`` or ``failed``, the kind of failure and its message, discretisation
    errors (one standard deviation, by output's name), CPU seconds, peak memory; attempts that the machine ended; gradients:
    derivatives by (output, input), in the output's unit over the input's; spread: how far two equilibria of the run are apart, by
    output's name, 0 where there is one (empty: not known)."""

    outputs: dict[str, float]
    status: str = "done"
    kind: str = ""
    errors: dict[str, float] = field(default_factory=dict)
    cpu_s: float = float("nan")
    message: str = ""
    peak_memory_mb: float = float("nan")
    attempts: int = 1
    gradients: dict[tuple[str, str], float] = field(default_factory=dict)
    spread: dict[str, float] = field(default_factory=dict)

    @property
    def lost(self) -> bool:
        """Whether the machine ended the run: no result."""
        return self.status != "done" and failures.of_the_machine(self.kind)


class Simulator(Protocol):
    """Runs each row of a frame of inputs (columns named with units); yields (row number, outcome) as they finish."""

    def __call__(self, inputs: pd.DataFrame) -> Iterator[tuple[int, Outcome]]: ...

    def determined_by(self, inputs: Sequence[str]) -> Mapping[str, Any]:
        """What determines an outcome beside the values of these inputs, by name: plain values, models, digests."""
        ...


def runs_identity(simulator: Simulator, inputs: Sequence[str], outputs: Sequence[str]) -> Identity:
    """What the rows of a table of this simulator's runs were made from."""
    return identify("runs", **simulator.determined_by(inputs), inputs=list(inputs), outputs=list(outputs))


class RunLog:
    """A table of runs in a CSV file: inputs, outputs, status. Written whole after each run, so that it is always valid.

    A row is found again by its exact input values, in a file whose identity (``<file>.identity.json`` beside it) is the same.
    A run that the machine ended is no result: its row counts the attempts, and it is done again. identity None: a table from
    elsewhere, to which nothing is added, and whose rows may repeat the inputs of others (``repeats``). retry: forget how often
    the machine ended a run.

    Raises UsageError for a file that holds other runs, TableError for one that cannot be read.
    """

    def __init__(
        self, path: Path, inputs: Sequence[str], outputs: Sequence[str], identity: Identity | None, retry: bool = False
    ) -> None:
        self.path, self.inputs, self.outputs, self.identity = Path(path), tuple(inputs), tuple(outputs), identity
        self.rows: dict[tuple[float, ...], dict[str, object]] = {}
        self.repeats: dict[tuple[float, ...], list[dict[str, object]]] = {}
        self.attempts: dict[tuple[float, ...], int] = {}
        if identity is not None and (words := obstacle(self.path, identity)):
            raise UsageError(f"{self.path} {words}. Choose another --out.")
        frame = _kept(self.path, self.inputs, self.outputs) if identity is not None else read_frame(self.path)
        if frame is None:
            return
        if missing := [name for name in self.inputs if name not in frame.columns]:
            raise TableError(f"{self.path}: no column {', '.join(missing)}; the columns are {', '.join(frame.columns)}.")
        # what we wrote was held against its box
        tell = note if identity is None else _untold
        x = input_values(frame[list(self.inputs)], str(self.path), tell)
        for values, cells in zip(x.tolist(), frame.to_dict("records"), strict=True):
            row: dict[str, object] = {str(k): v for k, v in cells.items()}
            row.setdefault(STATUS, "done")
            if identity is None and tuple(values) in self.rows:
                self.repeats.setdefault(tuple(values), []).append(row)
                continue
            self.rows[tuple(values)] = row
            if Outcome({}, str(row[STATUS]), str(row.get(KIND))).lost:
                self.attempts[tuple(values)] = 0 if retry else _count(row.get(ATTEMPTS))

    def run(self, simulator: Simulator, x: FloatArray, tick: Callable[[int, int], None] | None = None) -> None:
        """Make sure that every row of x (m, d) is in the log; tick(done, total) after each.

        A run that the machine ends is tried again after the others, failures.MOST_ATTEMPTS times in all, earlier calls included.
        Raises LacliError for points that were ended as often as that; all others are then in the log.
        """
        assert self.identity is not None, "a table from elsewhere takes no runs"
        points = list(dict.fromkeys(tuple(row.tolist()) for row in x))
        say = tick or (lambda done, total: None)
        say(sum(not self._open(point) for point in points), len(points))
        while todo := [point for point in points if self._open(point)]:
            done, ended = len(points) - len(todo), 0
            for index, outcome in simulator(pd.DataFrame(todo, columns=list(self.inputs))):
                self._note(todo[index], outcome)
                self.save()
                ended += 1
                done += not self._open(todo[index])
                say(done, len(points))
            if not ended:
                raise LacliError("the simulator ended without a word on the runs it was asked for. Run again.")
        if lost := [point for point in points if point in self.attempts]:
            raise LacliError(self._given_up(lost))

    def _open(self, point: tuple[float, ...]) -> bool:
        """Whether the point is still to be run."""
        return point not in self.rows or self.attempts.get(point, failures.MOST_ATTEMPTS) < failures.MOST_ATTEMPTS

    def _note(self, point: tuple[float, ...], outcome: Outcome) -> None:
        row: dict[str, object] = dict(zip(self.inputs, point, strict=True))
        row |= {name: outcome.outputs.get(name, np.nan) for name in self.outputs}
        row |= {name + ERROR_SUFFIX: outcome.errors[name] for name in self.outputs if name in outcome.errors}
        row |= {name + SPREAD_SUFFIX: outcome.spread[name] for name in self.outputs if name in outcome.spread}
        row |= {
            gradient_name(output, given): outcome.gradients[output, given]
            for output, given in itertools.product(self.outputs, self.inputs)
            if (output, given) in outcome.gradients
        }
        row |= {STATUS: outcome.status, KIND: outcome.kind, "cpu_s": outcome.cpu_s, MEMORY: outcome.peak_memory_mb}
        if outcome.message:
            row[MESSAGE] = outcome.message
        if outcome.lost:
            row[ATTEMPTS] = self.attempts[point] = self.attempts.get(point, 0) + outcome.attempts
        else:
            self.attempts.pop(point, None)
        self.rows[point] = row

    def _given_up(self, lost: Sequence[tuple[float, ...]]) -> str:
        """What the machine did to the points, what a run needs and what there is, and what to do."""
        first = self.rows[lost[0]]
        where = ", ".join(f"{name} {value:.4g}" for name, value in zip(self.inputs, lost[0], strict=True))
        needed = [float(str(row.get(MEMORY, "nan"))) for row in self.rows.values()]
        known = [value for value in needed if np.isfinite(value)]
        total, available = memory_mb()
        message = first.get(MESSAGE)
        said = f"{message} " if isinstance(message, str) else ""
        takes = f"Runs of this table took up to {max(known):.0f} MB; " if known else ""
        kind = str(first[KIND])
        return (
            f"{len(lost)} of the runs were ended by the machine {failures.MOST_ATTEMPTS} times or more, the first at {where}: "
            f"{kind} ({failures.MACHINE[kind]}). {said}{takes}{available:.0f} of {total:.0f} MB of memory are free here. "
            "Give more memory, disk or time, or run fewer side by side (--workers 1); then call again with --retry. "
            f"All other runs are kept in {self.path}."
        )

    def save(self) -> None:
        """Write the file, whole or not at all, and before it what it is made from."""
        assert self.identity is not None, "a table from elsewhere is not written"
        if read_identity(beside(self.path)) != self.identity:
            write_identity(beside(self.path), self.identity)
        with replacing(self.path) as temporary:
            pd.DataFrame(list(self.rows.values())).to_csv(temporary, index=False)

    def arrange(self, x: FloatArray) -> pd.DataFrame:
        """Put the rows of the points x (m, d) first, in their order, write the file, and return all rows."""
        first = dict.fromkeys(tuple(row.tolist()) for row in x)
        self.rows = {point: self.rows[point] for point in [*first, *(p for p in self.rows if p not in first)]}
        self.save()
        return pd.DataFrame(list(self.rows.values()))

    def frame(self, x: FloatArray) -> pd.DataFrame:
        """Rows of the log for the points x (m, d), in their order."""
        return pd.DataFrame([self.rows[tuple(row.tolist())] for row in x])

    def gradients(self, x: FloatArray, outputs: Sequence[str]) -> FloatArray:
        """(m, d, p): derivatives of the named outputs by the inputs at the points x (m, d), NaN where a run tells none."""
        names = [gradient_name(output, given) for given in self.inputs for output in outputs]
        found = self.frame(x).reindex(columns=names).to_numpy(float)
        return np.asarray(found.reshape(len(x), len(self.inputs), len(outputs)))

    def spread(self, x: FloatArray, outputs: Sequence[str]) -> FloatArray:
        """(m, p): how far two equilibria of the runs at x (m, d) are apart in the named outputs, NaN where that is not known."""
        return self.frame(x).reindex(columns=[name + SPREAD_SUFFIX for name in outputs]).to_numpy(float)

    def table(self, x: FloatArray, outputs: Sequence[str]) -> RunTable:
        """The checked table of the runs at x (m, d), in that order, with the named outputs; of inputs that rows repeat, all of
        them: what finished counts, whatever failed at the same place."""
        points = [tuple(row.tolist()) for row in x]
        frame = pd.DataFrame([row for point in points for row in (self.rows[point], *self.repeats.get(point, ()))])
        return combine(frame, frame, input_names=self.inputs, output_names=outputs, where=str(self.path))


def _untold(text: str) -> None:
    del text


def _count(cell: object) -> int:
    """A number of attempts as a table has it; one where it says none."""
    return int(cell) if isinstance(cell, (int, float)) and np.isfinite(cell) and cell >= 1 else 1


def obstacle(path: Path, identity: Identity) -> str:
    """Why runs of this identity cannot go on in the table at ``path``, in words; '' where they can."""
    inputs, outputs = identity.content["inputs"], identity.content["outputs"]
    try:
        frame = _kept(path, inputs, outputs)
    except TableError as error:
        return f"cannot be gone on with ({error})"
    if frame is None:
        return ""
    if missing := [name for name in inputs if name not in frame.columns]:
        return f"holds a table of something else (it has no column {', '.join(missing)})"
    return conflict(read_identity(beside(path)), identity, "runs")


def _kept(path: Path, inputs: Sequence[str], outputs: Sequence[str]) -> pd.DataFrame | None:
    """The table at ``path``; None where there is none, or only the points of a design that was not run."""
    if not path.is_file():
        return None
    frame = read_frame(path)
    points_only = set(inputs) <= set(frame.columns) and not set(frame.columns) & {STATUS, *outputs}
    return None if points_only else frame
