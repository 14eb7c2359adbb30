"""An option that would do nothing in the mode called is refused with both their names, before anything is read or written."""

from __future__ import annotations

from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from lacli.base.errors import UsageError
from lacli.cli.main import build
from lacli.cli.terminal.modes import refuse

# neither scene nor tables are there: what comes to read them has not refused
WITH_TABLE, TRUTH = "calibrate --from-table runs.csv --targets t.toml", "calibrate scene.toml --synthetic-truth"
FIELDS = "track frames --bundle la --motion fields --error-mm 0.3,0.6"
IGNORED: list[tuple[str, tuple[str, ...], str]] = [
    (
        WITH_TABLE,
        (
            *("scene.toml", "--set a=1", "--store s", "--workers 2", "--scheduler tcp://a", "--warm", "--retry"),
            *("--no-sensitivities", "--no-discretisation-error", "--no-infer-errors", "--first-runs 20", "--wave-runs 5"),
            *("--max-waves 2", "--max-runs 90", "--hours 1", "--cheap order=1", "--reference-runs 5"),
        ),
        "with --from-table",
    ),
    (TRUTH, ("--warm", "--no-sensitivities", "--no-discretisation-error", "--no-infer-errors"), "with --synthetic-truth"),
    ("calibrate scene.toml --targets t.toml", ("--truth alpha_roof=2",), "without --synthetic-truth"),
    ("calibrate scene.toml --targets t.toml --dry-run", ("--forecast",), "with --dry-run"),
    (
        "calibrate scene.toml --targets t.toml --method published",
        ("--no-infer-errors", "--infer-errors"),
        "by the published method",
    ),
    *(
        (
            f"simulate {option} there",
            ("--set a=1", "--equilibria", "--dry-run", "--out runs", "--write deck", "--no-figures"),
            f"with {option}",
        )
        for option in ("--rerun", "--read")
    ),
    ("simulate scene.toml --write deck", ("--dry-run", "--out runs", "--no-figures"), "with --write"),
    (
        FIELDS,
        ("--harmonics 2", "--known-motions 3", "--work-mm 0.9", "--engine demons", "--workers 2", "--label 2"),
        "with --motion fields",
    ),
    (FIELDS.replace("fields", "labels"), ("--axes ras", "--harmonics 2"), "with --motion labels"),
    ("track frames --bundle la", ("--axes ras", "--label 2"), "with --motion images"),
    ("track frames --bundle la --published", ("--at 0.2,0.3",), "with --published"),
    (
        "tradeoff scene.toml --for calibration --targets t.toml",
        ("--record", "--no-record", "--tolerance-mm 0.3"),
        "with --for calibration",
    ),
    ("tradeoff scene.toml", ("--box box.toml", "--tolerance-sd 0.25"), "without --for calibration"),
    (
        "design",
        ("scene.toml", "--store s", "--workers 2", "--scheduler tcp://a", "--no-sensitivities", "--warm", "--retry"),
        "without --run",
    ),
    ("design --box box.toml", ("--input alpha_roof", "--all-inputs"), "with --box"),
    ("design --input alpha_roof", ("--all-inputs",), "with --input"),
    (
        "synthesize out",
        (
            *("--noise-hu 25", "--blur 0.6", "--heart-rate 65", "--motion-blur 0.1", "--contrast-drift-hu 5"),
            *("--parameter edp_mmhg=7",),
        ),
        "without --gated",
    ),
    ("synthesize out --gated", ("--image",), "with --gated"),
    ("synthesize out", ("--voxel-mm 1",), "without --image or --gated"),
    ("synthesize out --cohort 2", ("--targets motion",), "without --arm"),
    ("match --emulators e.npz --targets t.toml", ("--earlier-threshold 3",), "without --earlier"),
]


@pytest.mark.parametrize(
    ("call", "option", "mode"),
    [(call, option, mode) for call, options, mode in IGNORED for option in options],
)
def test_an_option_that_would_do_nothing_is_refused(
    call: str, option: str, mode: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    words = [*call.split(), *option.split()]
    shown = CliRunner().invoke(build({words[0]}), words)
    assert isinstance(shown.exception, UsageError) and shown.exception.exit_code == 2, shown.output
    said = str(shown.exception)
    name = "SCENE" if option == "scene.toml" else option.split()[0]
    assert name in said and mode in said and "\n" not in said
    assert "would do nothing" in said
    assert not list(tmp_path.iterdir())


def test_what_is_not_said_is_not_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each call without the option comes farther: to its first file."""
    monkeypatch.chdir(tmp_path)
    for call in dict.fromkeys(call for call, _, _ in IGNORED):
        words = call.split()
        if words[0] not in ("design", "synthesize"):  # these need no file
            shown = CliRunner().invoke(build({words[0]}), words)
            assert shown.exception is not None and "would do nothing" not in str(shown.exception), call


def test_several_are_named_together_as_the_call_names_them() -> None:
    app = typer.Typer()

    @app.command()
    def command(ctx: typer.Context, count: int = 3, figures: bool = True, warm: bool = False) -> None:
        del count, figures, warm
        refuse(ctx, "today", "--count", "--figures", "--warm")

    def said(*words: str) -> str:
        return str(CliRunner().invoke(app, list(words)).exception or "")

    assert said() == ""
    assert said("--count", "3") == "--count would do nothing today; leave it out."
    assert said("--no-figures", "--warm") == "--no-figures, --warm would do nothing today; leave them out."
