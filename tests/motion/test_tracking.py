"""Registered frames: kept by their content, a cycle that closes, engines that find a known shift."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from lacli.anatomy.inputs import image as images
from lacli.anatomy.inputs.image import Image
from lacli.base.errors import LacliError
from lacli.motion import registration, tracking
from lacli.motion.field import Field
from lacli.motion.registration import ENGINES, Registered, register_apart
from lacli.motion.tracking import Pair, displacement_of, register_all


def ball(shift: float = 0.0, size: int = 24) -> Image:
    """A bright ball of 14 mm with texture in a dark box of 2 mm voxels, shifted along i."""
    k, j, i = np.meshgrid(*[(np.arange(size) - (size - 1) / 2) * 2.0] * 3, indexing="ij")
    i = i - shift
    away = np.sqrt(i**2 + j**2 + k**2)
    values = 300.0 / (1.0 + np.exp((away - 14.0) / 1.0)) + 40.0 * np.sin(i / 3.0) * np.cos(j / 4.0) * (away < 14.0)
    return Image(values.astype(np.float32), np.full(3, 2.0), np.full(3, -(size - 1.0)), np.eye(3))


def uniform(u: tuple[float, float, float]) -> Field:
    grid = ball()
    return Field(np.full((*grid.array.shape, 3), u, dtype=np.float32), grid.spacing, grid.origin, grid.direction)


@pytest.mark.parametrize("engine", ["greedy", "demons"])
def test_an_engine_finds_a_known_shift(engine: str, tmp_path: Path) -> None:
    if engine == "greedy":
        pytest.importorskip("picsl_greedy", reason="the engine greedy is not installed")
    for name, moved in (("fixed", 0.0), ("moving", 3.0)):
        images.write(ball(moved), tmp_path / f"{name}.nrrd")
    found = register_apart(engine, tmp_path / "fixed.nrrd", tmp_path / "moving.nrrd", tmp_path / "field.nrrd")
    at = 10.0 * np.random.default_rng(3).normal(size=(60, 3)) / 2.0
    u = found.field.at(at)
    # x of end-diastole is at x + u: the ball went 3 mm along i
    assert u.mean(axis=0) == pytest.approx([3.0, 0.0, 0.0], abs=0.5)
    assert found.cpu_s > 0 and found.peak_memory_mb > 20
    assert sorted(p.name for p in tmp_path.iterdir()) == ["field.nrrd", "fixed.nrrd", "moving.nrrd"]


def test_an_engine_that_fails_says_its_last_words(tmp_path: Path) -> None:
    (tmp_path / "a.nrrd").write_text("no image")
    with pytest.raises(LacliError):
        register_apart("demons", tmp_path / "a.nrrd", tmp_path / "a.nrrd", tmp_path / "field.nrrd")
    assert not (tmp_path / "field.nrrd").exists()


def test_a_field_is_found_by_everything_that_determines_it() -> None:
    pair = Pair("frame 2", ball(), ball(1.0))
    first = pair.digest("greedy")
    assert first == Pair("other name", ball(), ball(1.0)).digest("greedy")
    changed = [pair.digest("demons"), Pair("x", pair.moving, pair.fixed).digest("greedy")]
    for field in ("spacing", "origin", "direction"):
        value = getattr(pair.moving, field).copy()
        value.ravel()[0] += 1e-9
        changed.append(dataclasses.replace(pair, moving=dataclasses.replace(pair.moving, **{field: value})).digest("greedy"))
    voxel = pair.moving.array.copy()
    voxel[3, 4, 5] += 1e-3
    changed.append(dataclasses.replace(pair, moving=dataclasses.replace(pair.moving, array=voxel)).digest("greedy"))
    assert len({first, *changed}) == len(changed) + 1


def test_what_was_registered_is_not_registered_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[str] = []

    def register(engine: str, fixed: Path, moving: Path, out: Path) -> Registered:
        made.append(out.name)
        if len(made) == 2:
            raise LacliError("it broke")
        from lacli.motion.field import write_field

        write_field(uniform((1.0, 2.0, 3.0)), out)
        return Registered(uniform((1.0, 2.0, 3.0)), 5.0, 100.0)

    monkeypatch.setattr(tracking, "register_apart", register)
    pairs = [Pair(f"frame {k}", ball(), ball(float(k))) for k in (1, 2)]
    heard: list[tuple[str, int, int]] = []
    with pytest.raises(LacliError, match="frame 2: it broke"):
        register_all(pairs, "greedy", tmp_path, 1, lambda *words: heard.append(words), "tracking")
    run = register_all(pairs, "greedy", tmp_path, 1, lambda *words: heard.append(words), "tracking")
    assert (run.kept, run.cpu_s, run.peak_memory_mb) == (1, 5.0, 100.0)
    assert len(made) == 3 and heard[-1] == ("tracking", 2, 2)
    assert run.fields[0].at(np.zeros((1, 3)))[0] == pytest.approx([1.0, 2.0, 3.0])
    assert not [p for p in tmp_path.iterdir() if p.name.startswith(".part")]
    kept = next(p for p in tmp_path.iterdir() if p.suffix == ".nrrd")
    kept.write_bytes(b"damaged")
    assert register_all(pairs, "greedy", tmp_path, 2, lambda *words: None, "tracking").kept == 1


def test_what_is_left_at_the_cycle_s_end_is_spread_over_it() -> None:
    fields = [uniform((2.0, 0.0, 0.0)), uniform((0.4, 0.0, 0.0))]
    points = np.zeros((3, 3))
    times, moved, closure = displacement_of(fields, np.array([0.0, 0.5, 1.0]), points)
    assert times.tolist() == [0.0, 0.5] and closure == pytest.approx(0.4)
    assert moved[1, 0] == pytest.approx([2.0 - 0.5 * 0.4, 0.0, 0.0])
    times, moved, closure = displacement_of(fields, np.array([0.0, 0.4, 0.8]), points)
    assert closure is None and len(times) == 3 and moved[2, 0] == pytest.approx([0.4, 0.0, 0.0])
    assert set(ENGINES) == set(registration.ENGINES)
