"""Statistics as files: CSV and JSON to compute with, Markdown and LaTeX as a journal prints them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from lacli.base.files import replacing, write_json, write_text
from lacli.cohort.analysis.statistics import Statistics

FILES = ("pairs.csv", "models.csv", "statistics.json", "tables.md", "tables.tex")
_STARS = "* p < .05, ** < .01, *** < .001, Bonferroni"


def document(found: Statistics) -> dict[str, Any]:
    """The statistics as a JSON document; what is not finite is null."""
    plain: dict[str, Any] = _finite(asdict(found))
    return plain


def write(found: Statistics, folder: Path) -> list[Path]:
    """The five files of ``FILES`` in the folder. Raises StorageError."""
    import pandas as pd

    folder.mkdir(parents=True, exist_ok=True)
    for name, rows in ((FILES[0], [{**asdict(p), "stars": p.stars} for p in found.pairs]), (FILES[1], models(found))):
        with replacing(folder / name) as temporary:
            pd.DataFrame(rows).to_csv(temporary, index=False)
    write_json(folder / FILES[2], document(found))
    titled = _tables(found)
    write_text(folder / FILES[3], "\n\n".join(_markdown(*table) for table in titled) + "\n")
    write_text(folder / FILES[4], "\n\n".join(_latex(*table) for table in titled) + "\n")
    return [folder / name for name in FILES]


def models(found: Statistics) -> list[dict[str, Any]]:
    """A row for each coefficient of each plain model, and for each carried slope."""
    rows: list[dict[str, Any]] = []
    for a in found.associations:
        head = {"response": a.response, "predictor": a.predictor}
        for c in a.plain.coefficients:
            row = {"method": a.plain.method, "term": c.term, "estimate": c.estimate, "se": c.se, "statistic": c.statistic}
            row["df"] = c.df if math.isfinite(c.df) else math.nan
            rows.append({**head, **row, "p": c.p, "low95": c.low, "high95": c.high, "intercept_sd": a.plain.intercept_sd})
        rows += [
            {**head, "method": c.method, "term": a.predictor, "estimate": c.estimate, "df": c.df, "p": c.p, "low95": c.low,
             "high95": c.high, "reliability": c.reliability}
            for c in a.carried
        ]  # fmt: skip
    return rows


def p_words(p: float) -> str:
    """A p as journals print it: .023, <.001, - where undefined."""
    if math.isnan(p):
        return "-"
    return "<.001" if p < 0.001 else f"{p:.3f}".lstrip("0") if p < 0.9995 else "1"


def pair_rows(found: Statistics) -> list[list[str]]:
    """Pairs, difference ± sd, t (df), p, Bonferroni with stars, Holm."""
    return [
        [f"{t.first} - {t.second}", f"{t.difference:.3g} ± {t.sd:.2g}", f"{t.t:.2f} ({t.df})", p_words(t.p),
         f"{p_words(t.bonferroni)}{t.stars}", p_words(t.holm)]
        for t in found.pairs
    ]  # fmt: skip


def slope_rows(found: Statistics) -> list[list[str]]:
    """Each association's slope: plain, then carried."""
    rows = []
    for a in found.associations:
        c = a.plain.of(a.predictor)
        rows.append([a.predictor, a.plain.method, f"{c.estimate:.3g}", f"{c.low:.3g} to {c.high:.3g}", p_words(c.p)])
        rows += [[a.predictor, k.method, f"{k.estimate:.3g}", f"{k.low:.3g} to {k.high:.3g}", p_words(k.p)] for k in a.carried]
    return rows


def model_rows(found: Statistics) -> list[list[str]]:
    """Every coefficient of the plain mixed models: estimate, se, z (t of least squares), p, interval; intercepts' variance."""
    rows = []
    for a in found.associations:
        for c in a.plain.coefficients:
            rows.append([a.predictor, c.term, f"{c.estimate:.3g}", f"{c.se:.2g}", f"{c.statistic:.2f}", p_words(c.p),
                         f"{c.low:.3g} to {c.high:.3g}"])  # fmt: skip
        rows.append([a.predictor, "variance of the random intercept", f"{a.plain.intercept_sd**2:.3g}", *["-"] * 4])
    return rows


MODEL_HEAD = ("predictor", "term", "estimate", "se", "z or t", "p", "95 % interval")
PAIR_HEAD = ("pair", "difference ± sd", "t (df)", "p", "Bonferroni", "Holm")
SLOPE_HEAD = ("predictor", "method", "slope", "95 % interval", "p")


def _tables(found: Statistics) -> list[tuple[str, Sequence[str], list[list[str]]]]:
    n = len(found.patients)
    tables: list[tuple[str, Sequence[str], list[list[str]]]] = [
        (f"{found.response}: paired t-tests between regions, {n} patients ({_STARS}).", PAIR_HEAD, pair_rows(found))
    ]  # fmt: skip
    if found.associations:
        title = f"{found.response} ~ region + predictor, random intercept a patient, {n} patients, {len(found.regions)} regions."
        tables.append((title, SLOPE_HEAD, slope_rows(found)))
    return tables


def _markdown(title: str, head: Sequence[str], rows: list[list[str]]) -> str:
    # a star or a bar in a cell is text, no mark
    lines = [list(head), ["---"] * len(head), *[[c.replace("|", "\\|").replace("*", "\\*") for c in row] for row in rows]]
    return "\n".join([title.replace("*", "\\*"), "", *("| " + " | ".join(row) + " |" for row in lines)])


_LATEX = {"\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_", "{": r"\{", "}": r"\}",
          "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "±": r"$\pm$", "<": "$<$", ">": "$>$"}  # fmt: skip


def _latex(title: str, head: Sequence[str], rows: list[list[str]]) -> str:
    def line(cells: Sequence[str]) -> str:
        return " & ".join("".join(_LATEX.get(letter, letter) for letter in cell) for cell in cells) + r" \\"

    caption = "".join(_LATEX.get(letter, letter) for letter in title)
    body = [r"\hline", line(head), r"\hline", *map(line, rows), r"\hline"]
    begin = [r"\begin{table}", rf"\caption{{{caption}}}", rf"\begin{{tabular}}{{l{'r' * (len(head) - 1)}}}"]
    return "\n".join([*begin, *body, r"\end{tabular}", r"\end{table}"])


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(v) for key, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
