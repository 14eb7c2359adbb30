"""``lacli simulate``: a scene to features, transients, fields and pictures."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table
from rich.text import Text

from lacli.api import mechanics
from lacli.base.errors import SimulationError, UsageError
from lacli.cli.terminal.console import err, fail, out, print_json, print_table
from lacli.cli.terminal.modes import refuse
from lacli.cli.terminal.scenes import read_scene
from lacli.contracts.identity import Identity, file_digest, identify, run_key
from lacli.contracts.scene import Scene
from lacli.mechanics.numerics import equilibria, stability
from lacli.mechanics.numerics.equilibria import SPREAD
from lacli.mechanics.store import find_run

_UNITS = {"_ml": "mL", "_mm": "mm", "_s": "s", "_mb": "MB", "_mmhg": "mmHg", "_kpa": "kPa"}

_DRAWN = "figures.json"  # beside the pictures: what they were drawn from


def command(
    ctx: typer.Context,
    scene_file: Annotated[Path | None, typer.Argument(metavar="SCENE", help="The scene, a TOML file.")] = None,
    root: Annotated[Path, typer.Option("--out", help="Folder of the runs; each gets a folder of its own there.")] = Path("runs"),
    overrides: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Override a key of the scene; may be repeated.")
    ] = None,
    equilibria: Annotated[
        bool,
        typer.Option(
            "--equilibria", help="Seek end-systole along a second way too, and tell what differs; as outputs.equilibria."
        ),
    ] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Say what would be modelled, what not, why, and the cost.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON document on standard output.")] = False,
    figures: Annotated[bool, typer.Option(help="Draw transients and shapes into the run's folder.")] = True,
    write: Annotated[
        Path | None, typer.Option("--write", metavar="DIR", help="Only write deck, inputs and run.sh there, to be run by hand.")
    ] = None,
    read: Annotated[
        Path | None, typer.Option("--read", metavar="DIR", help="Read the results of a deck of --write that has run.")
    ] = None,
    again: Annotated[
        Path | None, typer.Option("--rerun", metavar="RUN", help="Run a stored run once more and compare; it stays as it is.")
    ] = None,
) -> None:
    """Run a scene through FreeFEM: features at end-systole, transients, fields, pictures.

    A scene that was run before is not run again: its results are shown.

    Example: lacli simulate examples/scene.toml --set loads.esp_mmhg=18 --set materials.c_kpa.roof=2.5
    """
    if sum(choice is not None for choice in (scene_file, read, again)) != 1:
        raise UsageError("give a SCENE, or --read DIR, or --rerun RUN.")
    for option, asked in (("--read", read), ("--rerun", again)):
        if asked is not None:
            refuse(ctx, f"with {option}", "--out", "--set", "--equilibria", "--dry-run", "--figures", "--write")
    if write is not None:
        refuse(ctx, "with --write", "--out", "--dry-run", "--figures")
    if again is not None:
        _rerun(again, as_json)
        return
    if read is not None:
        _read(read, as_json)
        return
    assert scene_file is not None
    scene = read_scene(scene_file, [*(overrides or []), *(["outputs.equilibria=true"] if equilibria else [])])
    if write is not None:
        _write(scene, write, as_json)
        return
    if dry_run:
        _show_plan(scene, root, as_json)
        return
    result, repeated = _run(scene, root)
    pictures: list[Path] = []
    trouble = ""
    if figures and result.status == "done":
        pictures, trouble = _pictures(result)
    if result.status != "done":
        _show_failure(result)
    if as_json:
        print_json(_document(result, repeated, pictures))
    elif result.status == "done":
        _show_result(result, repeated, pictures)
    if trouble:
        err.print(f"The pictures could not be drawn ({trouble}). `lacli doctor` says what is missing.", highlight=False)
    if result.status != "done":
        raise typer.Exit(1)


def _run(scene: Scene, root: Path) -> tuple[Any, bool]:
    """The run's result, and whether it was there already."""
    from lacli.base.files import check_folder
    from lacli.cli.terminal.live import LiveLine

    check_folder(root)
    before = find_run(root, run_key(scene))
    with LiveLine() as line:
        result = mechanics.simulate(scene, store=root, progress=lambda event: line(event.solver))
    repeated = before is not None and before.manifest.get("finished") == result.manifest.get("finished")
    return result, repeated


def _write(scene: Scene, folder: Path, as_json: bool) -> None:
    script = mechanics.write_deck(scene, folder)
    if as_json:
        print_json({"folder": str(folder), "script": str(script)})
        return
    out.print(f"Run {script}, then: lacli simulate --read {folder}", highlight=False, soft_wrap=True)


def _read(folder: Path, as_json: bool) -> None:
    features = mechanics.read_deck(folder)
    if as_json:
        print_json({"folder": str(folder), "features": features})
    else:
        _show_features("Results", features)


def _rerun(folder: Path, as_json: bool) -> None:
    from lacli.cli.terminal.live import LiveLine

    with LiveLine() as line:
        before, after = mechanics.rerun(folder, progress=lambda event: line(event.solver))
    if as_json:
        print_json({"folder": str(folder), "stored": before, "again": after})
        return
    rows: list[list[Any]] = []
    for name, value in after.items():
        if _shown(name, value):
            label, unit = _label(name)
            old = before.get(name)
            rows.append([label, old, value, value - old if isinstance(old, (int, float)) else "", unit])
    print_table("Stored, and run again", ["quantity", "stored", "again", "difference", "unit"], rows)


def _pictures(result: Any) -> tuple[list[Path], str]:
    """Pictures of the run: those there are, if they were drawn from these very results, else drawn now; and what went wrong."""
    from lacli.contracts.identity import read_identity, write_identity
    from lacli.mechanics.store import StoredRun, check_products
    from lacli.report.simulation_figures import SHAPES, SOURCES, TRANSIENTS, draw_apart

    folder = result.folder
    there = [folder / name for name in (TRANSIENTS, SHAPES) if (folder / name).is_file()]
    sources = {name: digest for name, digest in result.manifest.get("sha256", {}).items() if name in SOURCES}
    if len(there) == 2 and read_identity(folder / _DRAWN) == _drawing(sources, there):
        return there, ""
    check_products(StoredRun(result.key, folder, result.manifest), sources)
    with err.status("drawing"):
        drawn, trouble = draw_apart(folder)
    if not trouble:
        write_identity(folder / _DRAWN, _drawing(sources, [path for path in drawn if path.is_file()]))
    return drawn, trouble


def _drawing(sources: dict[str, str], pictures: list[Path]) -> Identity:
    """What pictures were drawn from, and what they are."""
    return identify("figures", sources=sources, pictures={path.name: file_digest(path) for path in pictures})


def _errors(features: dict[str, Any]) -> dict[str, float]:
    known = features.get("discretisation_error")
    return known if isinstance(known, dict) else {}


def _document(result: Any, repeated: bool, pictures: list[Path]) -> dict[str, Any]:
    return {
        "status": result.status,
        "kind": result.kind,
        "message": result.message,
        "key": result.key,
        "folder": str(result.folder),
        "repeated": repeated,
        "features": result.features,
        "pictures": [str(path) for path in pictures],
        "manifest": result.manifest,
    }


def _show_failure(result: Any) -> None:
    fail(SimulationError(result.kind, f"the simulation failed ({result.kind}): {result.message} What there is: {result.folder}"))


def _show_result(result: Any, repeated: bool, pictures: list[Path]) -> None:
    _show_features("Run before, results kept" if repeated else "Results", result.features)
    out.print(f"Everything is in {result.folder}", highlight=False, soft_wrap=True)
    for path in pictures:
        out.print(f"   picture {path.name}", highlight=False)


def _show_features(title: str, features: dict[str, Any]) -> None:
    errors, sources = _errors(features), features.get("discretisation_error_source", {})
    spread = features.get(SPREAD)
    rows = []
    for name, value in features.items():
        if _shown(name, value):
            label, unit = _label(name)
            row = [label, value, unit, f"{errors[name]:.2g} ({sources[name]})" if name in errors else ""]
            rows.append(row if spread is None else [*row, f"{spread[name]:.2g}" if name in spread else ""])
    columns = ["quantity", "value", "unit", "discretisation error, sd"]
    print_table(title, columns if spread is None else [*columns, "between equilibria"], rows)
    for words in (equilibria.said_of(features), stability.said_of(features)):
        if words:
            err.print(words, highlight=False)


def _shown(name: str, value: Any) -> bool:
    """Whether a table at the terminal has the feature: components and strains, 30 numbers, are in the files alone."""
    component = name.startswith(("n_", "a_", "b_")) or "_strain_" in name
    return isinstance(value, (int, float)) and not component


def _label(name: str) -> tuple[str, str]:
    """A feature's name and unit, from the unit at its end."""
    for ending, unit in _UNITS.items():
        if name.endswith(ending):
            return name.removesuffix(ending).replace("_", " "), unit
    return name.replace("_", " "), ""


def _show_plan(scene: Scene, root: Path, as_json: bool) -> None:
    from lacli.contracts import bundle as bundles
    from lacli.mechanics.numerics import cost
    from lacli.mechanics.numerics.earlier import earlier
    from lacli.mechanics.plan import describe

    bundle = bundles.load(scene.anatomy.bundle)
    terms = [(term, included, why) for term, included, why in describe(scene, bundle)]
    price = cost.expected(scene, bundle, earlier(root))
    key = run_key(scene)
    known = find_run(root, key)
    if as_json:
        print_json(
            {
                "key": key,
                "already": known.status if known else None,
                "terms": [{"term": term, "included": included, "why": why} for term, included, why in terms],
                "expected": vars(price),
                "scene": scene.model_dump(mode="json"),
            }
        )
        return
    table = Table(header_style="bold")
    table.add_column("term", no_wrap=True)
    table.add_column("modelled", no_wrap=True)
    table.add_column("why")
    for term, included, why in sorted(terms, key=lambda item: not item[1]):
        table.add_row(term, Text("yes", "green") if included else "no", why)
    out.print(table)
    out.print(f"Expected cost: {_price(price)}.", highlight=False, soft_wrap=True)
    if known:
        out.print(f"This scene was run before ({known.status}): {known.folder}", highlight=False, soft_wrap=True)


def _price(price: Any) -> str:
    spread = f"nine of ten such scenes: {price.low_s:.2g} to {price.high_s:.2g}"
    text = f"{price.unknowns:,} unknowns, about {price.cpu_s:.2g} CPU s ({spread}), {price.peak_memory_mb:.0f} MB"
    if price.runs:
        return f"{text} (by {price.runs} finished runs in --out)"
    return (
        f"{text} (an ordinary scene on an ordinary machine: a thin or soft wall that snaps through takes several times as long)"
    )
