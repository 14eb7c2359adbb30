"""A motion as it is measured: whose error must be stated, and what a given motion becomes."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lacli.base.errors import InputError, UsageError
from lacli.motion.measured import from_images, stated_error
from lacli.motion.patient import Settings


def test_images_have_a_measured_error_and_a_given_motion_a_stated_one() -> None:
    assert stated_error("images", None) is None
    assert stated_error("fields", [0.3, 0.6]) == (0.3, 0.6)
    with pytest.raises(UsageError, match="of images that are tracked here the error is measured"):
        stated_error("images", [0.3, 0.6])
    with pytest.raises(UsageError, match="--motion surfaces needs --error-mm NORMAL,TANGENTIAL"):
        stated_error("surfaces", None)


@given(st.lists(st.floats(allow_nan=True), max_size=4))
def test_two_errors_between_0_and_20_mm_or_none(values: list[float]) -> None:
    if len(values) == 2 and all(0 < v < 20 for v in values):
        assert stated_error("fields", values) == tuple(values)
    else:
        with pytest.raises(UsageError, match="two numbers above 0"):
            stated_error("fields", values)


def test_frames_that_are_not_there_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"nowhere: no such frame"):
        from_images(None, [tmp_path / "nowhere"], None, Settings(), tmp_path / "out", lambda *_: None)  # type: ignore[arg-type]
    assert not (tmp_path / "out").exists()
