"""The site: Sphinx with MyST. Formulas become MathML, so that no page needs a network."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from latex2mathml.converter import convert

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from lacli import __version__

project = "lacli"
author = "the lacli developers"
version = release = __version__
extensions = ["myst_parser"]
myst_enable_extensions = ["dollarmath", "deflist"]
myst_heading_anchors = 3
smartquotes = False
html_theme = "furo"
html_title = "lacli"
html_math_renderer = "mathml"
html_show_copyright = False
exclude_patterns = ["_build"]


def _inline(translator: Any, node: Any) -> None:
    from docutils import nodes

    translator.body.append(convert(node.astext()))
    raise nodes.SkipNode


def _display(translator: Any, node: Any) -> None:
    from docutils import nodes

    translator.body.append(convert(node.astext(), display="block"))
    raise nodes.SkipNode


def setup(app: Any) -> None:
    """Register the way formulas are written."""
    app.add_html_math_renderer("mathml", inline_renderers=(_inline, None), block_renderers=(_display, None))
