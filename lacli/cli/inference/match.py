"""``lacli match``: history matching, one wave."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lacli.api import inference
from lacli.base.errors import UsageError
from lacli.cli.terminal.console import err, out, print_json, print_table
from lacli.cli.terminal.modes import refuse
from lacli.cli.terminal.tables import (
    BoxFile,
    Emulators,
    Inputs,
    Json,
    Names,
    Outputs,
    Seed,
    fitted,
    warn,
)


def command(
    ctx: typer.Context,
    targets_file: Annotated[Path, typer.Option("--targets", help="Targets: mean and sd of each feature (TOML).")],
    inputs: Inputs = None,
    outputs: Outputs = None,
    names: Names = None,
    emulators_file: Emulators = None,
    earlier: Annotated[
        list[Path] | None, typer.Option("--earlier", help="Emulators of an earlier wave, in order; may be repeated.")
    ] = None,
    threshold: Annotated[
        float | None,
        typer.Option(min=0.1, help="Implausibility from which a point is ruled out (3.5 in the first wave, 3 with --earlier)."),
    ] = None,
    earlier_threshold: Annotated[
        float | None, typer.Option(min=0.1, help="The same, of all earlier waves (3.5 of the first, 3 of the others).")
    ] = None,
    box_file: BoxFile = None,
    count: Annotated[int, typer.Option("-n", min=1, help="Points sampled uniformly from what is left.")] = 10_000,
    following: Annotated[int, typer.Option("--next", min=0, help="Runs to propose for the next wave.")] = 100,
    folder: Annotated[Path, typer.Option("--out", help="Folder for tables and figures.")] = Path("match"),
    figures: Annotated[bool, typer.Option(help="Draw the region and the outputs.")] = True,
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """Rule out parameters that cannot reach the targets; measure and sample what is left; propose the next runs.

    Example: lacli match --inputs X.csv --outputs Y.csv --targets targets.toml --out wave_1
    """
    import pandas as pd

    from lacli.base.files import check_folder, replacing, superseded
    from lacli.contracts.identity import identify, write_identity
    from lacli.contracts.targets import read_targets
    from lacli.inference.emulation.emulator_set import load_emulators
    from lacli.inference.given import box_of, selected

    if not earlier:
        refuse(ctx, "without --earlier", "--earlier-threshold")
    check_folder(folder)
    targets = read_targets(targets_file)
    emulators, table = fitted(inputs, outputs, names or list(targets.names), emulators_file, seed, box_file)
    targets = targets.select(emulators.outputs)
    box = box_of(emulators, box_file, table)
    waves = []
    for path in earlier or []:
        before = load_emulators(path)
        if before.inputs != emulators.inputs:
            raise UsageError(f"{path}: its inputs are not those of this wave.")
        waves.append(selected(before, emulators.outputs, path))
    existing = table.x if table is not None else emulators.training_inputs()
    try:
        with err.status("matching") as status:
            matched = inference.match(
                emulators, targets, box=box, earlier=waves, threshold=threshold, earlier_threshold=earlier_threshold,
                count=count, following=following, runs=existing, seed=seed, progress=lambda event: status.update(event.stage),
            )  # fmt: skip
    except inference.NothingLeft as error:
        for text in error.warnings:
            warn(text)
        raise
    for text in matched.warnings:
        warn(text)
    region, found, outside = matched.region, matched.match, matched.outside
    folder.mkdir(parents=True, exist_ok=True)
    superseded(folder, "nroy.csv", "next.csv", "region.png", "outputs.png")
    write_identity(
        folder / "identity.json", identify("result", region=region, count=count, seed=seed, runs=existing, following=following)
    )
    points = pd.DataFrame(found.sample.points, columns=list(box.names))
    points["implausibility"] = region.waves[-1].implausibility(found.sample.points).max(1)
    with replacing(folder / "nroy.csv") as temporary:
        points.to_csv(temporary, index=False)
    if following:
        with replacing(folder / "next.csv") as temporary:
            pd.DataFrame(matched.next_runs, columns=list(box.names)).to_csv(temporary, index=False)
    pictures = []
    if figures:
        from lacli.report.inference_figures_matching import outputs_figure, region_figure

        pictures = [
            region_figure(region, folder / "region.png", seed, found.sample.points, found.share),
            outputs_figure([(f"{emulators.runs} runs", emulators, found.sample.points)], targets, folder / "outputs.png"),
        ]
    result = {
        "share": found.share, "share_sd": found.share_sd, "outside_runs": outside, "threshold": region.waves[-1].threshold,
        "sampled": len(points), "acceptance": found.sample.acceptance, "correlation": found.sample.correlation,
        "pictures": [str(p) for p in pictures],
    }  # fmt: skip
    if as_json:
        print_json(result)
        return
    print_table(
        f"Not ruled out: {found.share:.3g} ± {found.share_sd:.1g} of the box (threshold {region.waves[-1].threshold:g})",
        ["input", "from", "to", "mean", "sd"],
        [[n, float(points[n].min()), float(points[n].max()), float(points[n].mean()), float(points[n].std())] for n in box.names],
    )
    out.print(f"Sample, next runs and figures in {folder}", highlight=False, soft_wrap=True)
