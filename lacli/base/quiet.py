"""What libraries say on their own about a damaged file, kept back: the message is ours."""

from __future__ import annotations

import contextlib
import importlib
import io
import warnings
from collections.abc import Iterator
from typing import Any


@contextlib.contextmanager
def quiet(*, meshio: bool = False) -> Iterator[None]:
    """Nothing of VTK's, ITK's, numpy's and Python's warnings reaches the terminal inside; ``meshio``: nor what meshio prints."""
    import numpy as np
    from vtkmodules.vtkCommonCore import vtkLogger, vtkObject

    shown = vtkObject.GetGlobalWarningDisplay()
    verbosity = vtkLogger.GetCurrentVerbosityCutoff()
    vtkObject.GlobalWarningDisplayOff()
    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_OFF)  # some readers warn past the switch above
    try:
        with contextlib.ExitStack() as stack:
            stack.enter_context(warnings.catch_warnings())
            warnings.simplefilter("ignore")
            stack.enter_context(np.errstate(all="ignore"))
            if meshio:
                stack.enter_context(contextlib.redirect_stderr(io.StringIO()))
                stack.enter_context(contextlib.redirect_stdout(io.StringIO()))
            yield
    finally:
        vtkLogger.SetStderrVerbosity(vtkLogger.ConvertToVerbosity(verbosity))
        vtkObject.SetGlobalWarningDisplay(shown)


def arviz() -> Any:
    """The library ArviZ; kept back is what it says of its own next version at the first import of a day."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return importlib.import_module("arviz")


def reason(error: BaseException, most: int = 200) -> str:
    """A library's complaint as it may stand in brackets: its kind and first line."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    words = f"{type(error).__name__}: {lines[0]}" if lines else type(error).__name__
    return words if len(words) <= most else words[:most] + " ..."
