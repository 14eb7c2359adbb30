"""One BLAS thread inside, as many as before outside."""

from __future__ import annotations

import numpy as np
import pytest
from threadpoolctl import threadpool_info

from lacli.base.threads import one_thread, single_threaded


def counts() -> list[int]:
    return [pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"]


def test_blas_has_one_thread_inside_and_what_it_had_outside() -> None:
    np.ones((2, 2)) @ np.ones((2, 2))
    before = counts()
    with one_thread():
        assert counts() and set(counts()) == {1}
    assert counts() == before

    @single_threaded
    def inside(a: int, *, b: int) -> tuple[list[int], int]:
        """Documented."""
        return counts(), a + b

    found, total = inside(1, b=2)
    assert set(found) == {1} and total == 3
    assert inside.__doc__ == "Documented." and inside.__name__ == "inside"

    @single_threaded
    def fails() -> None:
        raise ValueError("inside")

    with pytest.raises(ValueError, match="inside"):
        fails()
    assert counts() == before
