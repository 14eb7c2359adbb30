"""``lacli design``: choose the parameter sets of the next runs, and run them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lacli.base.errors import UsageError
from lacli.cli.console import err, out, print_json, print_table, progress
from lacli.cli.tables import BoxFile, Json, Seed


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
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """Choose the parameter sets of the next runs; with --run, run them (finished ones are never repeated).

    Example: lacli design scene.toml -n 200 --run --out runs.csv
    """
    import pandas as pd

    from lacli.base.files import check_file, replacing
    from lacli.inference.box import CALIBRATION_INPUTS, OUTPUTS, SENSITIVITY_INPUTS, published_box, read_box
    from lacli.inference.design import METHODS, design

    if method not in METHODS:
        raise UsageError(f"--method {method}: must be one of {', '.join(METHODS)}.")
    if run and scene is None:
        raise UsageError("--run needs a scene: lacli design SCENE --run.")
    check_file(table)
    box = read_box(box_file) if box_file else published_box(names or (SENSITIVITY_INPUTS if all_inputs else CALIBRATION_INPUTS))
    accept, note = _feasibility(runs, box)
    x = design(box, count, method, seed, accept)
    if note:
        err.print(f"note: {note}", highlight=False, soft_wrap=True)
    failed = 0
    if scene is not None and run:
        from lacli.calibration.simulator import simulator
        from lacli.inference.runs import RunLog

        log = RunLog(table.with_suffix(".csv"), box.names, (*OUTPUTS, "edv_ml"))
        with progress() as bar:
            task = bar.add_task("simulations", total=len(x))
            log.run(
                simulator(scene, root, workers, scheduler), x, lambda done, total: bar.update(task, completed=done, total=total)
            )
        frame = log.frame(x)
        failed = int((frame["status"] != "done").sum())
    else:
        frame = pd.DataFrame(x, columns=list(box.names))
    with replacing(table) as temporary:
        if table.suffix.lower() in (".parquet", ".pq"):
            frame.to_parquet(temporary, index=False)
        else:
            frame.to_csv(temporary, index=False)
    if as_json:
        print_json(
            {
                "table": str(table),
                "points": len(x),
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
    out.print(f"Written to {table}", highlight=False, soft_wrap=True)


def _feasibility(runs: Path | None, box):  # type: ignore[no-untyped-def]
    """What earlier failures teach: (accept or None, sentence or empty)."""
    if runs is None:
        return None, ""
    from lacli.contracts.table import STATUS, input_values, read_frame
    from lacli.contracts.table_columns import run_states
    from lacli.inference.emulation.feasibility import FEWEST_FAILURES, learn

    frame = read_frame(runs)
    missing = [name for name in (*box.names, STATUS) if name not in frame.columns]
    if missing:
        raise UsageError(f"{runs}: no column {', '.join(missing)}; it must hold the inputs and a status of each run.")
    states = run_states(frame, str(runs))
    assert states is not None  # it has a status
    ok, failed = states
    x = input_values(frame[list(box.names)], str(runs))
    model = learn(box, x[ok], x[failed])
    if model is None:
        if not ok.any():
            return None, f"no run in {runs} finished: nothing tells where one would; the design is spread over the whole box."
        return None, f"{int(failed.sum())} failed runs in {runs}: fewer than {FEWEST_FAILURES} teach nothing."
    return model.accept, model.describe()
