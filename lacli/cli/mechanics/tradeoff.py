"""``lacli tradeoff``: speed against accuracy on the user's own scene and machine."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lacli.api import mechanics
from lacli.cli.terminal.console import out, print_json, print_table
from lacli.cli.terminal.live import LiveLine
from lacli.cli.terminal.scenes import read_scene


def command(
    scene_file: Annotated[Path, typer.Argument(metavar="SCENE", help="The scene, a TOML file.")],
    finer: Annotated[Path | None, typer.Option(help="A bundle of the same atrium with finer cells: the reference.")] = None,
    tolerance_mm: Annotated[float, typer.Option(min=1e-6, help="Largest error of a displacement that is acceptable.")] = 0.22,
    root: Annotated[Path, typer.Option("--out", help="Folder of the runs.")] = Path("runs"),
    overrides: Annotated[list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Override a key; may repeat.")] = None,
    record: Annotated[bool, typer.Option(help="Keep the errors in the bundle, so that later results carry them.")] = True,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON document on standard output.")] = False,
) -> None:
    """Measure speed against accuracy: linear and quadratic cells, two quadratures, and a finer mesh if there is one.

    Example: lacli tradeoff scene.toml --finer bundle_3mm --tolerance-mm 0.2
    """
    scene = read_scene(scene_file, overrides)
    with LiveLine() as line:
        found = mechanics.tradeoff(
            scene, finer=finer, tolerance_mm=tolerance_mm, store=root, record=record, progress=lambda event: line(event.solver)
        )
    best, choice = found.reference, found.recommended
    compared = list(zip(found.variants, found.errors, strict=True))
    if as_json:
        print_json(
            {
                "reference": {"mesh": best.mesh, "numerics": best.numerics},
                "variants": [
                    {
                        "mesh": v.mesh,
                        "numerics": v.numerics,
                        "status": v.status,
                        "kind": v.kind,
                        "unknowns": v.features.get("unknowns"),
                        "cpu_s": v.cpu_s,
                        "peak_memory_mb": v.peak_memory_mb,
                        "error": error if v.status == "done" else None,
                    }
                    for v, error in compared
                ],
                "recommended": choice,
                "tolerance_mm": tolerance_mm,
            }
        )
        return
    rows = []
    for v, difference in compared:
        worst = max((value for name, value in difference.items() if name.endswith("_mm")), default=float("nan"))
        note = "reference" if v is best else (v.kind or "")
        rows.append(
            [
                v.mesh,
                v.numerics,
                v.features.get("unknowns", ""),
                v.cpu_s,
                v.peak_memory_mb,
                worst,
                difference.get("esv_ml", ""),
                note,
            ]
        )
    columns = ["mesh", "numerics", "unknowns", "CPU (s)", "memory (MB)", "worst displacement error (mm)", "ESV error (mL)", ""]
    print_table("Speed against accuracy", columns, rows)
    out.print(
        f"Recommended for {tolerance_mm:g} mm: {choice} (numerics.order and numerics.quadrature)."
        if choice
        else f"No choice on this mesh is within {tolerance_mm:g} mm: use finer cells.",
        highlight=False,
    )
