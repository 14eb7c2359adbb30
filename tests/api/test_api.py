"""The public interface: every name documented and typed, a quick import, progress told, cancellation without a trace."""

from __future__ import annotations

import ast
import importlib
import inspect
import json
import subprocess
import sys
import types
import typing
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from shapes import hollow_cube

import lacli
import lacli.types
from lacli.api import progress as api_progress
from lacli.base import arrays
from lacli.contracts.bundle import save
from lacli.contracts.identity import Identity, run_key
from lacli.contracts.tables.table import combine
from lacli.freefem.run import Progress as SolverProgress
from lacli.mechanics import simulation
from lacli.mechanics.store import open_run

PUBLIC = {name: getattr(module, name) for module in (lacli.types, lacli) for name in module.__all__ if name != "__version__"}
VERBS = [name for name, one in PUBLIC.items() if inspect.isfunction(one)]


@pytest.mark.parametrize("name", PUBLIC)
def test_every_public_name_says_what_it_is(name: str) -> None:
    first = (inspect.getdoc(PUBLIC[name]) or "").split("\n\n")[0].replace("\n", " ")
    assert first[:1].isupper()
    assert first.rstrip("`").endswith(".")


@pytest.mark.parametrize("name", ["simulate", "write_deck", "read_deck", "rerun", "emulate", "sensitivity", "match"])
def test_a_verb_names_its_errors_and_units(name: str) -> None:
    text = inspect.getdoc(PUBLIC[name]) or ""
    assert "Raises " in text
    assert "unit" in text.lower() or name == "write_deck"


def _for_types(module: types.ModuleType) -> dict[str, object]:
    """What a module imports below ``if TYPE_CHECKING``."""
    found: dict[str, object] = {}
    for branch in ast.parse(inspect.getsource(module)).body:
        if isinstance(branch, ast.If) and getattr(branch.test, "id", "") == "TYPE_CHECKING":
            for line in branch.body:
                if isinstance(line, ast.ImportFrom) and line.module:
                    home = importlib.import_module(line.module)
                    found |= {name.asname or name.name: getattr(home, name.name) for name in line.names}
    return found


@pytest.mark.parametrize("name", VERBS)
def test_every_argument_and_result_of_a_verb_is_typed(name: str) -> None:
    verb = PUBLIC[name]
    known = PUBLIC | vars(api_progress) | vars(sys.modules[verb.__module__])
    known |= _for_types(sys.modules[verb.__module__])
    hints = typing.get_type_hints(verb, globalns=known | vars(arrays) | {"Identity": Identity})
    assert set(hints) == {*inspect.signature(verb).parameters, "return"}


def test_the_import_is_light_and_names_are_found() -> None:
    heavy = "[m for m in ('numpy', 'pandas', 'pydantic', 'typer') if m in sys.modules]"
    code = f"import sys, lacli, lacli.types; print({heavy}, dir(lacli), dir(lacli.types))"
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True).stdout
    assert said.startswith("[] ")
    assert all(f"'{name}'" in said for name in PUBLIC)
    with pytest.raises(AttributeError, match="no_such"):
        lacli.no_such  # noqa: B018
    with pytest.raises(AttributeError, match=r"lacli\.types.*no_such"):
        lacli.types.no_such  # noqa: B018


@pytest.fixture
def scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> lacli.Scene:
    def run(scene: lacli.Scene, root: Path, on_progress: Callable[[Any], None] | None = None) -> Any:
        with open_run(root, run_key(scene)) as run:
            if run.stored is None:
                assert on_progress is not None
                for load in (0.25, 0.5, 1.0):
                    on_progress(SolverProgress(phase="unload", load=load))
                (run.folder / "features.json").write_text(json.dumps({"edv_ml": 80.0}), encoding="utf-8")
                run.finish()
            return types.SimpleNamespace(status="done", folder=run.stored.folder)  # type: ignore[union-attr]

    monkeypatch.setattr(simulation, "run_scene", run)
    save(hollow_cube(), tmp_path / "la")
    file = tmp_path / "scene.toml"
    file.write_text('[anatomy]\nbundle = "la"\n', encoding="utf-8")
    return lacli.types.load_scene(file)


def test_a_cancelled_simulation_leaves_nothing_and_can_be_called_again(scene: lacli.Scene, tmp_path: Path) -> None:
    store, seen = tmp_path / "runs", []
    with pytest.raises(lacli.Cancelled, match="unload"):
        lacli.simulate(scene, store=store, progress=seen.append, cancel=lambda: len(seen) >= 2)
    assert [(event.stage, event.done) for event in seen] == [("unload", 0.25), ("unload", 0.5)]
    assert [path for path in store.iterdir() if path.name != ".locks"] == []
    assert lacli.simulate(scene, store=store).status == "done"


def test_a_call_that_is_not_wanted_from_the_start_does_nothing(scene: lacli.Scene, tmp_path: Path) -> None:
    with pytest.raises(lacli.Cancelled):
        lacli.simulate(scene, store=tmp_path / "runs", cancel=lambda: True)
    assert not (tmp_path / "runs").exists()


@pytest.fixture(scope="module")
def table() -> lacli.types.RunTable:
    x = np.random.default_rng(0).uniform(1.0, 2.0, (30, 2))
    frame = pd.DataFrame(x, columns=["a", "b"])
    return combine(frame, pd.DataFrame({"y": 3.0 * x[:, 0] + 0.0 * x[:, 1] ** 2}), where="here")


def test_emulators_and_indices_of_a_table(table: lacli.types.RunTable) -> None:
    seen: list[lacli.Progress] = []
    made = lacli.emulate(table, folds=2, starts=1, progress=seen.append)
    assert [(p.stage, p.done, p.total) for p in seen] == [
        ("cross-validation", 0, 2), ("cross-validation", 1, 2), ("cross-validation", 2, 2),
        ("emulators", 0, 1), ("emulators", 1, 1)
    ]  # fmt: skip
    box = lacli.types.make_box(["a", "b"], [1.0, 1.0], [2.0, 2.0])
    found = lacli.sensitivity(made.emulators, box=box, count=256, draws=0)
    # y = 3 a: all of the variance is of a, none of b
    np.testing.assert_allclose(found.indices.st, [[1.0, 0.0]], atol=0.03)
    with pytest.raises(lacli.LacliError, match="power of two"):
        lacli.sensitivity(made.emulators, box=box, count=100)
    with pytest.raises(lacli.LacliError, match="exactly the inputs a, b"):
        lacli.sensitivity(made.emulators, box=lacli.types.make_box(["b", "a"], [1.0, 1.0], [2.0, 2.0]))


def test_a_fit_is_cancelled_between_outputs(table: lacli.types.RunTable) -> None:
    seen: list[lacli.Progress] = []
    with pytest.raises(lacli.Cancelled, match="cross-validation"):
        lacli.emulate(table, folds=2, starts=1, progress=seen.append, cancel=lambda: len(seen) == 2)
    assert len(seen) == 2


def test_matching_leaves_what_reaches_the_target(table: lacli.types.RunTable) -> None:
    emulators = lacli.emulate(table, folds=2, starts=1).emulators
    box = lacli.types.make_box(["a", "b"], [1.0, 1.0], [2.0, 2.0])
    there = lacli.Targets(("y",), np.array([4.5]), np.array([0.1]))
    found = lacli.match(emulators, there, box=box, count=500, following=4)
    # y = 3 a within 3.5 sd = 0.35 of 4.5, as in a first wave: a within 0.117 of 1.5, 0.233 of the box (the emulator's own sd
    # widens it a little)
    assert found.match.share == pytest.approx(0.233, abs=0.03)
    assert found.next_runs.shape == (4, 2)
    assert np.abs(found.match.sample.points[:, 0] - 1.5).max() < 0.14
    with pytest.raises(lacli.Cancelled):
        lacli.match(emulators, there, box=box, cancel=lambda: True)
