"""The public interface stays one: names documented with shapes, units, errors; strictly typed; one verb behind each command."""

from __future__ import annotations

import ast
import dataclasses
import importlib.util
import inspect
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

import lacli
import lacli.types
from lacli.cli.commands import Command, commands

NAMES = [name for name in lacli.__all__ if name != "__version__"]
PUBLIC = {name: getattr(lacli.types, name) for name in lacli.types.__all__} | {name: getattr(lacli, name) for name in NAMES}
VERBS = [name for name, one in PUBLIC.items() if inspect.isfunction(one) and one.__module__.startswith("lacli.api")]
UNITS = re.compile(r"\b(mm|mL|kPa|MB|seconds|units?|share|HU)\b|mmHg", re.IGNORECASE)
SHAPES = re.compile(r"\((?:\w+, )*\w+,?\)")
# commands whose options are deeds of their own: what else they may call
MORE = {"simulate": {"write_deck", "read_deck", "rerun"}}
UNITLESS = {"write_deck", "write_report"}  # they give no quantity
NAMED = {"report": "write_report", "cohort": "run_cohort"}  # lacli.report and lacli.cohort are packages


def test_each_command_has_a_verb_and_besides_them_there_are_but_the_types_that_every_call_meets() -> None:
    verbs = {name for name in NAMES if inspect.isfunction(getattr(lacli, name))}
    assert verbs == {NAMED.get(name, name) for name in commands()}
    assert set(NAMES) - verbs == {"Box", "Cancelled", "LacliError", "Progress", "Scene", "Targets"}


@pytest.mark.parametrize("module", [lacli, lacli.types])
def test_names_are_in_order_and_found_once(module: ModuleType) -> None:
    names = [name for name in module.__all__ if name != "__version__"]
    assert sorted(names, key=lambda name: (not name[0].isupper(), name)) == names
    assert not set(lacli.__all__) & set(lacli.types.__all__)
    text = Path(module.__file__ or "").read_text(encoding="utf-8")
    typed = {alias.asname or alias.name for branch in ast.parse(text).body if isinstance(branch, ast.If)
             for line in branch.body if isinstance(line, ast.ImportFrom) for alias in line.names}  # fmt: skip
    assert typed == set(names), "what a type checker sees"


@pytest.mark.parametrize("name", VERBS)
def test_a_verb_says_what_it_gives_with_units_and_errors(name: str) -> None:
    verb = PUBLIC[name]
    text = inspect.getdoc(verb) or ""
    raised = re.search(r"Raises (.+)", text, re.DOTALL)
    assert raised, f"{name}: which errors?"
    named = re.findall(r"[A-Z]\w+(?:Error|Left)|Cancelled|LacliError", raised[1])
    assert named
    assert "cancel" not in inspect.signature(verb).parameters or "Cancelled" in named
    assert UNITS.search(text) or name in UNITLESS, f"{name}: which units?"


@pytest.mark.parametrize("name", VERBS)
def test_a_verb_explains_its_arguments_and_tells_its_progress(name: str) -> None:
    verb = PUBLIC[name]
    given = dict(inspect.signature(verb).parameters)
    brief = {"write_deck", "read_deck", "stats", "write_report", "validate"}  # seconds
    assert {"progress", "cancel"} <= set(given) or name in brief
    assert all(p.kind is p.KEYWORD_ONLY for word, p in given.items() if word in ("progress", "cancel"))


@pytest.mark.parametrize("name", [name for name, one in PUBLIC.items() if inspect.isclass(one)])
def test_a_type_says_what_its_arrays_are(name: str) -> None:
    one = PUBLIC[name]
    text = (inspect.getdoc(one) or "") + "".join(
        inspect.getdoc(member) or "" for _, member in inspect.getmembers(one, inspect.isfunction)
    )
    assert (inspect.getdoc(one) or "")[:1].isupper()
    if dataclasses.is_dataclass(one) and any("FloatArray" in str(field.type) for field in dataclasses.fields(one)):
        assert SHAPES.search(text), f"{name}: which shapes?"


def _tree(one: Command) -> ast.Module:
    found = importlib.util.find_spec(one.module)
    assert found is not None and found.origin is not None
    return ast.parse(Path(found.origin).read_text(encoding="utf-8"))


def _verbs_called(tree: ast.Module) -> list[str]:
    """Verbs that a module calls through a module or a name of ``lacli.api``, once for each call."""
    homes: set[str] = set()
    direct: dict[str, str] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module == "lacli.api":
            homes |= {alias.asname or alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and node.module.startswith(("lacli.api.", "lacli")):
            direct |= {alias.asname or alias.name: alias.name for alias in node.names if node.module != "lacli.api"}
    called = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            f = node.func
            if isinstance(f, ast.Attribute) and isinstance(f.value, ast.Name) and f.value.id in homes and f.attr in VERBS:
                called.append(f.attr)
            elif isinstance(f, ast.Name) and direct.get(f.id) in VERBS:
                called.append(direct[f.id])
    return called


@pytest.mark.parametrize("name", list(commands()))
def test_a_command_calls_one_verb_and_it_is_its_own(name: str) -> None:
    called = _verbs_called(_tree(commands()[name]))
    assert set(called) == {NAMED.get(name, name)} | MORE.get(name, set())


@pytest.mark.parametrize(("text", "found"), [
    ("from lacli.api import anatomy\nanatomy.mesh(1)\nanatomy.check()", ["mesh"]),
    ("from lacli.api import design as api\napi.design(1)\napi.design(2)", ["design", "design"]),
    ("from lacli.api.anatomy import fat as f\nf(1)", ["fat"]),
    ("from lacli.inference.design import points\npoints(1)", []),
])  # fmt: skip
def test_calls_are_seen_however_they_are_imported(text: str, found: list[str]) -> None:
    assert _verbs_called(ast.parse(text)) == found


def test_a_strict_user_script_has_no_type_error(tmp_path: Path) -> None:
    if importlib.util.find_spec("mypy") is None:
        pytest.skip("needs mypy: pip install '.[test]'")
    script = tmp_path / "study.py"
    script.write_text(
        '''"""A study, strictly typed."""

from pathlib import Path

import lacli
import lacli.types


def say(event: lacli.Progress) -> None:
    print(event.stage, event.done / event.total, event.left_s)


def study(folder: Path) -> float:
    (atrium,) = lacli.synthesize(folder / "la", seed=3, cell_size_mm=8.0, order=1, progress=say)
    scene = lacli.types.load_scene(folder / "scene.toml", ["loads.edp_mmhg=8"])
    result: lacli.types.RunResult = lacli.simulate(scene, store=folder / "runs", progress=say, cancel=lambda: False)
    box = lacli.types.make_box(["alpha_roof"], [0.5], [2.0])
    made = lacli.design(folder / "runs.csv", scene=scene, box=box, count=8, progress=say)
    table = lacli.types.read_runs(made.table, made.table)
    emulators = lacli.emulate(table, box=box).emulators
    targets = lacli.types.read_targets(folder / "targets.toml")
    answer = lacli.posterior(emulators, targets, folder / "posterior", box=box, settings=lacli.types.SamplingSettings(ess=100))
    if answer.refused:
        raise lacli.LacliError(answer.refused)
    return float(answer.best[0]) + float(result.features["esv_ml"]) + len(atrium.report)
''',
        encoding="utf-8",
    )
    cache = Path(__file__).parents[2] / ".mypy_cache"
    call = [sys.executable, "-m", "mypy", "--strict", "--follow-imports=silent", "--cache-dir", str(cache / "user"), str(script)]
    done = subprocess.run(call, capture_output=True, text=True, timeout=300, check=False, cwd=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    script.write_text(script.read_text(encoding="utf-8").replace("seed=3", 'seed="three"'), encoding="utf-8")
    done = subprocess.run(call, capture_output=True, text=True, timeout=300, check=False, cwd=tmp_path)
    assert done.returncode == 1 and "seed" in done.stdout
