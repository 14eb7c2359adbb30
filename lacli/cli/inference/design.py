"""``lacli design``: choose the parameter sets of the next runs, and run them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lacli.base.errors import UsageError
from lacli.cli.terminal.console import err, out, print_json, print_table, stages
from lacli.cli.terminal.modes import refuse
from lacli.cli.terminal.scenes import read_scene
from lacli.cli.terminal.tables import BoxFile, Fresh, Json, Retry, Scheduler, Seed, Warm, Workers


def command(
    ctx: typer.Context,
    scene_file: Annotated[Path | None, typer.Argument(metavar="[SCENE]", help="Scene to run at the points (with --run).")] = None,
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
    workers: Workers = None,
    scheduler: Scheduler = None,
    root: Annotated[Path, typer.Option("--store", help="Folder of the simulations.")] = Path("runs"),
    table: Annotated[Path, typer.Option("--out", help="The table written (.csv or .parquet).")] = Path("design.csv"),
    sensitivities: Annotated[
        bool,
        typer.Option(
            "--sensitivities/--no-sensitivities",
            help="Runs tell their derivatives, where the scene can: columns d<output>/d<input>, in units of both.",
        ),
    ] = True,
    warm: Warm = False,
    fresh: Fresh = False,
    retry: Retry = False,
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """Choose the parameter sets of the next runs; with --run, run them (finished ones are never repeated, nor lost).

    Example: lacli design scene.toml -n 200 --run --out runs.csv
    """
    from lacli.api import design as api
    from lacli.inference.box import CALIBRATION_INPUTS, SENSITIVITY_INPUTS, published_box, read_box

    if run and scene_file is None:
        raise UsageError("--run needs a scene: lacli design SCENE --run.")
    if not run:
        refuse(ctx, "without --run", "SCENE", "--store", "--workers", "--scheduler", "--sensitivities", "--warm", "--retry")
    if box_file is not None:
        refuse(ctx, "with --box, which names the inputs", "--input", "--all-inputs")
    if names:
        refuse(ctx, "with --input", "--all-inputs")
    box = read_box(box_file) if box_file else published_box(names or (SENSITIVITY_INPUTS if all_inputs else CALIBRATION_INPUTS))
    scene = read_scene(scene_file, box=box) if scene_file is not None and run else None
    with stages() as show:
        made = api.design(
            table, scene=scene, count=count, method=method, box=box, runs=runs, store=root, workers=workers,
            scheduler=scheduler, sensitivities=sensitivities, warm=warm, fresh=fresh, retry=retry, seed=seed, progress=show,
        )  # fmt: skip
    if made.note:
        err.print(f"note: {made.note}", highlight=False, soft_wrap=True)
    if as_json:
        print_json(
            {
                "table": str(made.table),
                "points": len(made.x),
                "rows": made.rows,
                "method": method,
                "seed": seed,
                "failed": made.failed,
                "inputs": list(box.names),
                "note": made.note,
            }
        )
        return
    rows = [
        [name, float(box.lower[i]), float(box.upper[i]), float(made.x[:, i].min()), float(made.x[:, i].max())]
        for i, name in enumerate(box.names)
    ]
    print_table(f"{len(made.x)} points ({method})", ["input", "from", "to", "least", "greatest"], rows)
    if run:
        out.print(f"{len(made.x) - made.failed} runs finished, {made.failed} failed (their rows say why).", highlight=False)
        if made.rows > len(made.x):
            out.print(f"The table also keeps {made.rows - len(made.x)} rows of earlier calls, after these.", highlight=False)
    out.print(f"Written to {made.table}", highlight=False, soft_wrap=True)
