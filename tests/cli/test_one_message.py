"""Every command refuses what it cannot use in one message, before anything is written: what, where, what to do."""

from __future__ import annotations

import types
from pathlib import Path

import pytest
from typer.testing import CliRunner

from lacli.base.errors import LacliError
from lacli.cli.anatomy import fat, mesh, segment, synthesize, track
from lacli.cli.commands import commands
from lacli.cli.inference import calibrate, design, emulate, match, posterior, sensitivity
from lacli.cli.main import build
from lacli.cli.mechanics import doctor, simulate, tradeoff, verify
from lacli.cli.study import cohort, compare, report, stats, study, validate

CASES: list[tuple[types.ModuleType, list[str], str]] = [
    (mesh, ["none.nrrd", "--out", "out"], "none.nrrd"),
    (mesh, ["text.nrrd", "--out", "out"], "text.nrrd"),
    (fat, ["none.nrrd", "--out", "out"], "Give the blood pool"),
    (segment, ["none.nrrd", "--labels", "none.nrrd", "--la", "1", "--out", "out.nrrd"], "none.nrrd"),
    (synthesize, ["out", "--thickness-mm", "0"], "thickness"),
    (track, ["none.nrrd", "--bundle", "la", "--out", "out"], "la: not an anatomy bundle"),
    (simulate, [], "give a SCENE"),
    (simulate, ["none.toml"], "none.toml"),
    (simulate, ["text.toml"], "text.toml"),
    (tradeoff, ["none.toml"], "none.toml"),
    (verify, ["no-such-problem"], "no-such-problem"),
    (design, ["-n", "0", "--out", "out.csv"], "-n"),
    (emulate, ["--inputs", "none.csv", "--outputs", "none.csv", "--out", "out.npz"], "none.csv"),
    (emulate, ["--out", "out.npz"], "--inputs and --outputs"),
    (match, ["--targets", "none.toml", "--emulators", "none.npz"], "none."),
    (posterior, ["--targets", "none.toml", "--emulators", "none.npz", "--out", "out"], "none."),
    (sensitivity, ["--emulators", "none.npz"], "none.npz"),
    (calibrate, ["--targets", "none.toml", "--out", "out"], "give a SCENE"),
    (calibrate, ["scene.toml", "--out", "out"], "--targets or --synthetic-truth"),
    (calibrate, ["scene.toml", "--targets", "none.toml", "--out", "out"], "none.toml"),
    (compare, ["out", "--targets", "none.toml"], "out"),
    (cohort, ["none.csv", "--out", "out"], "none.csv"),
    (report, ["none"], "none"),
    (validate, ["none", "--motion", "none", "--out", "out"], "none"),
    (study, ["weather", "--out", "out"], "weather: no such study"),
    (study, ["laplace", "none", "--out", "out"], "none"),
    (stats, ["none.csv", "--response", "d_mm"], "none.csv"),
]


def test_every_command_is_here_but_the_one_that_takes_nothing() -> None:
    assert {m.__name__.rpartition(".")[2] for m, _, _ in CASES} | {"doctor"} == set(commands())
    assert doctor.command.__doc__


@pytest.mark.parametrize(("module", "arguments", "words"), CASES, ids=lambda v: v.__name__ if hasattr(v, "__name__") else None)
def test_one_message_and_nothing_written(
    module: types.ModuleType, arguments: list[str], words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("text.nrrd", "text.toml"):
        (tmp_path / name).write_text("no such thing [\n")
    (tmp_path / "scene.toml").write_text('[anatomy]\nbundle = "la"\n')
    before = sorted(p.name for p in tmp_path.iterdir())
    name = module.__name__.rpartition(".")[2]
    assert commands()[name].module == module.__name__
    shown = CliRunner().invoke(build({name}), [name, *arguments])
    assert shown.exit_code in (1, 2)
    if isinstance(shown.exception, SystemExit):  # Typer's own words on an option
        said = shown.output
    else:
        assert isinstance(shown.exception, LacliError), shown.exception
        said = str(shown.exception)
        assert "\n" not in said.strip()
    assert words in said
    assert sorted(p.name for p in tmp_path.iterdir()) == before
