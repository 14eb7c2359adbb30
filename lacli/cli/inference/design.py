"""``lacli design``: choose the parameter sets of the next runs, and run them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lacli.base.errors import UsageError
from lacli.cli.terminal.console import err, out, print_json, print_table, progress
from lacli.cli.terminal.tables import BoxFile, Fresh, Json, Retry, Seed

if TYPE_CHECKING:
    import numpy as np
    import pandas as pd
    from numpy.typing import NDArray

    from lacli.base.arrays import FloatArray
    from lacli.contracts.identity import Identity
    from lacli.inference.box import Box

IDENTITY = "lacli_identity"  # in the metadata of a Parquet table


def command(
    scene: Annotated[Path | None, typer.Argument(help="Scene to run at the points (with --run).")] = None,
    count: Annotated[int, typer.Option("-n", "--count", min=1, help="Number of points.")] = 200,
    method: Annotated[str, typer.Option(help="sobol, lhs or maximin.")] = "sobol",
    names: Annotated[
        list[str] | None, typer.Option("--input", help="An input; may be repeated. Default: the 9 of a calibration.")
    ] = None,
    all_inputs: Annotated[bool, typer.Option("--all-inputs", help="The 14 inputs of a sensitivity study.")] = False,
    box_file: BoxFile = None,
    runs: Annotated[
        Path | None, typer.Option("--runs", help="Table of earlier runs with a status column: learn where runs fail.")
    ] = None,
    run: Annotated[bool, typer.Option("--run", help="Run the scene at the points.")] = False,
    workers: Annotated[int | None, typer.Option(min=1, help="Simulations side by side.")] = None,
    scheduler: Annotated[str | None, typer.Option(help="Address of a Dask scheduler.")] = None,
    root: Annotated[Path, typer.Option("--store", help="Folder of the simulations.")] = Path("runs"),
    table: Annotated[Path, typer.Option("--out", help="The table written (.csv or .parquet).")] = Path("design.csv"),
    fresh: Fresh = False,
    retry: Retry = False,
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """Choose the parameter sets of the next runs; with --run, run them (finished ones are never repeated, nor lost).

    Example: lacli design scene.toml -n 200 --run --out runs.csv
    """
    from lacli.base.files import check_file
    from lacli.inference.box import CALIBRATION_INPUTS, OUTPUTS, SENSITIVITY_INPUTS, published_box, read_box
    from lacli.inference.design import METHODS, design

    if method not in METHODS:
        raise UsageError(f"--method {method}: must be one of {', '.join(METHODS)}.")
    if run and scene is None:
        raise UsageError("--run needs a scene: lacli design SCENE --run.")
    check_file(table)
    box = read_box(box_file) if box_file else published_box(names or (SENSITIVITY_INPUTS if all_inputs else CALIBRATION_INPUTS))
    if scene is not None and run:
        from lacli.calibration.simulator import simulator
        from lacli.cli.terminal.scenes import read_scene
        from lacli.inference.runs import runs_identity

        program = simulator(read_scene(scene, box=box), root, workers, scheduler)
        identity = runs_identity(program, box.names, (*OUTPUTS, "edv_ml"))
        table = _place_of_runs(table, identity, fresh)
    else:
        program, identity = None, None
        table = _place_of_points(table, box, fresh)
    accept, note = _feasibility(runs, box)
    x = design(box, count, method, seed, accept)
    if note:
        err.print(f"note: {note}", highlight=False, soft_wrap=True)
    failed, rows_kept = 0, len(x)
    if program is not None and identity is not None:
        from lacli.inference.runs import RunLog

        log = RunLog(_log_of(table), box.names, (*OUTPUTS, "edv_ml"), identity, retry)
        with progress() as bar:
            task = bar.add_task("simulations", total=len(x))
            log.run(program, x, lambda done, total: bar.update(task, completed=done, total=total))
        failed = int((log.frame(x)["status"] != "done").sum())
        frame = log.arrange(x)
        rows_kept = len(frame)
        if table != log.path:
            _write(frame, table, identity)
    else:
        import pandas as pd

        _write(pd.DataFrame(x, columns=list(box.names)), table, None)
    if as_json:
        print_json(
            {
                "table": str(table),
                "points": len(x),
                "rows": rows_kept,
                "method": method,
                "seed": seed,
                "failed": failed,
                "inputs": list(box.names),
                "note": note,
            }
        )
        return
    rows = [
        [name, float(box.lower[i]), float(box.upper[i]), float(x[:, i].min()), float(x[:, i].max())]
        for i, name in enumerate(box.names)
    ]
    print_table(f"{len(x)} points ({method})", ["input", "from", "to", "least", "greatest"], rows)
    if run:
        out.print(f"{len(x) - failed} runs finished, {failed} failed (their rows say why).", highlight=False)
        if rows_kept > len(x):
            out.print(f"The table also keeps {rows_kept - len(x)} rows of earlier calls, after these.", highlight=False)
    out.print(f"Written to {table}", highlight=False, soft_wrap=True)


def _place_of_runs(table: Path, identity: Identity, fresh: bool) -> Path:
    """Where the runs go: ``table``, or with ``fresh`` a place of their own where it holds others. Raises UsageError."""
    from lacli.contracts.identity import conflict, settle
    from lacli.inference.runs import obstacle

    def in_the_way(place: Path) -> str:
        words = obstacle(_log_of(place), identity)
        if not words and _log_of(place) != place and place.is_file():
            words = conflict(_written_from(place), identity, "runs")
        return words

    return settle(table, in_the_way, fresh, table=True)


def _log_of(table: Path) -> Path:
    """Where rows are noted as they finish: the table itself, or a CSV file beside a Parquet one."""
    return table.with_suffix(".csv") if table.suffix.lower() in (".parquet", ".pq") else table


def _place_of_points(table: Path, box: Box, fresh: bool) -> Path:
    """Where points alone go: never onto a table that holds more than points. Raises UsageError."""
    from lacli.base.errors import TableError
    from lacli.contracts.identity import settle
    from lacli.contracts.tables.table import read_frame
    from lacli.inference.box import RANGES

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


def _write(frame: pd.DataFrame, table: Path, identity: Identity | None) -> None:
    """The table as CSV or Parquet; what the runs were made from in the Parquet file's metadata."""
    from lacli.base.files import replacing

    with replacing(table) as temporary:
        if table.suffix.lower() in (".parquet", ".pq"):
            if identity is not None:
                frame.attrs = {IDENTITY: identity.document()}
            frame.to_parquet(temporary, index=False)
        else:
            frame.to_csv(temporary, index=False)


def _written_from(table: Path) -> Identity | None:
    """The identity in a Parquet table's metadata; None where there is none."""
    import json

    from lacli.base.errors import TableError
    from lacli.contracts.identity import parse_identity
    from lacli.contracts.tables.table import read_frame

    try:
        return parse_identity(json.dumps(read_frame(table).attrs.get(IDENTITY)))
    except TableError:
        return None


def _feasibility(runs: Path | None, box: Box) -> tuple[Callable[[FloatArray], NDArray[np.bool_]] | None, str]:
    """What earlier failures teach: (accept or None, sentence or empty)."""
    if runs is None:
        return None, ""
    from lacli.contracts.tables.columns import run_states
    from lacli.contracts.tables.table import STATUS, input_values, read_frame
    from lacli.inference.emulation.feasibility import FEWEST_FAILURES, learn

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
