"""``lacli stats``: statistics over a cohort's table."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lacli.api import study
from lacli.cli.terminal.console import out, print_json, print_table
from lacli.cli.terminal.tables import Json, Seed, warn


def command(
    table: Annotated[Path, typer.Argument(help="A tidy table (CSV or Parquet): a row for each patient and region.")],
    response: Annotated[str, typer.Option(help="Column of the response, such as d_mm.")],
    predictors: Annotated[
        list[str] | None, typer.Option("--predictor", help="Column of a predictor: a mixed model for each; may be repeated.")
    ] = None,
    draws: Annotated[
        Path | None,
        typer.Option(help="Joint posterior draws of columns (patient, region, draw, columns), instead of <column>_sd."),
    ] = None,
    targets: Annotated[
        Path | None, typer.Option(help="Targets that the stiffness was calibrated to (TOML), to find what is circular.")
    ] = None,
    patient: Annotated[str, typer.Option(help="Column of the patients' identifiers.")] = "participant_id",
    region: Annotated[str, typer.Option(help="Column of the regions, or of any other factor within patients.")] = "region",
    folder: Annotated[Path, typer.Option("--out", help="Folder for tables (CSV, JSON, Markdown, LaTeX).")] = Path("statistics"),
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """Paired t-tests between regions, and mixed models with the posterior's error carried.

    A column <name>_sd beside <name> is its posterior's standard deviation. Of a response it is added to the variance, of a
    predictor it is carried by a structural errors-in-variables model; the plain model stands beside it.

    Example: lacli stats regions.csv --response d_mm --predictor thickness_mm --predictor alpha
    """
    from lacli.base.files import check_folder
    from lacli.cohort.analysis import journal

    check_folder(folder)
    found = study.stats(
        table, response, predictors or (), draws=draws, targets=targets, patient=patient, region=region, seed=seed
    )
    files = journal.write(found, folder)
    for words in found.warnings:
        warn(words)
    if as_json:
        print_json({**journal.document(found), "files": [str(file) for file in files]})
        return
    print_table(f"{response}: paired t-tests, {len(found.patients)} patients", [*journal.PAIR_HEAD], [*journal.pair_rows(found)])
    if found.associations:
        print_table(f"{response} ~ region + predictor", [*journal.SLOPE_HEAD], [*journal.slope_rows(found)])
    out.print(f"Tables in {folder}", highlight=False, soft_wrap=True)
