"""``lacli match``: history matching, one wave."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lacli.base.errors import LacliError, UsageError
from lacli.cli.console import err, out, print_json, print_table
from lacli.cli.tables import (
    BoxFile,
    Emulators,
    Inputs,
    Json,
    Names,
    Outputs,
    Seed,
    box_of,
    covered,
    fitted,
    selected,
    superseded,
    warn,
)

if TYPE_CHECKING:
    from lacli.base.arrays import FloatArray
    from lacli.inference.box import Box
    from lacli.inference.matching import Wave


def command(
    targets_file: Annotated[Path, typer.Option("--targets", help="Targets: mean and sd of each feature (TOML).")],
    inputs: Inputs = None,
    outputs: Outputs = None,
    names: Names = None,
    emulators_file: Emulators = None,
    earlier: Annotated[
        list[Path] | None, typer.Option("--earlier", help="Emulators of an earlier wave, in order; may be repeated.")
    ] = None,
    threshold: Annotated[float, typer.Option(min=0.1, help="Implausibility from which a point is ruled out.")] = 3.0,
    earlier_threshold: Annotated[float, typer.Option(min=0.1, help="The same, of the earlier waves.")] = 3.5,
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

    from lacli.base.files import check_folder, replacing
    from lacli.contracts.identity import identify, write_identity
    from lacli.contracts.targets import read_targets
    from lacli.inference.emulation.emulator_set import load_emulators
    from lacli.inference.matching import Region, Wave, match, next_runs, ruled_out_by
    from lacli.inference.nroy import EmptyRegionError
    from lacli.inference.verdict import judge

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
        before = selected(before, targets.names, path)
        waves.append(Wave(before, targets.widened(before.error_sd), earlier_threshold))
    wave = Wave(emulators, targets.widened(emulators.error_sd), threshold)
    region = Region(box, (*waves, wave))
    existing = table.x if table is not None else emulators.training_inputs()
    outside = covered(box, existing, _open_to(box, waves))
    try:
        with err.status("matching") as status:
            found = match(region, count, seed=seed, tick=lambda t: status.update(f"matching (level {t:.3g}; 1 is the region)"))
    except EmptyRegionError as error:
        reach = judge(emulators, wave.targets, box, error.best, threshold)
        for text in reach.warnings():
            warn(text)
        raise LacliError(
            "nothing is left: at the nearest point of the box, " + ruled_out_by(wave, error.best[None])
            + ". Check the targets' units and standard deviations, or widen the box."
        ) from error  # fmt: skip
    folder.mkdir(parents=True, exist_ok=True)
    superseded(folder, "nroy.csv", "next.csv", "region.png", "outputs.png")
    write_identity(
        folder / "identity.json", identify("result", region=region, count=count, seed=seed, runs=existing, following=following)
    )
    points = pd.DataFrame(found.sample.points, columns=list(box.names))
    points["implausibility"] = wave.implausibility(found.sample.points).max(1)
    with replacing(folder / "nroy.csv") as temporary:
        points.to_csv(temporary, index=False)
    if following:
        with replacing(folder / "next.csv") as temporary:
            pd.DataFrame(next_runs(found.sample, following, existing), columns=list(box.names)).to_csv(temporary, index=False)
    pictures = []
    if figures:
        from lacli.report.inference_figures_matching import outputs_figure, region_figure

        pictures = [
            region_figure(region, folder / "region.png", seed, found.sample.points, found.share),
            outputs_figure([(f"{emulators.runs} runs", emulators, found.sample.points)], targets, folder / "outputs.png"),
        ]
    result = {
        "share": found.share, "share_sd": found.share_sd, "outside_runs": outside, "threshold": threshold, "sampled": len(points),
        "acceptance": found.sample.acceptance, "correlation": found.sample.correlation, "pictures": [str(p) for p in pictures],
    }  # fmt: skip
    if as_json:
        print_json(result)
        return
    print_table(
        f"Not ruled out: {found.share:.3g} ± {found.share_sd:.1g} of the box (threshold {threshold:g})",
        ["input", "from", "to", "mean", "sd"],
        [[n, float(points[n].min()), float(points[n].max()), float(points[n].mean()), float(points[n].std())] for n in box.names],
    )
    out.print(f"Sample, next runs and figures in {folder}", highlight=False, soft_wrap=True)


def _open_to(box: Box, waves: list[Wave]) -> FloatArray | None:
    """Points (m, d) of the box that the earlier waves have not ruled out; None (the whole box) without waves."""
    import numpy as np

    from lacli.inference.matching import Region

    if not waves:
        return None
    points = box.uniform(1 << 15, np.random.default_rng(0))
    return points[Region(box, tuple(waves)).contains(points)]
