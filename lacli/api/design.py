"""A design in one call: the parameter sets of the next runs, and the runs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from lacli.api.progress import Cancel, OnProgress, Stage, check
from lacli.base.errors import UsageError

if TYPE_CHECKING:
    from lacli.base.arrays import FloatArray
    from lacli.contracts.scene import Scene
    from lacli.inference.box import Box


@dataclass(frozen=True)
class Design:
    """Points (n, d) of the box, in the units of its inputs' names, and the table that has them first.

    rows: those of the table, earlier calls' included; failed: runs at the points that failed (0 where none was asked for);
    note: what earlier runs taught of where runs fail, in words.
    """

    table: Path
    box: Box
    x: FloatArray
    rows: int
    failed: int
    note: str


def design(
    table: Path,
    *,
    scene: Scene | None = None,
    count: int = 200,
    method: str = "sobol",
    box: Box | None = None,
    runs: Path | None = None,
    store: Path = Path("runs"),
    workers: int | None = None,
    scheduler: str | None = None,
    sensitivities: bool = True,
    warm: bool = False,
    fresh: bool = False,
    retry: bool = False,
    seed: int = 0,
    progress: OnProgress | None = None,
    cancel: Cancel | None = None,
) -> Design:
    """A design of ``count`` points (n, d) that fills the box, written to ``table`` (CSV or Parquet), and run if a scene is given.

    Inputs are in the units of their names. scene: what is run at the points, its simulations kept in ``store``; finished
    runs are never repeated, nor lost. method: ``sobol``, ``lhs`` or ``maximin``; box: ranges of the inputs (default: the
    published ones of the 9 of a calibration); runs: a table of earlier runs with their status, to avoid where runs fail;
    workers: simulations side by side here, scheduler: address of a Dask scheduler instead; sensitivities: whether
    runs tell their derivatives (columns ``d<output>/d<input>``); warm: whether runs start from the nearest that has ended, and
    end as the others do to the solver's tolerance; fresh: write into a sub-folder
    where ``table`` holds something else; retry: run again what the machine has ended three times.
    Raises UsageError, TableError, LacliError for runs that the machine ended again and again, AnatomyError,
    SolverMissingError, StorageError, Cancelled (the runs that finished are in the table then).
    """
    import pandas as pd

    from lacli.base.files import check_file
    from lacli.inference import design_file
    from lacli.inference.box import OUTPUTS, published_box
    from lacli.inference.design import METHODS
    from lacli.inference.design import design as points

    chosen = next((name for name in METHODS if name == method), None)
    if chosen is None:
        raise UsageError(f"--method {method}: must be one of {', '.join(METHODS)}.")
    check_file(table)
    check(cancel, "the design")
    box = box or published_box()
    if scene is None:
        table = design_file.place_of_points(table, box, fresh)
        accept, note = design_file.feasibility(runs, box)
        x = points(box, count, chosen, seed, accept)
        design_file.write(pd.DataFrame(x, columns=list(box.names)), table, None)
        return Design(table, box, x, len(x), 0, note)
    from lacli.base.processes.locks import working_on
    from lacli.calibration.simulator import simulator
    from lacli.inference.runs import RunLog, runs_identity

    program = simulator(scene, store, workers, scheduler, sensitivities=sensitivities, warm=warm)
    outputs = (*OUTPUTS, "edv_ml")
    identity = runs_identity(program, box.names, outputs)
    table = design_file.place_of_runs(table, identity, fresh)
    accept, note = design_file.feasibility(runs, box)
    x = points(box, count, chosen, seed, accept)
    stage = Stage("", len(x), progress, cancel)
    with working_on(table):
        log = RunLog(design_file.log_of(table), box.names, outputs, identity, retry)
        log.run(program, x, lambda done, total: stage.of("simulations", done, total))
        failed = int((log.frame(x)["status"] != "done").sum())
        frame = log.arrange(x)
        if table != log.path:
            design_file.write(frame, table, identity)
    return Design(table, box, x, len(frame), failed, note)
