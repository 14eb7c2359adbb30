"""``lacli emulate``: fit and check one Gaussian-process emulator per output."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lacli.api import inference
from lacli.cli.terminal.console import err, out, print_json, print_table, stages
from lacli.cli.terminal.modes import given
from lacli.cli.terminal.tables import BoxFile, Inputs, Json, Linear, Names, Outputs, Seed, read


def command(
    ctx: typer.Context,
    inputs: Inputs = None,
    outputs: Outputs = None,
    names: Names = None,
    file: Annotated[Path, typer.Option("--out", help="The emulators, an .npz file.")] = Path("emulators.npz"),
    folds: Annotated[int, typer.Option(min=2, help="Folds of the cross-validation.")] = 5,
    starts: Annotated[int, typer.Option(min=1, help="Starting points of each fit.")] = 3,
    figures: Annotated[bool, typer.Option(help="Draw predicted against simulated beside the emulators.")] = True,
    box_file: BoxFile = None,
    linear: Linear = None,
    gradients: Annotated[
        bool, typer.Option(help="Learn from columns d<output>/d<input> (in the output's unit over the input's) too.")
    ] = True,
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """Fit one emulator per output and cross-validate it: R2, share of runs within 2 sd (ISE), log density (NLPD).

    Example: lacli emulate --inputs X.csv --outputs Y.csv --out emulators.npz
    """
    from lacli.base.files import check_file, superseded
    from lacli.inference.emulation.emulator_set import save_emulators
    from lacli.inference.given import box_of_inputs

    check_file(file, inputs, outputs, box_file, begins=b"PK")  # an .npz file is a ZIP archive
    earlier = file.exists()
    table = read(inputs, outputs, names)
    learnt = gradients and table.gradients is not None
    if learnt and given(ctx, "--starts"):
        err.print(
            "note: --starts does nothing where a table has derivatives: their fit has one start.", highlight=False, soft_wrap=True
        )
    with stages() as show:
        box = box_of_inputs(table.inputs, box_file) if box_file else None
        made = inference.emulate(
            table, box=box, linear=linear or (), folds=folds, starts=starts, seed=seed, gradients=gradients, progress=show
        )
    scores = made.scores
    save_emulators(file, made.emulators, made.identity)
    if earlier:
        superseded(file.parent, file.with_suffix(".png").name)
    pictures = []
    if figures:
        from lacli.report.inference_figures import validation_figure

        pictures.append(validation_figure(scores, table.y, file.with_suffix(".png")))
    if as_json:
        print_json(
            {
                "emulators": str(file),
                "runs": table.runs,
                "failed": len(table.failed_x),
                "gradients": learnt,
                "notes": list(table.notes),
                "outputs": {s.output: {"r2": s.r2, "ise": s.ise, "nlpd": s.nlpd, "train_cpu_s": s.train_cpu_s} for s in scores},
                "pictures": [str(p) for p in pictures],
            }
        )
        return
    rows = [[s.output, s.r2, s.ise, s.nlpd, s.train_cpu_s] for s in scores]
    kind = "runs with gradients" if learnt else "runs"
    print_table(f"{table.runs} {kind}, {folds} folds", ["output", "R2", "within 2 sd", "NLPD", "CPU s"], rows)
    out.print(f"Emulators in {file}", highlight=False, soft_wrap=True)
