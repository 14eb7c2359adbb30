"""A page as data, and its HTML: every text escaped, every picture and script inside the file."""

from __future__ import annotations

import base64
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lacli.base.errors import InputError
from lacli.base.files import write_text

MOST_BYTES = 15_000_000


@dataclass(frozen=True)
class Table:
    """A table: cells as they are printed."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class Figure:
    """A picture with its caption; ``source`` is a data URI."""

    caption: str
    source: str


@dataclass(frozen=True)
class Section:
    """A part of the page, in this order: warnings, text, 3D view, tables, figures, text as it stands."""

    anchor: str
    title: str
    warnings: tuple[str, ...] = ()
    text: tuple[str, ...] = ()
    atrium: dict[str, Any] | None = None
    tables: tuple[Table, ...] = ()
    figures: tuple[Figure, ...] = ()
    verbatim: tuple[str, ...] = ()


@dataclass(frozen=True)
class Page:
    """Title, a sentence on it, sections; at most one of them has a 3D view."""

    title: str
    lead: str
    sections: tuple[Section, ...] = field(default=())


def picture(file: Path, caption: str) -> Figure:
    """A PNG file as a figure. Raises InputError where it is none."""
    try:
        content = file.read_bytes()
    except OSError as error:
        raise InputError(f"{file}: cannot be read ({error.strerror}).") from None
    if not content.startswith(b"\x89PNG\r\n\x1a\n"):
        raise InputError(f"{file}: not a PNG picture.")
    return Figure(caption, "data:image/png;base64," + base64.b64encode(content).decode())


def html(page: Page) -> str:
    """The page as one HTML document."""
    from jinja2 import Environment, StrictUndefined
    from markupsafe import Markup

    here = Path(__file__).parent
    environment = Environment(autoescape=True, undefined=StrictUndefined, keep_trailing_newline=True)
    template = environment.from_string((here / "page.html.j2").read_text(encoding="utf-8"))
    views = [s.atrium for s in page.sections if s.atrium]
    # no mark of HTML's in a script
    data = json.dumps(views[0], allow_nan=False).replace("<", "\\u003c") if views else ""
    viewer = (here / "viewer.js").read_text(encoding="utf-8")
    return template.render(page=page, atrium=Markup(data) if views else "", viewer=Markup(viewer))


def write(page: Page, file: Path) -> int:
    """Write the page; its size in bytes. Raises InputError where it is larger than 15 MB, StorageError."""
    text = html(page)
    size = len(text.encode())
    if size > MOST_BYTES:
        raise InputError(
            f"{file}: the page would have {size / 1e6:.0f} MB, more than {MOST_BYTES / 1e6:.0f}; draw a coarser run."
        )
    write_text(file, text)
    return size


def number(value: Any, digits: int = 4) -> str:
    """A number as it is printed; ``-`` where there is none."""
    if value is None or (isinstance(value, float) and value != value):
        return "-"
    return f"{value:.{digits}g}" if isinstance(value, (int, float)) and not isinstance(value, bool) else str(value)
