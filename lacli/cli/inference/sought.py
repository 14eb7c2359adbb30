"""What ``lacli calibrate`` says of the method that seeks the posterior."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lacli.base.errors import LacliError, UsageError
from lacli.cli.terminal.console import err, one_bar, out, print_json, print_table

if TYPE_CHECKING:
    from lacli.api.progress import Progress
    from lacli.calibration.calibration import Calibration
    from lacli.calibration.sequential.result import Sequential
    from lacli.contracts.scene import Scene
    from lacli.contracts.targets import Targets


def carriers(scene: Scene, said: Sequence[str] | None) -> tuple[str, ...]:
    """What `--cheap` says, of a scene: nothing said is what is usual, ``none`` nothing. Raises UsageError."""
    from lacli.calibration.sequential.fidelity.companion import usual

    if said is None:
        return usual(scene)
    if "none" in said:
        if len(said) > 1:
            raise UsageError(f"--cheap {' --cheap '.join(said)}: none goes alone.")
        return ()
    return tuple(said)


def show_forecast(scene: Scene, targets: Targets, folder: Path, as_json: bool, **options: Any) -> None:
    """What the targets can teach, as a table."""
    from lacli.api.calibration import calibrate
    from lacli.inference.sampling.posterior import learnt

    with _told() as show:
        found = calibrate(scene, targets, folder, method="sequential", forecast=True, progress=show, **options)
    rows = found.rows()
    if as_json:
        print_json({"runs": found.runs, "targets": found.targets, "inputs": rows})
        return
    print_table(
        f"What {found.targets} targets can teach, by the derivatives of {found.runs} runs over the box",
        ["input", "prior's sd", "expected sd", "least", "most", "sd below prior's"],
        [[r["input"], r["prior_sd"], r["expected_sd"], r["least_sd"], r["most_sd"], learnt(r)] for r in rows],
    )
    of = " They have the cheap numerics, and nothing corrects them yet." if options.get("cheap") else ""
    out.print(
        f"The calibration begins with these runs.{of} sds are of a linear model: a bent posterior is wider.", soft_wrap=True
    )


def seek_and_show(scene: Scene, targets: Targets, folder: Path, as_json: bool, **options: Any) -> None:
    """Calibrate, and say what came of it. Raises LacliError where the answer is none."""
    from lacli.api.calibration import calibrate
    from lacli.calibration.sequential.result import Sequential, document

    begin = time.monotonic()
    with _told() as show:
        found = calibrate(scene, targets, folder, method="sequential", progress=show, **options)
    result, wall_s = found.result, time.monotonic() - begin
    assert isinstance(result, Sequential)
    for note in result.notes:
        err.print(f"note: {note}", highlight=False, soft_wrap=True)
    if as_json:
        print_json({**document(result), "wall_s": wall_s, "pictures": [str(p) for p in found.pictures]})
    else:
        show_posterior(result)
        print_table(
            "What the targets told",
            ["group", "targets", "nats alone", "nats lost without it"],
            [[g["group"], g["targets"], g["alone_nats"], g["lost_without_nats"]] for g in result.information],
        )
        print_table("Runs", ["stage", "runs"], [[name, count] for name, count in result.stages.items()])
        out.print(
            f"chi^2 {result.misfit:.1f} for {len(result.targets.names)} targets; {result.runs} runs ({result.failed} failed), "
            f"{result.map_runs} until the most probable point. Stopped because {result.stopped}; it may still move a mean by "
            f"{result.change.max():.2f} sd. {time_of(wall_s)}. "
            f"Everything is in {found.folder}",
            highlight=False,
            soft_wrap=True,
        )
    if result.refused:
        raise LacliError(result.refused)


def show_posterior(result: Calibration | Sequential) -> None:
    """The posterior by input, as a table."""
    from lacli.inference.sampling.posterior import learnt

    print_table(
        f"Posterior (ESS {result.chain.ess.min():.0f}, R-hat {result.chain.rhat.max():.3f}"
        + (")" if result.chain.converged else ", not converged)"),
        ["input", "most probable", "mean", "sd", "2.5 %", "97.5 %", "sd below prior's"],
        [[r["input"], r["map"], r["mean"], r["sd"], r["low95"], r["high95"], learnt(r)] for r in result.table],
    )


def show_prices(scene: Scene, targets: Targets, folder: Path, as_json: bool, **options: Any) -> None:
    """What the calibration costs at most, as a table."""
    from lacli.api.calibration import calibrate

    found = calibrate(scene, targets, folder, method="sequential", dry_run=True, **options)
    if as_json:
        print_json({"simulations": [{"name": p.name, "runs": p.runs, "cpu_s": p.cpu_s, "each": vars(p.each)} for p in found]})
        return
    rows = [[p.name, p.runs, p.each.unknowns, p.each.cpu_s, p.each.peak_memory_mb, p.cpu_s] for p in found]
    print_table(
        "What the calibration costs at most",
        ["simulations", "runs", "unknowns", "CPU s each", "memory, MB", "CPU s"],
        rows,
    )
    known = all(p.each.runs for p in found)
    by = "finished runs in the store" if known else "an ordinary scene: soft walls take up to ten times as long"
    out.print(f"{sum(p.cpu_s for p in found) / 60:.0f} CPU minutes, by {by}.", highlight=False, soft_wrap=True)


@contextmanager
def _told() -> Iterator[Callable[[Progress], None]]:
    """A bar on a terminal; elsewhere (a log of SLURM's) a line for each stage with the seconds since the start."""
    if err.is_terminal:
        with one_bar("calibration") as bar:
            yield bar
        return
    begin, last = time.monotonic(), ""

    def show(event: Progress) -> None:
        nonlocal last
        if event.stage != last:
            last = event.stage
            err.print(f"{time.monotonic() - begin:6.0f} s  {event.stage}", highlight=False, soft_wrap=True)

    yield show


def time_of(seconds: float) -> str:
    """In hours and minutes, or minutes and seconds."""
    minutes, s = divmod(int(seconds), 60)
    hours, m = divmod(minutes, 60)
    return f"{hours} h {m:02d} min" if hours else f"{m} min {s:02d} s"
