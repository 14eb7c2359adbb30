"""A given motion says its error; one that is tracked has it measured."""

from __future__ import annotations

import pytest

from lacli.base.errors import UsageError
from lacli.motion.measured import stated_error


def test_a_given_motion_s_error_is_its_maker_s_to_state() -> None:
    assert stated_error("images", None) is None
    assert stated_error("fields", (0.3, 0.6)) == (0.3, 0.6)
    with pytest.raises(UsageError, match="of images that are tracked here the error is measured"):
        stated_error("images", (0.3, 0.6))
    with pytest.raises(UsageError, match="--motion surfaces needs --error-mm NORMAL,TANGENTIAL"):
        stated_error("surfaces", None)


@pytest.mark.parametrize("error", [(0.3,), (0.3, 0.6, 0.9), (0.0, 0.6), (0.3, -1.0), (0.3, 20.0), (float("nan"), 0.6)])
def test_an_error_that_is_none_is_refused_as_it_was_written(error: tuple[float, ...]) -> None:
    with pytest.raises(UsageError, match="two numbers above 0") as refused:
        stated_error("fields", error)
    assert ",".join(f"{v:g}" for v in error) in str(refused.value)
