"""``lacli tradeoff``: speed against accuracy on the user's own scene and machine."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from lacli.api import mechanics
from lacli.base.errors import UsageError
from lacli.cli.terminal.console import out, print_json, print_table, stages
from lacli.cli.terminal.live import LiveLine
from lacli.cli.terminal.modes import refuse
from lacli.cli.terminal.scenes import read_scene
from lacli.cli.terminal.tables import BoxFile
from lacli.contracts.targets import read_targets


def command(
    ctx: typer.Context,
    scene_file: Annotated[Path, typer.Argument(metavar="SCENE", help="The scene, a TOML file.")],
    finer: Annotated[Path | None, typer.Option(help="A bundle of the same atrium with finer cells: the reference.")] = None,
    tolerance_mm: Annotated[float, typer.Option(min=1e-6, help="Largest error of a displacement that is acceptable.")] = 0.22,
    root: Annotated[Path, typer.Option("--out", help="Folder of the runs.")] = Path("runs"),
    overrides: Annotated[list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Override a key; may repeat.")] = None,
    record: Annotated[bool, typer.Option(help="Keep the errors in the bundle, so that later results carry them.")] = True,
    purpose: Annotated[
        str, typer.Option("--for", help="features: errors of a simulation's; calibration: what the numerics do to the posterior.")
    ] = "features",
    targets_file: Annotated[
        Path | None, typer.Option("--targets", help="--for calibration: targets (TOML), of which names and errors count.")
    ] = None,
    tolerance_sd: Annotated[
        float, typer.Option(min=1e-6, help="--for calibration: acceptable shift of an alpha, posterior sd.")
    ] = 0.25,
    box_file: BoxFile = None,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON document on standard output.")] = False,
) -> None:
    """Measure speed against accuracy: linear and quadratic cells, two quadratures, and a finer mesh if there is one.

    Example: lacli tradeoff scene.toml --finer bundle_3mm --tolerance-mm 0.2
    """
    if purpose not in ("features", "calibration"):
        raise UsageError(f"--for {purpose}: must be features or calibration.")
    if (purpose == "calibration") != (targets_file is not None):
        raise UsageError("--for calibration and --targets go together.")
    if targets_file is not None:
        refuse(ctx, "with --for calibration", "--record", "--tolerance-mm")
        _calibration(scene_file, targets_file, finer, tolerance_sd, root, overrides, box_file, as_json)
        return
    refuse(ctx, "without --for calibration", "--box", "--tolerance-sd")
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
    if best.mesh == "own":
        out.print(
            "The reference has the same mesh: what the size of its cells changes is in no error of this table, and nothing is "
            "kept of quadratic cells, for which the model's estimate goes on standing. --finer BUNDLE measures it.",
            highlight=False,
        )


def _calibration(
    scene_file: Path,
    targets_file: Path,
    finer: Path | None,
    tolerance_sd: float,
    root: Path,
    overrides: list[str] | None,
    box_file: Path | None,
    as_json: bool,
) -> None:
    """The effect on the posterior, as a table and a picture."""
    from lacli.inference.box import published_box, read_box

    box = read_box(box_file) if box_file else published_box()
    scene, targets = read_scene(scene_file, overrides, box), read_targets(targets_file)
    with stages() as show:
        found = mechanics.tradeoff(
            scene, targets, finer=finer, box=box, tolerance_sd=tolerance_sd, store=root, figures=True, progress=show
        )
    if as_json:
        print_json(
            {
                "inputs": list(found.inputs),
                "reference": found.effects[-1].name,
                "tolerance_sd": tolerance_sd,
                "recommended": found.recommended.name if found.recommended else None,
                "choices": [
                    {
                        "name": e.name, "runs": e.runs, "cpu_s": e.cpu_s, "error_sd": e.error, "trouble": e.trouble,
                        **{
                            key: dict(zip(found.inputs, map(float, value), strict=True))
                            for key, value in (
                                ("map", e.x), ("shift_sd", e.shift), ("sd_ratio", e.sd_ratio),
                                ("shift_with_errors_sd", e.shift_wider), ("sd_ratio_with_errors", e.wider_ratio),
                            )
                        },
                    }
                    for e in found.effects
                ],
                "pictures": [str(path) for path in found.pictures],
            }
        )  # fmt: skip
        return
    dearest = found.effects[-1].cpu_s
    rows: list[list[Any]] = []
    for e in found.effects:
        if e.trouble:
            rows.append([e.name, "", "", "", "", "", "", e.trouble])
            continue
        at = max(range(len(found.inputs)), key=lambda i: abs(e.shift[i]))
        rows.append([
            e.name, e.cpu_s, e.cpu_s / dearest, e.error, f"{e.shift[at]:+.2g} ({found.inputs[at]})",
            f"{min(e.sd_ratio):.2g} - {max(e.sd_ratio):.2g}", float(abs(e.shift_wider).max()),
            "reference" if e is found.effects[-1] else "",
        ])  # fmt: skip
    columns = [
        "numerics",
        "CPU a run (s)",
        "of the reference",
        "features' error (sd of targets)",
        "largest shift (sd)",
        "sd, of the reference's",
    ]
    print_table("What the numerics do to the posterior", [*columns, "shift with errors stated (sd)", ""], rows)
    chosen = found.recommended
    out.print(
        f"Recommended: {chosen.name}; no alpha shifts by more than {tolerance_sd:g} sd."
        if chosen
        else f"No cheaper choice shifts every alpha by at most {tolerance_sd:g} sd: use the reference, or finer cells.",
        highlight=False, soft_wrap=True,
    )  # fmt: skip
    for path in found.pictures:
        out.print(f"   picture {path}", highlight=False)
