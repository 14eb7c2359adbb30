"""Tracking through frames: registrations kept by content, the closure of the cycle spread over it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lacli.anatomy.inputs.image import Image
from lacli.base.errors import LacliError
from lacli.motion import tracking
from lacli.motion.field import Field, write_field
from lacli.motion.registration import Registered
from lacli.motion.tracking import Pair, displacement_of, register_all


def image(value: int = 0) -> Image:
    return Image(np.full((5, 5, 5), value, np.int16), np.ones(3), np.zeros(3), np.eye(3))


def field(u: tuple[float, float, float]) -> Field:
    return Field(np.broadcast_to(np.array(u, dtype=np.float32), (12, 12, 12, 3)).copy(), np.full(3, 2.0), np.zeros(3), np.eye(3))


def test_the_digest_holds_all_that_determines_a_field() -> None:
    pair = Pair("1", image(1), image(2))
    other_grid = Image(image(2).array, np.full(3, 1.1), np.zeros(3), np.eye(3))
    others = [Pair("1", image(1), image(3)), Pair("1", image(4), image(2)), Pair("1", image(1), other_grid)]
    keys = {pair.digest("greedy"), pair.digest("demons"), *(p.digest("greedy") for p in others)}
    assert len(keys) == 5
    assert Pair("another name", image(1), image(2)).digest("greedy") == pair.digest("greedy")


def test_what_is_left_at_the_end_of_the_cycle_is_spread_over_it() -> None:
    points = np.array([[8.0, 8, 8], [10, 10, 10]])
    fields = [field((2, 0, 0)), field((3, 0, 0)), field((0.4, 0, 0.3))]
    times, moved, closure = displacement_of(fields, np.array([0.0, 0.25, 0.5, 1.0]), points)
    assert times.tolist() == [0, 0.25, 0.5] and moved.shape == (3, 2, 3)
    assert closure == pytest.approx(0.5)  # |(.4, 0, .3)|
    assert moved[0] == pytest.approx(np.zeros((2, 3)))
    assert moved[1] == pytest.approx(np.tile([2 - 0.25 * 0.4, 0, -0.25 * 0.3], (2, 1)), abs=1e-6)
    assert moved[2] == pytest.approx(np.tile([3 - 0.5 * 0.4, 0, -0.5 * 0.3], (2, 1)), abs=1e-6)


def test_an_open_cycle_is_left_as_it_was_tracked() -> None:
    points = np.array([[8.0, 8, 8]])
    times, moved, closure = displacement_of([field((2, 0, 0))], np.array([0.0, 0.5]), points)
    assert closure is None and times.tolist() == [0, 0.5] and moved[1, 0] == pytest.approx([2, 0, 0])


def test_a_field_that_is_kept_is_not_made_again_and_a_damaged_one_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[str] = []

    def engine(name: str, fixed: Path, moving: Path, out: Path) -> Registered:
        made.append(out.stem)
        write_field(field((1, 2, 3)), out)
        return Registered(field((1, 2, 3)), 2.5, 100.0)

    monkeypatch.setattr(tracking, "register_apart", engine)
    pairs = [Pair("a", image(1), image(2)), Pair("b", image(1), image(3))]
    told: list[tuple[int, int]] = []
    run = register_all(pairs, "greedy", tmp_path, 2, lambda what, done, of: told.append((done, of)), "registering")
    assert (run.kept, run.cpu_s, run.peak_memory_mb) == (0, 5.0, 100.0) and len(made) == 2
    assert told[0] == (0, 2) and told[-1] == (2, 2)
    assert not list(tmp_path.glob(".part*"))
    again = register_all(pairs, "greedy", tmp_path, 2, lambda *_: None, "registering")
    assert (again.kept, again.cpu_s) == (2, 0.0) and len(made) == 2
    (tmp_path / f"{pairs[0].digest('greedy')}.nrrd").write_bytes(b"damaged")
    third = register_all(pairs, "greedy", tmp_path, 1, lambda *_: None, "registering")
    assert third.kept == 1 and made[2:] == [pairs[0].digest("greedy")]


def test_the_pair_that_fails_is_named_and_nothing_is_left_beside(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def engine(name: str, fixed: Path, moving: Path, out: Path) -> Registered:
        raise LacliError("registration (greedy) failed: singular.")

    monkeypatch.setattr(tracking, "register_apart", engine)
    with pytest.raises(LacliError, match=r"^frame 4: registration \(greedy\) failed: singular"):
        register_all([Pair("frame 4", image(1), image(2))], "greedy", tmp_path, 1, lambda *_: None, "registering")
    assert list(tmp_path.iterdir()) == []
