"""Libraries' own words are kept back, and everything is as before afterwards."""

from __future__ import annotations

import sys
import warnings

import numpy as np
import pytest
from vtkmodules.vtkCommonCore import vtkLogger, vtkObject

from lacli.base.quiet import quiet, reason


def test_nothing_is_said_inside_and_everything_is_as_before_afterwards(capsys: pytest.CaptureFixture[str]) -> None:
    shown, verbosity, asked = vtkObject.GetGlobalWarningDisplay(), vtkLogger.GetCurrentVerbosityCutoff(), np.geterr()
    with pytest.raises(ValueError, match="ours"), quiet(meshio=True):
        warnings.warn("of a library", UserWarning, stacklevel=1)
        np.log(np.zeros(1))
        print("of meshio")
        print("of meshio", file=sys.stderr)
        assert not vtkObject.GetGlobalWarningDisplay()
        raise ValueError("ours")
    assert capsys.readouterr() == ("", "")
    assert (vtkObject.GetGlobalWarningDisplay(), vtkLogger.GetCurrentVerbosityCutoff()) == (shown, verbosity)
    assert np.geterr() == asked
    with pytest.warns(UserWarning, match="again"):
        warnings.warn("again", UserWarning, stacklevel=1)


def test_a_complaint_is_its_kind_and_first_line() -> None:
    assert reason(ValueError("\n  first \nsecond")) == "ValueError: first"
    assert reason(KeyError()) == "KeyError"
    long = reason(RuntimeError("x" * 500))
    assert long.startswith("RuntimeError: xxx") and len(long) == 204 and long.endswith(" ...")
