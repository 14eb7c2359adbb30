"""FreeFEM scripts from their Jinja templates."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from lacli.base import resources


def _number(value: object) -> object:
    """Numbers reach a deck in full precision and finite, names only from our own tables."""
    if isinstance(value, float):
        if not math.isfinite(value):
            raise ValueError("a number of the deck is not finite")
        return repr(float(value))
    return value


def render_template(template: str, plugin: Path | None, **choices: Any) -> str:
    """A script as text; ``plugin`` is the compiled engine, without or with its ending .so (None: the engine in FreeFEM's own
    language), ``choices`` what the template names."""
    name = str(plugin.with_suffix("")) if plugin else ""
    if not re.fullmatch(r"[A-Za-z0-9_./+ -]*", name):
        raise ValueError(f"the plugin's path has characters that a FreeFEM string cannot hold: {name}")
    environment = Environment(
        loader=FileSystemLoader(resources.folder("templates")),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        finalize=_number,
        autoescape=False,
    )
    return environment.get_template(template).render(plugin=name, **choices)
