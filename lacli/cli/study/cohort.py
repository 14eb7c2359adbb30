"""``lacli cohort``: a whole study, patient by patient."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from lacli.api import cohort
from lacli.base.errors import LacliError, UsageError
from lacli.cli.terminal.console import err, out, print_json, print_table, stages
from lacli.cli.terminal.scenes import read_scene
from lacli.cli.terminal.tables import Json, warn


def command(
    participants: Annotated[Path, typer.Argument(help="Table of participants (CSV, Parquet), a row each; see docs/files.md.")],
    folder: Annotated[Path, typer.Option("--out", help="Folder of the study, a folder a patient in it.")] = Path("study"),
    scene: Annotated[Path | None, typer.Option(help="Scene of those who have none of their own (TOML).")] = None,
    settings: Annotated[
        Path | None, typer.Option(help="Options that all share (TOML): [mesh], [fat], [track], [calibrate], [compare], [slurm].")
    ] = None,
    only: Annotated[list[str] | None, typer.Option("--only", help="Only this participant; may be repeated.")] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Say what would be done and what it costs; run nothing.")] = False,
    scheduler: Annotated[
        str | None, typer.Option(help="Address of a Dask scheduler, whose workers take a patient each and see the same files.")
    ] = None,
    slurm: Annotated[bool, typer.Option("--slurm", help="Workers as SLURM jobs, as [slurm] of the settings says.")] = False,
    script: Annotated[Path | None, typer.Option("--write-slurm", help="Write a SLURM array script here; run nothing.")] = None,
    as_json: Json = False,
) -> None:
    """Mesh, fat, track, calibrate and compare every patient, and the study's tables; started again it goes on.

    Each step can be run by hand: --dry-run prints the calls. A patient who fails stays out, with the reason.

    Example: lacli cohort participants.csv --scene scene.toml --out study
    """
    if scene is not None:
        read_scene(scene, ["anatomy.bundle=each participant's own"])
    _check_options(settings)
    options: dict[str, Any] = {
        "scene": scene, "settings": settings, "only": only or (), "scheduler": scheduler, "slurm": slurm,
    }  # fmt: skip
    if dry_run or script is not None:
        plan = cohort.run_cohort(participants, folder, dry_run=True, script=script, **options)
        if as_json:
            print_json({"steps": [asdict(row) for row in plan.steps], "cost": plan.cost, "script": script})
            return
        print_table("Steps", ["participant", "step", "state"], [[r.participant_id, r.step, r.state] for r in plan.steps])
        for row in plan.steps if dry_run else ():
            if row.command:  # a patient whose kept results are refused has none
                out.print(row.command, highlight=False, soft_wrap=True)
        out.print(_cost_words(plan.cost), highlight=False, soft_wrap=True)
        return
    with stages() as show:
        found = cohort.run_cohort(participants, folder, progress=show, **options)
    for note in found.summary["notes"]:
        warn(note)
    if as_json:
        print_json({"patients": [asdict(o) for o in found.outcomes], "summary": found.summary})
    else:
        rows_ = [[o.participant_id, o.status, o.step, sum(o.cpu_s.values()) / 3600] for o in found.outcomes]
        print_table("Patients", ["participant", "status", "at", "CPU, h"], rows_)
        models = found.summary["models"]
        if models:
            print_table(
                "RMSE over the patients, mm",
                ["model", "patients", "mean", "sd"],
                [
                    [m["name"], m["patients"], m["rmse_mean_mm"], "-" if m["rmse_sd_mm"] is None else m["rmse_sd_mm"]]
                    for m in models
                ],
            )
        out.print(f"Tables in {folder}", highlight=False, soft_wrap=True)
    failed = [o for o in found.outcomes if o.status == "failed"]
    for o in failed:
        err.print(f"{o.participant_id}: {o.step}: {o.reason}", highlight=False, soft_wrap=True)
    if failed:
        raise LacliError(f"{len(failed)} of {len(found.outcomes)} participants failed; the others' results stand.")


def _check_options(settings: Path | None) -> None:
    """Options of the settings that no command has, and values that it refuses, are told before anything runs."""
    import typer.main

    from lacli.cli.main import build
    from lacli.cohort.steps import read_settings

    given = read_settings(settings)
    for name, table in given.options.items():
        group: Any = typer.main.get_command(build({name}))
        params = group.commands[name].params
        known = {text: p for p in params for text in (*p.opts, *p.secondary_opts)}
        for option, value in table.items():
            text = f"--no-{option}" if value is False else f"--{option}"
            if text not in known:
                raise UsageError(f"{settings}: [{name}] {option} = {value}: `lacli {name}` has no option {text}.")
            if known[text].is_flag and not isinstance(value, bool):  # the call would take the word for an argument
                raise UsageError(f"{settings}: [{name}] {option} = {value}: true or false.")
        # what each patient's call gives stands empty: the command itself is not run
        needed = [p for p in params if p.required and not any(text.removeprefix("--") in table for text in p.opts)]
        words = [word for p in needed if p.param_type_name == "option" for word in (p.opts[0], "-")]
        places = ["-" for p in needed if p.param_type_name == "argument"]
        try:
            group.commands[name].make_context(name, [*given.arguments(name), *words, "--", *places])
        except typer.BadParameter as error:
            if error.param is not None and error.param not in needed:
                raise UsageError(f"{settings}: [{name}]: {error.format_message()}") from error


def _cost_words(cost: dict[str, Any]) -> str:
    compared, further = cost["compared"], cost["compared_runs_each"]
    count = cost["calibrations"]
    if not count and not compared * further:
        return "No simulations to make."
    own = cost["reference_runs_each"]
    beside = f" and {own} of the scene's own that correct them" if own else ""
    todo = [f"{count} calibrations to do, of at most {cost['runs_each']} runs each{beside}"] * bool(count)
    todo += [f"{compared} whose models are to be compared, with at most {further} runs more each"] * bool(compared * further)
    runs = ", ".join(todo)
    each, of_own = cost["cpu_s_per_run"], cost["cpu_s_per_reference_run"]
    if each is None or (own and of_own is None):
        return f"{runs}; what a run costs is not known before the first patient's (`lacli simulate --dry-run` tells)."
    # of the runs that a comparison adds, one in four to one in two is made with the scene's own numerics too
    hours = count * (cost["runs_each"] * each + own * (of_own or 0.0)) / 3600
    hours += compared * further * (each + 0.5 * (of_own or 0.0)) / 3600
    price = f"{each:.3g} s a run" + (f" and {of_own:.3g} s one of the scene's own," if own else "")
    return f"{runs}: {hours:.3g} CPU hours at most, at {price} as in this study so far."
