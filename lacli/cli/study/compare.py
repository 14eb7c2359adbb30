"""``lacli compare``: which model of one patient the targets prefer."""

from __future__ import annotations

import math
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from lacli.api import study
from lacli.base.errors import UsageError
from lacli.cli.terminal.console import out, print_json, print_table, stages
from lacli.cli.terminal.tables import Json, Scheduler, Seed, Workers, warn

FILE = "comparison.json"


def command(
    patient: Annotated[Path, typer.Argument(help="Folder of a finished calibration (--out of calibrate).")],
    targets: Annotated[Path, typer.Option(help="The targets that it was calibrated to (TOML).")],
    tied: Annotated[
        list[str] | None,
        typer.Option("--tie", metavar="A=B", help="A model where these inputs are one number (A=B=C); may be repeated."),
    ] = None,
    others: Annotated[
        list[str] | None,
        typer.Option("--other", metavar="NAME=FOLDER", help="A calibration on another anatomy, such as uniform thickness."),
    ] = None,
    particles: Annotated[int, typer.Option(min=100, help="Particles of the sampler; more are more exact.")] = 600,
    max_runs: Annotated[
        int | None,
        typer.Option(min=0, help="Runs at most, for each calibration, where a model is likely and it made none (default: 16)."),
    ] = None,
    workers: Workers = None,
    scheduler: Scheduler = None,
    file: Annotated[
        Path | None, typer.Option("--out", help="The comparison as JSON (default: comparison.json in the patient's folder).")
    ] = None,
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """Regional against global stiffness, tied inputs, other anatomies: evidence, PSIS-LOO and misfit, with their errors.

    "pooled" lets the regions vary about a common level by as much as the targets ask for: against "global" it tells whether
    they differ at all. The models share the calibration's emulators; a few runs more are made where a model is likely and the
    calibration, which sought its own posterior, made none.

    Example: lacli compare patient_1 --targets targets.toml --other uniform=patient_1_uniform
    """
    from lacli.base.files import check_file, write_json

    groups = [text.split("=") for text in tied or ()]
    if any(len(group) < 2 or not all(group) for group in groups):
        raise UsageError("--tie: write inputs that are one number as A=B.")
    named = dict(_pair(text) for text in others or ())
    if len(named) < len(others or ()):
        raise UsageError("--other: a name stands twice.")
    target = file or patient / FILE
    if not patient.is_dir():
        raise UsageError(f"{patient}: no such folder.")
    check_file(target)
    with stages() as show:
        found = study.compare(
            patient, targets, tied=groups, others=named, particles=particles, seed=seed, max_runs=max_runs, workers=workers,
            scheduler=scheduler, progress=show,
        )  # fmt: skip
    document = asdict(found)
    for fit in document["fits"]:
        fit |= {key: None for key, value in fit.items() if isinstance(value, float) and not math.isfinite(value)}
    write_json(target, document)
    for words in found.warnings:
        warn(words)
    if as_json:
        print_json(document)
        return
    print_table(
        "Models",
        ["model", "inputs", "log evidence", "± se", "± emulators", "elpd (PSIS-LOO)", "± se", "p_loo", "worst k", "RMSE, mm",
         "mean ± sd"],
        [
            [f.name, f.free, f.log_evidence, f.log_evidence_se, f.emulator_se, f.elpd, f.elpd_se, f.p_loo, f.worst_k, f.rmse_mm,
             f"{f.rmse_mean_mm:.3g} ± {f.rmse_sd_mm:.2g}"]
            for f in found.fits
        ],
    )  # fmt: skip
    if found.runs:
        beside = f" and {found.reference_runs} of the scene's own" if found.reference_runs else ""
        out.print(f"{found.runs} runs{beside} were made where models are likely.", highlight=False)
    for c in found.contrasts:
        out.print(
            f"{c.model} - {c.against}: log evidence {c.difference:+.2f} ± {c.se:.2f}: {c.verdict}.",
            highlight=False,
            soft_wrap=True,
        )


def _pair(text: str) -> tuple[str, Path]:
    name, equals, folder = text.partition("=")
    if not (name and equals and folder):
        raise UsageError(f"--other {text}: write it as NAME=FOLDER.")
    return name, Path(folder)
