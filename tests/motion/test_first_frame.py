"""The first frame is end-diastole, the atrium's least volume: where it is not, it is told, and refused where it cannot be."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from shapes import fibrous_ball

from lacli import track
from lacli.base.errors import InputError
from lacli.contracts.bundle import Bundle, save
from lacli.motion.field import Field, write_field
from lacli.motion.patient import from_given

TIMES = np.array([0.0, 0.2, 0.4, 0.6, 0.8])


@pytest.fixture(scope="module")
def bundle() -> Bundle:
    return fibrous_ball(1)


def moved(bundle: Bundle, share: list[float]) -> np.ndarray:
    """Displacement (f, n, 3) that makes the volume 1 + share of the first frame's."""
    stretch = np.cbrt(1.0 + np.array(share)) - 1.0
    return stretch[:, None, None] * bundle.points


@pytest.mark.parametrize(("least", "told"), [(0.0, False), (-0.01, False), (-0.15, True)])
def test_a_frame_below_the_first_by_more_than_its_error_is_told(bundle: Bundle, least: float, told: bool) -> None:
    made = from_given(bundle, TIMES, moved(bundle, [0.0, 0.2, 0.5, 0.3, least]), (0.3, 0.3), "fields")
    first = made.course.features[0]["volume_ml"]
    assert made.course.features[4]["volume_ml"] == pytest.approx((1 + least) * first, rel=1e-6)
    doubts = made.course.doubts(made.model)
    assert len(doubts) == told
    if told:
        assert f"the first frame has {first:.1f} mL, frame 4 (time 0.8) {0.85 * first:.1f} mL" in doubts[0]


def test_a_first_frame_nearer_to_the_largest_volume_than_to_the_least_is_refused(bundle: Bundle) -> None:
    with pytest.raises(InputError, match=r"frame 4 \(time 0\.8\) .*: the first is not end-diastole, the atrium's least volume"):
        from_given(bundle, TIMES, moved(bundle, [0.0, 0.05, 0.1, 0.0, -0.2]), (0.3, 0.3), "fields")


def test_what_is_told_stands_in_the_report_and_among_the_warnings(bundle: Bundle, tmp_path: Path) -> None:
    save(bundle, tmp_path / "la")
    grid = np.arange(-32.0, 33.0, 4.0)
    places = np.stack(np.meshgrid(grid, grid, grid, indexing="ij"), axis=-1)[..., ::-1]
    for number, share in enumerate((0.2, 0.5, 0.3, -0.15), start=1):
        u = ((np.cbrt(1.0 + share) - 1.0) * places).astype(np.float32)
        write_field(Field(u, np.full(3, 4.0), np.full(3, grid[0]), np.eye(3)), tmp_path / f"u{number}.nrrd")
    files = [tmp_path / f"u{number}.nrrd" for number in range(1, 5)]
    found = track(files, tmp_path / "la", tmp_path / "out", motion="fields", error_mm=(0.3, 0.3), times=TIMES.tolist())
    (told,) = found.warnings
    assert "frame 4 (time 0.8)" in told
    assert json.loads((tmp_path / "out" / "tracking.json").read_text())["warnings"] == [told]
