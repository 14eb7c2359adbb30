"""One BLAS thread: matrices of a few hundred rows are slower on several, and only one gives the same bits each time."""

from __future__ import annotations

import functools
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any, TypeVar

from threadpoolctl import ThreadpoolController

_Function = TypeVar("_Function", bound=Callable[..., Any])


@functools.cache
def _controller() -> ThreadpoolController:
    import scipy.linalg  # noqa: F401  (loads scipy's own BLAS, so that the controller sees it)

    return ThreadpoolController()


def one_thread() -> AbstractContextManager[Any]:
    """A context in which numpy's and scipy's BLAS use one thread."""
    return _controller().limit(limits=1, user_api="blas")


def single_threaded(function: _Function) -> _Function:
    """Decorate a function to run within ``one_thread``."""

    @functools.wraps(function)
    def wrapped(*args: Any, **kwargs: Any) -> Any:
        with one_thread():
            return function(*args, **kwargs)

    return wrapped  # type: ignore[return-value]
