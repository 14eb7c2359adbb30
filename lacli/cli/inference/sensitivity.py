"""``lacli sensitivity``: rank the inputs by Sobol' indices through the emulators."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lacli.api import inference
from lacli.cli.terminal.console import out, print_json, print_table, stages
from lacli.cli.terminal.tables import BoxFile, Emulators, Inputs, Json, Names, Outputs, Seed, fitted, warn


def command(
    inputs: Inputs = None,
    outputs: Outputs = None,
    names: Names = None,
    emulators_file: Emulators = None,
    box_file: BoxFile = None,
    count: Annotated[int, typer.Option("-n", help="Base points, a power of two.")] = 1024,
    draws: Annotated[int, typer.Option(min=0, help="Functions drawn from each emulator for its own uncertainty.")] = 32,
    folder: Annotated[Path, typer.Option("--out", help="Folder for tables and figures.")] = Path("sensitivity"),
    figures: Annotated[bool, typer.Option(help="Draw the heat map and the ranking.")] = True,
    seed: Seed = 1,
    as_json: Json = False,
) -> None:
    """First-order, total and second-order Sobol' indices, and a ranking by the greatest total effect.

    Example: lacli sensitivity --emulators emulators.npz --out sensitivity
    """
    import pandas as pd

    from lacli.base.files import check_folder, replacing, superseded
    from lacli.contracts.identity import identify, write_identity
    from lacli.inference.given import box_of

    inference.check_count(count)
    check_folder(folder)
    emulators, table = fitted(inputs, outputs, names, emulators_file, seed, box_file)
    box = box_of(emulators, box_file, table)
    with stages() as show:
        found = inference.sensitivity(emulators, box=box, count=count, draws=draws, seed=seed, progress=show)
    if found.warning:
        warn(found.warning)
    s, outside = found.indices, found.outside
    rank = s.ranking()
    rows = [
        {
            "output": output, "input": name, "first": s.s1[i, j], "first_conf": s.s1_conf[i, j],
            "first_emulator_sd": s.s1_emulator_sd[i, j],
            "total": s.st[i, j], "total_conf": s.st_conf[i, j], "total_emulator_sd": s.st_emulator_sd[i, j],
        }
        for i, output in enumerate(emulators.outputs) for j, name in enumerate(emulators.inputs)
    ]  # fmt: skip
    pairs = [
        {"output": output, "input": a, "with": emulators.inputs[k], "second": s.s2[i, j, k], "second_conf": s.s2_conf[i, j, k]}
        for i, output in enumerate(emulators.outputs) for j, a in enumerate(emulators.inputs) for k in range(j + 1, box.d)
    ]  # fmt: skip
    folder.mkdir(parents=True, exist_ok=True)
    superseded(folder, "indices.csv", "second_order.csv", "sensitivity.png", "ranking.png")
    write_identity(
        folder / "identity.json", identify("result", emulators=emulators, box=box, count=count, draws=draws, seed=seed)
    )
    for name, content in (("indices.csv", rows), ("second_order.csv", pairs)):
        if content:
            with replacing(folder / name) as temporary:
                pd.DataFrame(content).to_csv(temporary, index=False)
    pictures = []
    if figures:
        from lacli.report.inference_figures import ranking_figure, sensitivity_figure

        pictures = [
            sensitivity_figure(s, emulators.inputs, emulators.outputs, folder / "sensitivity.png"),
            ranking_figure(s, emulators.inputs, emulators.outputs, folder / "ranking.png"),
        ]
    order = rank.argsort()[::-1]
    if as_json:
        print_json(
            {
                "ranking": [{"input": emulators.inputs[j], "share": rank[j]} for j in order],
                "indices": rows,
                "second_order": pairs,
                "outside_runs": outside,
                "pictures": [str(p) for p in pictures],
            }
        )
        return
    best = s.st.argmax(0)
    print_table(
        "Ranking by the greatest total effect",
        ["input", "share", "total effect", "± sampling", "± emulator (sd)", "on"],
        [
            [
                emulators.inputs[j],
                rank[j],
                s.st[best[j], j],
                s.st_conf[best[j], j],
                s.st_emulator_sd[best[j], j],
                emulators.outputs[best[j]],
            ]
            for j in order
        ],
    )
    out.print(f"Tables and figures in {folder}", highlight=False, soft_wrap=True)
