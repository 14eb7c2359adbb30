"""``lacli study``: questions that the method asks of itself."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lacli.api import questions
from lacli.cli.terminal.console import one_bar, out, print_json, print_table
from lacli.cli.terminal.tables import Json, warn


def command(
    question: Annotated[str, typer.Argument(help="thickness or laplace.", metavar="QUESTION")],
    run: Annotated[
        Path | None, typer.Argument(help="laplace: the folder of a run that kept its fields.", metavar="[RUN]")
    ] = None,
    thickness_mm: Annotated[
        list[float] | None, typer.Option("--thickness-mm", help="thickness: of a shell; may be repeated (1, 2, 3, 4).")
    ] = None,
    folder: Annotated[Path, typer.Option("--out", help="Folder for table (CSV, JSON) and figure (PNG, PDF, SVG).")] = Path(
        "study"
    ),
    as_json: Json = False,
) -> None:
    """Ask the method whether wall thickness matters, and whether the law of Laplace holds.

    thickness: a hemispherical shell, its edge held, of several thicknesses, uniform and with a thin patch, under pressure alone
    and on springs. laplace: p r / 2t beside a run's wall stress at end-systole, by region.

    Example: lacli study thickness --out thickness

    Example: lacli study laplace results/runs/0123456789abcdef --out laplace
    """
    with one_bar(question) as show:
        found = questions.study(question, run, thicknesses_mm=thickness_mm, out=folder, progress=show)
    (table, numbers), said = questions.rows(found), questions.notes(found)
    for words in said:
        warn(words)
    if as_json:
        print_json({**numbers, "notes": said, "rows": table})
        return
    print_table(
        question, list(table[0]), [["yes" if v is True else "no" if v is False else v for v in r.values()] for r in table]
    )
    out.print(", ".join(f"{name} {value:.3g}" for name, value in numbers.items()), highlight=False, soft_wrap=True)
    out.print(f"Table and figure in {folder}", highlight=False, soft_wrap=True)
