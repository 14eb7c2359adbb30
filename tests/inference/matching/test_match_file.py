"""A matched region as a file: all of it comes back, and whatever is changed in it is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lacli.base.errors import InputError
from lacli.inference.box import make_box
from lacli.inference.matching.file import load_match, save_match
from lacli.inference.matching.matching import Match
from lacli.inference.matching.nroy import RegionSample

BOX = make_box(("a", "b"), [0.0, -1.0], [1.0, 1.0])


def found(**other: object) -> Match:
    rng = np.random.default_rng(0)
    sample = {"points": BOX.uniform(20, rng), "level": rng.random(20), "volume": 0.04, "volume_sd": 0.003, "acceptance": 0.4,
              "correlation": np.nan, "evaluations": 1234}  # fmt: skip
    rest = {"share": 0.04, "share_sd": 0.002, "change": np.nan}
    return Match(RegionSample(**{**sample, **{k: v for k, v in other.items() if k in sample}}),  # type: ignore[arg-type]
                 **{**rest, **{k: v for k, v in other.items() if k in rest}})  # type: ignore[arg-type]  # fmt: skip


def test_everything_comes_back(tmp_path: Path) -> None:
    save_match(tmp_path / "match.npz", found(), "identity")
    back = load_match(tmp_path / "match.npz", BOX)
    assert (back.sample.points == found().sample.points).all() and (back.sample.level == found().sample.level).all()
    assert (back.sample.volume, back.sample.volume_sd, back.sample.acceptance, back.sample.evaluations) == (
        0.04,
        0.003,
        0.4,
        1234,
    )
    assert (back.share, back.share_sd) == (0.04, 0.002) and np.isnan(back.change) and np.isnan(back.sample.correlation)


@pytest.mark.parametrize(
    ("other", "words"),
    [
        ({"share": 0.0}, "its share of the box is 0"),
        ({"share": np.nan}, "its share of the box is nan"),
        ({"share_sd": -1.0}, "standard error -1"),
        ({"points": np.full((20, 2), 2.0)}, "out of the box"),
        ({"points": np.zeros((20, 3))}, r"shape \(20, 3\), 2 inputs"),
        ({"level": np.full(20, 1.5)}, "level"),
    ],
)
def test_what_no_match_gives_is_refused(other: dict[str, object], words: str, tmp_path: Path) -> None:
    save_match(tmp_path / "match.npz", found(**other), "identity")
    with pytest.raises(InputError, match=rf"match.npz.*{words}.*Remove it to match anew"):
        load_match(tmp_path / "match.npz", BOX)


def test_a_number_changed_by_hand_is_seen(tmp_path: Path) -> None:
    file = tmp_path / "match.npz"
    save_match(file, found(), "identity")
    with np.load(file) as opened:
        kept = dict(opened)
    kept["points"] = kept["points"][::-1]
    np.savez(file, **kept)
    with pytest.raises(InputError, match=r"match.npz"):
        load_match(file, BOX)
