"""``lacli calibrate``: all inference steps for one patient, resumable."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lacli.base.errors import LacliError, UsageError
from lacli.cli.terminal.console import err, out, print_json, print_table
from lacli.cli.terminal.tables import BoxFile, Fresh, Json, Retry, Seed, superseded

if TYPE_CHECKING:
    from lacli.calibration.calibration import Calibration, Monitor, Status
    from lacli.contracts.targets import Targets
    from lacli.inference.box import Box

FIGURES = ("region.png", "outputs.png", "corner.png", "trace.png", "fit.png")


def command(
    scene: Annotated[Path | None, typer.Argument(metavar="[SCENE]", help="The patient's scene, a TOML file.")] = None,
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
    first: Annotated[int, typer.Option("--first-runs", min=10, help="Runs of the first wave.")] = 200,
    following: Annotated[int, typer.Option("--wave-runs", min=1, help="Runs of each further wave.")] = 100,
    max_waves: Annotated[int, typer.Option(min=1, help="Waves at most.")] = 5,
    max_runs: Annotated[int, typer.Option(min=10, help="Budget: runs.")] = 10_000,
    hours: Annotated[float, typer.Option(min=0, help="Budget: no further wave that would end later than this.")] = float("inf"),
    prior: Annotated[str, typer.Option(help="nroy: what history matching leaves; box: the whole box.")] = "nroy",
    workers: Annotated[int | None, typer.Option(min=1, help="Simulations side by side.")] = None,
    scheduler: Annotated[str | None, typer.Option(help="Address of a Dask scheduler.")] = None,
    ess: Annotated[float, typer.Option(min=1, help="Effective samples of every input; fewer are sooner there.")] = 5000,
    overrides: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Override a key of the scene.")
    ] = None,
    fresh: Fresh = False,
    retry: Retry = False,
    figures: Annotated[bool, typer.Option(help="Draw the figures.")] = True,
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """Waves of simulations, history matching, posterior, and the simulation at the most probable parameters.

    Started again with the same --out it continues, and ends as if it had not been interrupted.

    Example: lacli calibrate scene.toml --targets targets.toml --out patient_1
    """
    from lacli.base.files import check_folder
    from lacli.calibration.calibration import Settings, calibrate, calibration_identity, obstacle
    from lacli.inference.box import CALIBRATION_INPUTS, OUTPUTS, published_box, read_box
    from lacli.inference.runs import RunLog
    from lacli.inference.sampling.posterior import Settings as Sampling

    if prior not in ("nroy", "box"):
        raise UsageError(f"--prior {prior}: must be nroy or box.")
    if from_table is None and scene is None:
        raise UsageError("give a SCENE to simulate, or --from-table with runs done elsewhere.")
    if synthetic == (targets_file is not None):
        raise UsageError("give either --targets or --synthetic-truth.")
    check_folder(folder)
    box = read_box(box_file) if box_file else published_box(CALIBRATION_INPUTS)
    settings = Settings(
        first_runs=first,
        wave_runs=following,
        max_waves=max_waves,
        max_runs=max_runs,
        hours=hours,
        prior=prior,
        seed=seed,
        mcmc=Sampling(ess=ess),
    )
    begin = time.monotonic()
    if from_table is not None:
        if targets_file is None:
            raise UsageError("--from-table needs --targets.")
        with _dashboard() as monitor:
            folder, result = _from_table(from_table, targets_file, box_file, settings, folder, fresh, monitor)
        _finish(result, folder, figures, as_json, time.monotonic() - begin, None)
        return
    from lacli.calibration.simulator import simulator
    from lacli.cli.terminal.scenes import read_scene
    from lacli.contracts.identity import settle
    from lacli.inference.runs import obstacle as runs_obstacle
    from lacli.inference.runs import runs_identity

    assert scene is not None
    read_scene(scene, overrides, box)
    run = simulator(scene, root or folder / "runs", workers, scheduler, overrides)
    if synthetic:
        from lacli.calibration.synthetic_truth import default_truth, logged, truth_identity, verify

        x = _truth(truth, box, default_truth(box))
        of_runs = runs_identity(run, box.names, logged(OUTPUTS))
        identity = truth_identity(run, box, OUTPUTS, x, settings)
        folder = settle(folder, lambda p: obstacle(p, identity) or runs_obstacle(p / "runs.csv", of_runs), fresh)
        with _dashboard() as monitor:
            recoveries = verify(run, box, OUTPUTS, x, settings, folder, monitor)
        _show_recovery(recoveries, box, folder, figures, as_json, time.monotonic() - begin)
        return
    from lacli.contracts.targets import read_targets

    assert targets_file is not None
    targets = read_targets(targets_file)
    of_runs = runs_identity(run, box.names, targets.names)
    identity = calibration_identity(box, targets, settings, of_runs)
    folder = settle(folder, lambda p: obstacle(p, identity) or runs_obstacle(p / "runs.csv", of_runs), fresh)
    log = RunLog(folder / "runs.csv", box.names, targets.names, of_runs, retry)
    with _dashboard() as monitor:
        result = calibrate(run, box, targets, settings, folder, log, monitor=monitor)
    _finish(result, folder, figures, as_json, time.monotonic() - begin, targets)


def _from_table(
    path: Path, targets_file: Path, box_file: Path | None, settings: Any, folder: Path, fresh: bool, monitor: Monitor
) -> tuple[Path, Calibration]:
    """The calibration of a table, and the folder it is in."""
    from lacli.calibration.calibration import calibrate, calibration_identity, given_runs, obstacle
    from lacli.contracts.identity import settle
    from lacli.contracts.tables.columns import error_of
    from lacli.contracts.tables.table import is_bookkeeping, read_frame
    from lacli.contracts.targets import read_targets
    from lacli.inference.box import RANGES, read_box, table_box
    from lacli.inference.runs import RunLog

    targets = read_targets(targets_file)
    frame = read_frame(path)
    if box_file:
        box = read_box(box_file)
    else:
        others = [n for n in frame.columns if n not in targets.names and not is_bookkeeping(n)]
        others = [n for n in others if error_of(n, list(frame.columns)) is None]
        known = [n for n in others if n in RANGES]
        names = known or others
        x = frame[names].apply(_number).to_numpy(float)
        import numpy as np

        still = np.ptp(x, axis=0) == 0
        names = [n for n, s in zip(names, still, strict=True) if not s]
        box = table_box(names, x[:, ~still])
    missing = [n for n in (*box.names, *targets.names) if n not in frame.columns]
    if missing:
        raise UsageError(f"{path}: no column {', '.join(missing)}; the columns are {', '.join(frame.columns)}.")
    log = RunLog(path, box.names, targets.names, None)
    given = frame[list(box.names)].to_numpy(float)
    import numpy as np

    _, first = np.unique(given, axis=0, return_index=True)
    given = given[np.sort(first)]
    identity = calibration_identity(box, targets, settings, given_runs(log, given, targets))
    folder = settle(folder, lambda place: obstacle(place, identity), fresh)
    return folder, calibrate(None, box, targets, settings, folder, log, given=given, monitor=monitor)


def _number(column: Any) -> Any:
    import pandas as pd

    from lacli.base.errors import TableError
    from lacli.contracts.tables.columns import to_numbers

    values = to_numbers(column)
    if values.isna().any():
        row = int(values.isna().to_numpy().argmax())
        cell = column.iloc[row]
        what = "is empty" if pd.isna(cell) else f"holds {cell!r}, which is not a number"
        raise TableError(f"--from-table: input {column.name}, row {row + 1} {what}. Fill it in or remove the run.")
    return values


def _truth(pairs: list[str] | None, box: Box, default: Any) -> Any:
    x = default.copy()
    for text in pairs or []:
        name, equals, value = text.partition("=")
        if not equals or name not in box.names:
            raise UsageError(f"--truth {text}: write it as name=value with a name of {', '.join(box.names)}.")
        try:
            x[box.names.index(name)] = float(value)
        except ValueError as error:
            raise UsageError(f"--truth {text}: {value!r} is not a number.") from error
    if not box.contains(x[None])[0]:
        raise UsageError("--truth: the point is outside the box.")
    return x


@contextmanager
def _dashboard() -> Iterator[Monitor]:
    """A live view on standard error: stage with time left, and a line for each wave done."""
    from rich.live import Live
    from rich.table import Table

    began: dict[tuple[str, int], tuple[float, int]] = {}

    def view(status: Status | None) -> Table:
        table = Table(title="calibration", title_justify="left", header_style="bold")
        for column in ("wave", "runs", "failed", "threshold", "NROY %", "change %", "worst R2"):
            table.add_column(column, justify="right")
        if status is None:
            return table
        for w in status.waves:
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
        now = time.monotonic()
        start, at = began.setdefault((status.stage, status.wave), (now, status.done))
        left = ""
        if status.done > at and status.total > status.done:
            seconds = (now - start) / (status.done - at) * (status.total - status.done)
            left = f", {_time(seconds)} left"
        table.caption = f"wave {status.wave}: {status.stage} {status.done}/{status.total}{left}"
        return table

    with Live(view(None), console=err, refresh_per_second=4, transient=not err.is_terminal) as live:
        yield lambda status: live.update(view(status))


def _time(seconds: float) -> str:
    minutes, s = divmod(int(seconds), 60)
    hours, m = divmod(minutes, 60)
    return f"{hours} h {m:02d} min" if hours else f"{m} min {s:02d} s"


def _finish(result: Calibration, folder: Path, figures: bool, as_json: bool, wall_s: float, targets: Targets | None) -> None:
    from lacli.calibration.calibration import document

    for note in dict.fromkeys(note for wave in result.waves for note in wave.notes):
        err.print(f"note: {note}", highlight=False, soft_wrap=True)
    superseded(folder, *FIGURES)
    pictures = _draw(result, folder, None) if figures else []
    if as_json:
        print_json({**document(result), "wall_s": wall_s, "pictures": [str(p) for p in pictures]})
    else:
        _show(result)
        out.print(
            f"Stopped because {result.stopped}; {_time(wall_s)}. Everything is in {folder}", highlight=False, soft_wrap=True
        )
    for text in result.verdict.warnings():
        err.print(f"warning: {text}", highlight=False, soft_wrap=True)
    if not result.verdict.plausible:
        raise LacliError(
            "the most probable point misses a target by more than the threshold: this is no answer. Check the targets."
        )


def _show(result: Calibration) -> None:
    from lacli.inference.sampling.posterior import learnt

    print_table(
        f"Posterior (ESS {result.chain.ess.min():.0f}, R-hat {result.chain.rhat.max():.3f}"
        + (")" if result.chain.converged else ", not converged)"),
        ["input", "most probable", "mean", "sd", "2.5 %", "97.5 %", "sd below prior's"],
        [[r["input"], r["map"], r["mean"], r["sd"], r["low95"], r["high95"], learnt(r)] for r in result.table],
    )
    print_table(
        "Fit at the most probable parameters" + (f", RMSE {result.rmse_mm:.3g} mm" if result.rmse_mm is not None else ""),
        ["feature", "target", "sd", "emulated", "simulated"],
        [[r["feature"], r["target"], r["sd"], r["emulated"], r.get("simulated", "")] for r in result.fit],
    )


def _draw(result: Calibration, folder: Path, truth: Any) -> list[Path]:
    from lacli.report.inference_figures_matching import outputs_figure, region_figure
    from lacli.report.inference_figures_posterior import corner_figure, fit_figure, trace_figure

    with err.status("drawing"):
        waves = [
            (f"wave {r.wave}", w.emulators, s.points)
            for r, w, s in zip(result.waves, result.region.waves, result.samples, strict=True)
        ]
        return [
            region_figure(result.region, folder / "region.png", sample=result.samples[-1].points, share=result.waves[-1].share),
            outputs_figure(waves, result.region.waves[-1].targets, folder / "outputs.png"),
            corner_figure(result.chain, result.map_x, result.region.box, folder / "corner.png", truth),
            trace_figure(result.chain, folder / "trace.png"),
            fit_figure(result.fit, result.draws, folder / "fit.png"),
        ]


def _show_recovery(recoveries: list[Any], box: Box, folder: Path, figures: bool, as_json: bool, wall_s: float) -> None:
    import numpy as np

    from lacli.calibration.calibration import document

    pictures: list[Path] = []
    superseded(folder, "recovery.png", *(f"{r.level}/{name}" for r in recoveries for name in FIGURES))
    if figures:
        from lacli.report.inference_figures_posterior import recovery_figure

        pictures.append(recovery_figure({r.level: r.rows for r in recoveries}, box, folder / "recovery.png"))
        for r in recoveries:
            pictures += _draw(r.calibration, folder / r.level, np.array([row["truth"] for row in r.rows]))
    if as_json:
        print_json(
            {
                "wall_s": wall_s,
                "pictures": [str(p) for p in pictures],
                "levels": {
                    r.level: {
                        "inside95": r.inside, "outside_posterior": r.outside_posterior, "inputs": r.rows,
                        **document(r.calibration),
                    } for r in recoveries
                },
            }
        )  # fmt: skip
        return
    for r in recoveries:
        print_table(
            f"{r.level}: {r.inside} of {len(r.rows)} inside their 95 % intervals, {r.outside_posterior} outside the posterior",
            ["input", "truth", "2.5 %", "97.5 %", "most probable", "|MAP - truth|", "inside"],
            [
                [q["input"], q["truth"], q["low95"], q["high95"], q["map"], q["map_error"], "yes" if q["inside95"] else "NO"]
                for q in r.rows
            ],
        )
    out.print(f"{_time(wall_s)}. Everything is in {folder}", highlight=False, soft_wrap=True)
