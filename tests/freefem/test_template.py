"""Scripts from templates: numbers in full precision, nothing undefined, nothing that a string cannot hold."""

from __future__ import annotations

import math
from pathlib import Path

import jinja2
import pytest

from lacli.base import resources
from lacli.freefem.template import render_template


@pytest.fixture
def templates(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(resources, "folder", lambda name: tmp_path)
    (tmp_path / "a.j2").write_text('{% if plugin %}\nload "{{ plugin }}"\n{% endif %}\nreal x = {{ x }};\n')
    return tmp_path


@pytest.mark.usefixtures("templates")
def test_numbers_keep_every_digit() -> None:
    assert render_template("a.j2", None, x=0.1 + 0.2) == "real x = 0.30000000000000004;\n"
    assert render_template("a.j2", None, x=7) == "real x = 7;\n"
    assert render_template("a.j2", Path("/opt/a b/engine.so"), x=1.0) == 'load "/opt/a b/engine"\nreal x = 1.0;\n'


@pytest.mark.usefixtures("templates")
def test_what_is_not_finite_not_given_or_not_a_plain_path_is_refused() -> None:
    for bad in (math.nan, math.inf):
        with pytest.raises(ValueError, match="not finite"):
            render_template("a.j2", None, x=bad)
    with pytest.raises(jinja2.UndefinedError):
        render_template("a.j2", None)
    for path in ('/x"; exec("rm")', "/x\ny", "/x\\y"):
        with pytest.raises(ValueError, match="cannot hold"):
            render_template("a.j2", Path(path), x=1.0)
