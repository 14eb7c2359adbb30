"""``lacli calibrate``: all inference steps for one patient, resumable."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lacli.base.errors import LacliError, UsageError
from lacli.cli.inference.sought import carriers, seek_and_show, show_forecast, show_posterior, show_prices, time_of
from lacli.cli.terminal.console import err, out, print_json, print_table
from lacli.cli.terminal.modes import refuse
from lacli.cli.terminal.scenes import read_scene
from lacli.cli.terminal.tables import BoxFile, Fresh, Json, Retry, Scheduler, Seed, Warm, Workers

if TYPE_CHECKING:
    from lacli.api.methods.calibrated import Calibrated, Recovered
    from lacli.api.progress import Progress
    from lacli.calibration.calibration import Calibration, WaveReport
    from lacli.inference.box import Box


def command(
    ctx: typer.Context,
    scene_file: Annotated[Path | None, typer.Argument(metavar="[SCENE]", help="The patient's scene, a TOML file.")] = None,
    targets_file: Annotated[Path | None, typer.Option("--targets", help="Targets: mean and sd of each feature (TOML).")] = None,
    from_table: Annotated[
        Path | None, typer.Option("--from-table", help="Runs done elsewhere: inputs and outputs in one table.")
    ] = None,
    synthetic: Annotated[
        bool, typer.Option("--synthetic-truth", help="Verification: recover known parameters at two noise levels.")
    ] = False,
    truth: Annotated[
        list[str] | None, typer.Option("--truth", metavar="NAME=VALUE", help="A known parameter of --synthetic-truth.")
    ] = None,
    folder: Annotated[Path, typer.Option("--out", help="Folder of everything; started again, it goes on there.")] = Path(
        "calibration"
    ),
    root: Annotated[Path | None, typer.Option("--store", help="Folder of the simulations (default: runs in --out).")] = None,
    box_file: BoxFile = None,
    method: Annotated[
        str | None,
        typer.Option(
            help="sequential: to the posterior, with the runs' derivatives (tens of runs); published: waves over the box "
            "(hundreds). Default: sequential where a scene that tells derivatives is given with targets and no option of waves.",
        ),
    ] = None,
    first: Annotated[int | None, typer.Option("--first-runs", min=10, help="published: runs of the first wave (200).")] = None,
    following: Annotated[
        int | None, typer.Option("--wave-runs", min=1, help="published: runs of each further wave (100).")
    ] = None,
    max_waves: Annotated[int | None, typer.Option(min=1, help="published: waves at most (5).")] = None,
    max_runs: Annotated[int | None, typer.Option(min=10, help="Budget: runs (10000; sequential: 60).")] = None,
    hours: Annotated[
        float | None, typer.Option(min=0, help="published: no further wave that would end later than this (no limit).")
    ] = None,
    prior: Annotated[
        str | None, typer.Option(help="published: nroy (default): what history matching leaves; box: the whole box.")
    ] = None,
    workers: Workers = None,
    scheduler: Scheduler = None,
    ess: Annotated[float, typer.Option(min=1, help="Effective samples of every input; fewer are sooner there.")] = 5000,
    sensitivities: Annotated[
        bool, typer.Option("--sensitivities/--no-sensitivities", help="Runs tell their derivatives, where the scene can.")
    ] = True,
    warm: Warm = False,
    discretisation: Annotated[
        bool,
        typer.Option(
            "--discretisation-error/--no-discretisation-error", help="Widen the targets' errors by the scene's own, see tradeoff."
        ),
    ] = True,
    infer_errors: Annotated[
        bool,
        typer.Option(
            "--infer-errors/--no-infer-errors",
            help="sequential: errors of discretisation, and discrepancies stated, are taken for larger where the misfit says so.",
        ),
    ] = True,
    overrides: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Override a key of the scene.")
    ] = None,
    fresh: Fresh = False,
    retry: Retry = False,
    forecast: Annotated[
        bool, typer.Option("--forecast", help="sequential: only its first runs, and what these targets can teach of each input.")
    ] = False,
    cheap: Annotated[
        list[str] | None,
        typer.Option(
            "--cheap",
            metavar="KEY=VALUE",
            help="sequential: most runs with these numerics (order=1, anatomy.bundle=...), corrected "
            "by about ten of the scene's own; may be repeated. Where not given: order=1 for a scene of quadratic cells; "
            "none: all runs are the scene's own.",
        ),
    ] = None,
    reference_runs: Annotated[
        int | None,
        typer.Option("--reference-runs", min=4, help="Where cheap runs carry the search: the scene's own at most (12)."),
    ] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="sequential: what it costs at most, without a run.")] = False,
    figures: Annotated[bool, typer.Option(help="Draw the figures.")] = True,
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """The posterior of a patient's parameters, from simulations that are made where they tell most.

    Started again with the same --out it continues, and ends as if it had not been interrupted. The published method (waves over
    the box, history matching) stays: --method published.

    Example: lacli calibrate scene.toml --targets targets.toml --out patient_1
    """
    from lacli.api import calibration as api
    from lacli.calibration.calibration import Settings
    from lacli.calibration.sequential.search import Settings as Sought
    from lacli.contracts.targets import read_targets
    from lacli.inference.box import published_box, read_box
    from lacli.inference.sampling.posterior import Settings as Sampling

    if from_table is None and scene_file is None:
        raise UsageError("give a SCENE to simulate, or --from-table with runs done elsewhere.")
    if synthetic == (targets_file is not None):
        raise UsageError("give either --targets or --synthetic-truth.")
    if from_table is not None and synthetic:
        raise UsageError("--from-table needs --targets.")
    if method not in (None, "published", "sequential"):
        raise UsageError(f"--method {method}: must be published or sequential.")
    _refuse_ignored(ctx, from_table is not None, synthetic, dry_run)
    begin = time.monotonic()
    of_waves = [option for option, value in (("--first-runs", first), ("--wave-runs", following), ("--max-waves", max_waves),
                                             ("--hours", hours), ("--prior", prior)) if value is not None]  # fmt: skip
    if method is None:
        can = scene_file is not None and targets_file is not None and from_table is None and sensitivities and not of_waves
        method = _default_method(scene_file, overrides) if can and scene_file is not None else "published"
    if method == "sequential":
        if scene_file is None or targets_file is None or from_table is not None:
            raise UsageError("--method sequential needs a SCENE that it can run, and --targets.")
        if not sensitivities:
            raise UsageError("--method sequential needs the runs' derivatives; leave --no-sensitivities out.")
        if of_waves:
            raise UsageError(f"--method sequential makes no waves: {', '.join(of_waves)} is of the published method.")
        space = read_box(box_file) if box_file else published_box()
        budgets = {"max_runs": max_runs or Sought.max_runs, "reference_runs": reference_runs or Sought.reference_runs}
        options: dict[str, Any] = {
            "box": space,
            "settings": Sought(**budgets, infer_errors=infer_errors, seed=seed, mcmc=Sampling(ess=ess)),
            "store": root, "workers": workers, "scheduler": scheduler, "fresh": fresh, "retry": retry,
            "discretisation": discretisation, "warm": warm,
        }  # fmt: skip
        patient, wanted = read_scene(scene_file, overrides, space), read_targets(targets_file)
        options["cheap"] = carriers(patient, cheap)
        if reference_runs and not options["cheap"]:
            raise UsageError("--reference-runs: how many runs correct cheap ones, and none are made here (--cheap order=1).")
        if dry_run:
            show_prices(patient, wanted, folder, as_json, **{key: options[key] for key in ("box", "settings", "store", "cheap")})
        elif forecast:
            show_forecast(patient, wanted, folder, as_json, **options)
        else:
            seek_and_show(patient, wanted, folder, as_json, figures=figures, **options)
        return
    if alone := next((o for o, v in (("--cheap", cheap), ("--reference-runs", reference_runs), ("--dry-run", dry_run)) if v), ""):
        raise UsageError(f"{alone}: of the sequential method, which needs a SCENE whose runs tell derivatives, and --targets.")
    if forecast:
        raise UsageError("--forecast: of the sequential method, which needs a SCENE whose runs tell derivatives, and --targets.")
    refuse(ctx, "by the published method", "--infer-errors")
    settings = Settings(
        first_runs=first or Settings.first_runs,
        wave_runs=following or Settings.wave_runs,
        max_waves=max_waves or Settings.max_waves,
        max_runs=max_runs or Settings.max_runs,
        hours=Settings.hours if hours is None else hours,
        prior=prior or Settings.prior,
        seed=seed,
        mcmc=Sampling(ess=ess),
    )
    box, scene = read_box(box_file) if box_file else None, None
    if from_table is None and scene_file is not None:
        box = box or published_box()
        scene = read_scene(scene_file, overrides, box)
    if synthetic and scene is not None and box is not None:
        with _dashboard() as show:
            recovered = api.calibrate(
                scene, None, folder, method="published", truth=_truth(truth, box), box=box, settings=settings, store=root,
                workers=workers, scheduler=scheduler, fresh=fresh, retry=retry, figures=figures, progress=show,
            )  # fmt: skip
        _show_recovery(recovered, as_json, time.monotonic() - begin)
        return
    assert targets_file is not None
    targets = read_targets(targets_file)
    with _dashboard() as show:
        found = api.calibrate(
            scene, targets, folder, method="published", table=from_table, box=box, settings=settings, store=root, workers=workers,
            scheduler=scheduler, sensitivities=sensitivities, fresh=fresh, retry=retry, figures=figures, progress=show,
            discretisation=discretisation, warm=warm,
        )  # fmt: skip
    _finish(found, as_json, time.monotonic() - begin)


def _refuse_ignored(ctx: typer.Context, of_table: bool, synthetic: bool, dry_run: bool) -> None:
    from lacli.cohort.steps import OF_RUNS

    if of_table:
        refuse(ctx, "with --from-table, whose runs are done", "SCENE", *(f"--{name}" for name in OF_RUNS))
    if synthetic:
        # its runs tell no derivatives, which warm starts need; its truth has the very numerics of its runs
        refuse(ctx, "with --synthetic-truth", "--warm", "--sensitivities", "--discretisation-error", "--infer-errors")
    else:
        refuse(ctx, "without --synthetic-truth", "--truth")
    if dry_run:
        refuse(ctx, "with --dry-run, which makes no run", "--forecast")


def _default_method(scene_file: Path, overrides: list[str] | None) -> str:
    """Sequential where the scene's runs can tell derivatives; published otherwise, with a word."""
    from lacli.api.methods.sequential import lacking
    from lacli.contracts.scene import load_scene

    if words := lacking(load_scene(scene_file, overrides or [])):
        err.print(f"note: {words} The published method is used.", highlight=False, soft_wrap=True)
        return "published"
    return "sequential"


def _truth(pairs: list[str] | None, box: Box) -> dict[str, float]:
    known = {}
    for text in pairs or []:
        name, equals, value = text.partition("=")
        if not equals or name not in box.names:
            raise UsageError(f"--truth {text}: write it as name=value with a name of {', '.join(box.names)}.")
        try:
            known[name] = float(value)
        except ValueError as error:
            raise UsageError(f"--truth {text}: {value!r} is not a number.") from error
    return known


@contextmanager
def _dashboard() -> Iterator[Callable[[Progress], None]]:
    """A live view on standard error: stage with time left, and a line for each wave done."""
    from rich.live import Live
    from rich.table import Table

    def view(event: Progress | None, waves: Sequence[WaveReport] = ()) -> Table:
        table = Table(title="calibration", title_justify="left", header_style="bold")
        for column in ("wave", "runs", "failed", "threshold", "NROY %", "change %", "worst R2"):
            table.add_column(column, justify="right")
        if event is None:
            return table
        for w in waves:
            change = "" if w.change != w.change else f"{100 * w.change:.2g}"
            table.add_row(
                str(w.wave),
                str(w.runs),
                str(w.failed),
                f"{w.threshold:g}",
                f"{100 * w.share:.3g}",
                change,
                f"{min(w.r2.values()):.4f}",
            )
        left = f", {time_of(event.left_s)} left" if event.left_s and event.total > event.done else ""
        table.caption = f"{event.stage} {event.done:.0f}/{event.total:.0f}{left}"
        return table

    with Live(view(None), console=err, refresh_per_second=4, transient=not err.is_terminal) as live:
        waves: tuple[WaveReport, ...] = ()

        def show(event: Progress) -> None:
            nonlocal waves
            if event.calibration is not None:
                waves = event.calibration.waves
            live.update(view(event, waves))

        yield show


def _finish(found: Calibrated, as_json: bool, wall_s: float) -> None:
    from lacli.calibration.calibration import Calibration, document

    for note in found.notes:
        err.print(f"note: {note}", highlight=False, soft_wrap=True)
    result = found.result
    assert isinstance(result, Calibration)
    if as_json:
        print_json({**document(result), "wall_s": wall_s, "pictures": [str(p) for p in found.pictures]})
    else:
        _show(result)
        out.print(
            f"Stopped because {result.stopped}; {time_of(wall_s)}. Everything is in {found.folder}",
            highlight=False,
            soft_wrap=True,
        )
    for text in found.warnings:
        err.print(f"warning: {text}", highlight=False, soft_wrap=True)
    if found.refused:
        raise LacliError(found.refused)


def _show(result: Calibration) -> None:
    show_posterior(result)
    print_table(
        "Fit at the most probable parameters" + (f", RMSE {result.rmse_mm:.3g} mm" if result.rmse_mm is not None else ""),
        ["feature", "target", "sd", "emulated", "simulated"],
        [[r["feature"], r["target"], r["sd"], r["emulated"], r.get("simulated", "")] for r in result.fit],
    )


def _show_recovery(found: Recovered, as_json: bool, wall_s: float) -> None:
    from lacli.calibration.calibration import document

    if as_json:
        print_json(
            {
                "wall_s": wall_s,
                "pictures": [str(p) for p in found.pictures],
                "levels": {
                    r.level: {
                        "inside95": r.inside, "outside_posterior": r.outside_posterior, "inputs": r.rows,
                        **document(r.calibration),
                    } for r in found.levels
                },
            }
        )  # fmt: skip
        return
    for r in found.levels:
        print_table(
            f"{r.level}: {r.inside} of {len(r.rows)} inside their 95 % intervals, {r.outside_posterior} outside the posterior",
            ["input", "truth", "2.5 %", "97.5 %", "most probable", "|MAP - truth|", "inside"],
            [
                [q["input"], q["truth"], q["low95"], q["high95"], q["map"], q["map_error"], "yes" if q["inside95"] else "NO"]
                for q in r.rows
            ],
        )
    out.print(f"{time_of(wall_s)}. Everything is in {found.folder}", highlight=False, soft_wrap=True)
