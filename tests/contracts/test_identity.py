"""Whatever determines a kept thing is in its identity: any of it changed, nothing old may come back.

The determining inputs are listed from the data models themselves, so that a new field is covered the day it is written.
"""

from __future__ import annotations

import contextlib
import dataclasses
import typing
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import BaseModel

from lacli.base.errors import InputError, UsageError
from lacli.base.schema import SEAL, write_arrays
from lacli.calibration import calibration
from lacli.calibration.simulator import SceneSimulator
from lacli.contracts import identity
from lacli.contracts.identity import (
    METHODS,
    Identity,
    conflict,
    determinants,
    differences,
    identify,
    parse_identity,
    run_key,
    settle,
)
from lacli.contracts.priors import Prior
from lacli.contracts.scene import Scene, build_scene
from lacli.contracts.tables.table import RunTable
from lacli.contracts.targets import Targets
from lacli.inference.box import make_box
from lacli.inference.emulation.emulator import fit_emulators
from lacli.inference.emulation.emulator_set import EmulatorSet, emulators_identity, load_emulators, save_emulators
from lacli.inference.matching.matching import Region, Wave
from lacli.inference.runs import runs_identity
from lacli.inference.sampling import posterior as mcmc
from lacli.inference.sampling.likelihood import Density
from lacli.mechanics.numerics import accuracy

SceneOf = Callable[..., Scene]

# --- every field of a model, and another value for it -----------------------------------------------------------------

# where any other value than the default breaks a rule between fields: changes that keep the rules
TOGETHER: dict[str, dict[str, Any]] = {
    "outputs.times": {"outputs": {"times": [0.1, 0.2]}},
    "loads.transient_mmhg": {"loads": {"transient_mmhg": [[0.0, 8.0], [0.4, 20.0]]}},
    "motion.annulus": {"motion": {"annulus": "axial"}},
    "motion.annulus_off_mm": {"motion": {"annulus_off_mm": [1.0, 0.0, 0.0, 0.0, 0.0, 0.0]}},
}


def leaves(model: type[BaseModel], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted key and annotation of every field of a scene but the anatomy."""
    for name, field in model.model_fields.items():
        inner = field.annotation
        if f"{prefix}{name}" == "anatomy":
            continue
        if isinstance(inner, type) and issubclass(inner, BaseModel):
            yield from leaves(inner, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", inner


def another(annotation: Any, value: Any) -> Any:
    """A value of the same kind that is not this one."""
    if typing.get_origin(annotation) is typing.Literal:
        return next(choice for choice in typing.get_args(annotation) if choice != value)
    if isinstance(value, bool):
        return not value
    if isinstance(value, int):
        return value + 1
    if isinstance(value, float):
        return value * 0.97 if value else 0.01
    raise AssertionError(f"say in TOGETHER how to change a {annotation}")


DEFAULTS = identity.flatten(build_scene({"anatomy": {"bundle": "b"}}, [], folder=Path("/"), where="test").content())
SCENE_KEYS = {key: (annotation, DEFAULTS[key]) for key, annotation in leaves(Scene)}


def changed_scene(folder: Path, key: str) -> Scene:
    document: dict[str, Any] = {"anatomy": {"bundle": "bundle"}}
    if key in TOGETHER:
        document |= TOGETHER[key]
    else:
        *path, last = key.split(".")
        place = document
        for part in path:
            place = place.setdefault(part, {})
            if part in ("c_kpa", "alpha"):
                place |= dict.fromkeys(("anterior", "posterior", "septum", "lateral", "roof"), 1.7 if part == "c_kpa" else 1.0)
        place[last] = another(*SCENE_KEYS[key])
    return build_scene(document, [], folder=folder, where="test")


def test_the_list_of_keys_is_the_scenes() -> None:
    assert set(SCENE_KEYS) == set(DEFAULTS)
    # by hand: 5 regions of c_kpa and of alpha
    assert len([key for key in SCENE_KEYS if key.startswith(("materials.c_kpa.", "materials.alpha."))]) == 10


@pytest.mark.parametrize("key", sorted(SCENE_KEYS))
def test_any_key_of_a_scene_changed_nothing_old_comes_back(scene_of: SceneOf, tmp_path: Path, key: str) -> None:
    old, new = scene_of(), changed_scene(tmp_path, key)
    assert run_key(old) != run_key(new)
    # beside a scene's own transient no pressure is an input
    names = ("alpha_roof",) if key == "loads.transient_mmhg" else ("alpha_roof", "edp_mmhg")
    runs = [runs_identity(SceneSimulator(scene, tmp_path), names, ("esv_ml",)) for scene in (old, new)]
    set_by_the_inputs = key in ("materials.alpha.roof", "loads.edp_mmhg")
    assert (runs[0] == runs[1]) == set_by_the_inputs
    if not set_by_the_inputs:
        assert key in " ".join(differences(*runs)), "the key that differs is named"
    accuracy.record(old, {"d_roof_mm": 0.1}, old)
    same_numbers = (key.startswith("outputs.") and key != "outputs.equilibria") or key in (
        "numerics.engine",
        "numerics.timeout_s",
    )
    assert accuracy.known_errors(new) == ({"d_roof_mm": 0.1} if same_numbers else {})


WITHOUT_SCENE: dict[str, Callable[[Scene, pytest.MonkeyPatch], None]] = {
    "wall": lambda scene, patch: _write(scene, "wall.vtu", b"another"),
    "boundary": lambda scene, patch: _write(scene, "boundary.vtp", b"another"),
    "motion": lambda scene, patch: np.savez(scene.anatomy.bundle / "motion.npz", times=np.arange(3.0)),
    "scripts": lambda scene, patch: patch.setattr(identity, "solver_digest", lambda: "others"),
    "version": lambda scene, patch: patch.setattr(identity, "__version__", "99"),
    "method": lambda scene, patch: patch.setattr(identity, "METHODS", {kind: n + 1 for kind, n in METHODS.items()}),
}


def _write(scene: Scene, name: str, content: bytes) -> None:
    (scene.anatomy.bundle / name).write_bytes(content)


@pytest.mark.parametrize("what", sorted(WITHOUT_SCENE))
def test_bundle_scripts_version_and_method_count(
    scene_of: SceneOf, tmp_path: Path, what: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = scene_of()
    simulator = SceneSimulator(scene, tmp_path)
    accuracy.record(scene, {"d_roof_mm": 0.1}, scene)
    runs, key = runs_identity(simulator, ("pth",), ("esv_ml",)), run_key(scene)
    WITHOUT_SCENE[what](scene, monkeypatch)
    assert runs_identity(simulator, ("pth",), ("esv_ml",)) != runs
    assert accuracy.known_errors(scene) == {}
    assert run_key(scene) != key


def test_another_method_of_runs_is_another_run(scene_of: SceneOf, monkeypatch: pytest.MonkeyPatch) -> None:
    """The scripts do not tell which phases a scene is given: the number of the method does."""
    scene = scene_of()
    key, before, number = run_key(scene), determinants(scene), METHODS["runs"]
    monkeypatch.setitem(identity.METHODS, "runs", number + 1)
    assert run_key(scene) != key
    now = determinants(scene)
    assert {name: (before[name], now[name]) for name in now if now[name] != before[name]} == {"runs_method": (number, number + 1)}


def test_errors_measured_since_are_another_table(scene_of: SceneOf, tmp_path: Path) -> None:
    """The rows of a table carry the errors that were known when they were run."""
    simulator = SceneSimulator(scene_of(), tmp_path)
    before = runs_identity(simulator, ("pth",), ("esv_ml",))
    accuracy.record(simulator.scene, {"esv_ml": 0.5}, simulator.scene)
    assert differences(before, runs_identity(simulator, ("pth",), ("esv_ml",)))[0].startswith("discretisation_error")


# --- dataclasses: every field changed -----------------------------------------------------------------------------------


def altered(value: Any) -> Any:
    """A value of the same kind that is not this one."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        field = [f for f in dataclasses.fields(value) if f.metadata.get("determines", True)][-1]
        return dataclasses.replace(value, **{field.name: altered(getattr(value, field.name))})
    if value is None:
        return np.eye(2)  # a covariance, where there was none
    if isinstance(value, np.ndarray):
        return ~value if value.dtype == bool else value + 0.125
    if isinstance(value, tuple) and value and isinstance(value[0], str):
        return (value[0] + "_other", *value[1:])
    if isinstance(value, tuple):
        return (altered(value[0]), *value[1:]) if value else ((0, 1),)
    if isinstance(value, str):
        return "box" if value != "box" else "nroy"
    if isinstance(value, bool):
        return not value
    if isinstance(value, (int, float)):
        return value + 1 if np.isfinite(value) else 7.0
    raise AssertionError(f"no other value for {value!r}")


# what a field holds that is None or empty as a rule, and takes nothing but its own kind
_SOME = {"priors": (Prior("a", "normal", 1.0, 0.5),)}


def every_change(value: Any) -> dict[str, Any]:
    """The value with each of its fields changed that say what determines it, by the field's name."""
    return {
        field.name: dataclasses.replace(value, **{field.name: _SOME.get(field.name) or altered(getattr(value, field.name))})
        for field in dataclasses.fields(value)
        if field.init and field.metadata.get("determines", True)
    }


BOX = make_box(["a", "b"], [0.2, 0.1], [4.0, 1.0])
TARGETS = Targets(("v_ml", "d_mm"), np.array([62.0, 2.0]), np.array([0.6, 0.1]))
SETTINGS = calibration.Settings()
TABLE = RunTable(
    ("a", "b"), ("v_ml", "d_mm"), np.random.default_rng(0).random((40, 2)), np.random.default_rng(1).random((40, 2)),
    np.zeros((40, 2)), np.zeros((3, 2)), ("a note",),
)  # fmt: skip


def test_a_calibration_is_told_by_box_targets_settings_and_runs() -> None:
    runs = identify("runs", scene="one")
    base = calibration.calibration_identity(BOX, TARGETS, SETTINGS, runs)
    for name, box in every_change(BOX).items():
        assert calibration.calibration_identity(box, TARGETS, SETTINGS, runs) != base, name
    for name, targets in every_change(TARGETS).items():
        assert calibration.calibration_identity(BOX, targets, SETTINGS, runs) != base, name
    for name, settings in every_change(dataclasses.replace(SETTINGS, mcmc=mcmc.Settings())).items():
        if name != "mcmc":
            same = calibration.calibration_identity(BOX, TARGETS, settings, runs) == base
            assert same == (name in ("max_runs", "hours", "max_waves")), name
    for name, sampling in every_change(SETTINGS.mcmc).items():
        settings = dataclasses.replace(SETTINGS, mcmc=sampling)
        same = calibration.calibration_identity(BOX, TARGETS, settings, runs) == base
        assert same == (name in ("rhat", "ess", "max_steps")), name
    assert calibration.calibration_identity(BOX, TARGETS, SETTINGS, identify("runs", scene="two")) != base


def test_a_field_that_targets_get_one_day_counts() -> None:
    """A correlation, say: identities walk the fields there are."""
    wider = dataclasses.make_dataclass("Wider", [("correlation", Any, None)], bases=(Targets,), frozen=True)
    pair = [wider(("v_ml", "d_mm"), TARGETS.mean, TARGETS.sd, correlation=np.array([[1.0, r], [r, 1.0]])) for r in (0.0, 0.5)]
    one, two = (calibration.calibration_identity(BOX, targets, SETTINGS, None) for targets in pair)
    assert differences(one, two) == ["targets.correlation was [[1.0, 0.0], [0.0, 1.0]], is [[1.0, 0.5], [0.5, 1.0]]"]


def test_emulators_are_told_by_the_numbers_of_their_table() -> None:
    base = emulators_identity(TABLE, starts=1, seed=0)
    for name, table in every_change(TABLE).items():
        assert (emulators_identity(table, starts=1, seed=0) == base) == (name == "notes"), name
    assert emulators_identity(TABLE, starts=2, seed=0) != base
    assert emulators_identity(TABLE, starts=1, seed=1) != base


@pytest.fixture(scope="module")
def emulators() -> EmulatorSet:
    x = np.random.default_rng(0).uniform(BOX.lower, BOX.upper, (24, 2))
    y = np.c_[50 + 10 / x[:, 0], x[:, 0] + x[:, 1]]
    table = RunTable(BOX.names, TARGETS.names, x, y, np.zeros_like(y), np.empty((0, 2)))
    return EmulatorSet(BOX.names, tuple(fit_emulators(table, starts=1)))


def test_whatever_is_stored_of_emulators_tells_them(emulators: EmulatorSet, tmp_path: Path) -> None:
    """Each array of the file changed, and the file read again: another emulator, so another region and another chain."""
    save_emulators(tmp_path / "e.npz", emulators)
    with np.load(tmp_path / "e.npz") as stored:
        arrays = {name: stored[name] for name in stored.files if name != SEAL}
    back = load_emulators(tmp_path / "e.npz")
    assert back.content_digest() == emulators.content_digest()
    tried = 0
    for name, array in arrays.items():
        if array.dtype.kind not in "fb" or not array.size:
            continue
        other = ~array if array.dtype == bool else array * (1 - 2**-20)
        if np.array_equal(other, array):  # noise that is zero
            other = array + 2.0**-20
        write_arrays(tmp_path / "other.npz", arrays | {name: other})
        tried += 1
        with contextlib.suppress(InputError):  # refused altogether
            assert load_emulators(tmp_path / "other.npz").content_digest() != emulators.content_digest(), name
    assert tried == 2 * 9  # of two outputs: log_inputs, low, high, scales, quality, theta, u, y, noise


def test_a_region_and_a_chain_are_told_by_all_that_is_in_their_density(emulators: EmulatorSet) -> None:
    wave = Wave(emulators, TARGETS, 3.0)
    density = Density(emulators, TARGETS, Region(BOX, (wave,)))
    settings = mcmc.Settings()
    chain = mcmc.chain_identity(density, settings)
    region = identify("region", region=density.region, seed=0)
    fewer = emulators.select(emulators.outputs[:1])
    for name, other in (every_change(Targets(TARGETS.names, TARGETS.mean, TARGETS.sd))).items():
        assert mcmc.chain_identity(dataclasses.replace(density, targets=other), settings) != chain, name
    for name, box in every_change(BOX).items():
        changed = Region(box, (wave,))
        assert identify("region", region=changed, seed=0) != region, name
        assert mcmc.chain_identity(dataclasses.replace(density, region=changed), settings) != chain, name
    waves = {
        "none": (), "two": (wave, wave), "threshold": (dataclasses.replace(wave, threshold=2.9),),
        "emulators": (dataclasses.replace(wave, emulators=fewer),),
        "targets": (dataclasses.replace(wave, targets=altered(TARGETS)),),
    }  # fmt: skip
    assert set(waves) >= {field.name for field in dataclasses.fields(Wave)}, "a field of a wave that is not tried"
    for name, some in waves.items():
        assert identify("region", region=Region(BOX, some), seed=0) != region, name
        assert mcmc.chain_identity(dataclasses.replace(density, region=Region(BOX, some)), settings) != chain, name
    assert mcmc.chain_identity(dataclasses.replace(density, emulators=fewer), settings) != chain
    for name, other in every_change(dataclasses.replace(settings, walkers=20)).items():
        same = mcmc.chain_identity(density, other) == mcmc.chain_identity(density, dataclasses.replace(settings, walkers=20))
        assert same == (name in ("rhat", "ess", "max_steps")), name


@pytest.mark.parametrize("kind", sorted(METHODS))
def test_another_method_or_version_is_another_thing(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    before = identify(kind, made_from=1)
    number = METHODS[kind]
    monkeypatch.setitem(identity.METHODS, kind, number + 1)
    assert differences(before, identify(kind, made_from=1)) == [f"method was {number}, is {number + 1}"]
    monkeypatch.setattr(identity, "__version__", "99")
    assert any(words.startswith("lacli was ") for words in differences(before, identify(kind, made_from=1)))


# --- the identity itself ------------------------------------------------------------------------------------------------

VALUES = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**40), 2**40) | st.floats(allow_nan=False) | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(min_size=1, max_size=6), inner, max_size=3),
    max_leaves=8,
)


@given(st.dictionaries(st.text(min_size=1, max_size=6), VALUES, max_size=5))
def test_written_and_read_it_is_the_same(parts: dict[str, Any]) -> None:
    one = Identity("runs", identity.flatten(parts))
    assert parse_identity(one.text()) == one
    assert differences(one, parse_identity(one.text()) or one) == []
    assert conflict(one, one, "runs") == ""


@given(st.dictionaries(st.sampled_from("abcd"), st.integers(0, 3), max_size=4), st.sampled_from("abcd"), st.integers(4, 9))
def test_any_value_changed_is_named_with_old_and_new(parts: dict[str, Any], key: str, new: int) -> None:
    one, two = Identity("runs", parts), Identity("runs", parts | {key: new})
    assert one != two
    assert differences(one, two) == [f"{key} was {parts.get(key, 'nothing')}, is {new}"]


@pytest.mark.parametrize("spoilt", ["", "{", "[]", "null", '{"kind": "runs"}', "[" * 10_000, "edited"])
def test_an_identity_that_was_edited_or_damaged_is_none(spoilt: str, tmp_path: Path) -> None:
    one = Identity("runs", {"a": 1})
    text = one.text().replace('"a": 1', '"a": 2') if spoilt == "edited" else spoilt
    (tmp_path / "i.json").write_text(text)
    assert identity.read_identity(tmp_path / "i.json") is None
    assert "does not say what it was made from" in conflict(None, one, "runs")


def test_what_cannot_tell_itself_is_a_bug_not_a_guess() -> None:
    with pytest.raises(TypeError, match="object does not say what determines it"):
        identify("runs", thing=object())


def test_a_long_list_of_differences_is_cut_and_counted() -> None:
    words = conflict(Identity("runs", {}), Identity("runs", {f"k{i}": i for i in range(9)}), "runs")
    assert words.count(" was nothing, is ") == 6 and words.endswith("; and 3 more")


@pytest.mark.parametrize("table", [True, False])
def test_where_work_goes(tmp_path: Path, table: bool) -> None:
    """Free, the same, or in the way; --fresh takes the first place that is free or holds the same, again and again."""
    out = tmp_path / ("runs.csv" if table else "patient.1")
    first, second = (tmp_path / f"runs_fresh_{n}" / "runs.csv" if table else out / f"fresh_{n}" for n in (1, 2))
    taken: dict[Path, str] = {}
    assert settle(out, lambda place: taken.get(place, ""), fresh=True, table=table) == out
    taken[out] = "holds runs of another scene"
    with pytest.raises(UsageError, match=r"holds runs of another scene\. Choose another --out, or give --fresh .*fresh_1"):
        settle(out, lambda place: taken.get(place, ""), fresh=False, table=table)
    assert settle(out, lambda place: taken.get(place, ""), fresh=True, table=table) == first
    taken[first] = "holds runs of a third"
    assert settle(out, lambda place: taken.get(place, ""), fresh=True, table=table) == second
    assert list(tmp_path.iterdir()) == []
