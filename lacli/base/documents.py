"""TOML and JSON documents read within bounds: of size, depth, count and length of numbers. One message whatever is wrong.

``read_toml(path, error=SceneError)`` gives a table, ``read_json(path)`` a document, ``parse_toml(text, where)`` a table from text
that is at hand. Each raises ``error`` (InputError unless told otherwise) with the path, what is wrong and what to do; no
RecursionError, MemoryError, OverflowError, ValueError or OSError leaves this module, and none takes longer than about two
seconds. A byte-order mark of UTF-8 is taken off. Numbers may be NaN or infinite (both formats know them, or Python's reader
does): whether that makes sense is for the caller to say. Whole numbers have 64 bits, as TOML demands.

``brief(value)`` is a value as it may stand in a message: its repr, cut where it is long.
"""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from lacli.base.errors import InputError, LacliError

TOML_BYTES = 1 << 19  # Python's TOML reader takes up to two seconds per megabyte
JSON_BYTES = 8 << 20
MOST_VALUES = 200_000
MOST_DEPTH = 32
_INT64 = 1 << 63
_MB = 1 << 20
# a key of very many parts costs the TOML reader their number squared; found before it reads
_LONG_KEY = re.compile(r"""(?<![\w"'\-])(?:[\w"'\-]++[ \t]*+\.[ \t]*+){100}""")

Raises = type[LacliError]


def read_toml(path: Path, *, error: Raises = InputError, missing: str = "no such file", most: int = TOML_BYTES) -> dict[str, Any]:
    """The table in a TOML file of at most ``most`` bytes; ``missing``: what to say where there is no file."""
    return parse_toml(_text(path, error, missing, most), str(path), error=error)


def read_json(path: Path, *, error: Raises = InputError, missing: str = "no such file", most: int = JSON_BYTES) -> Any:
    """The document in a JSON file of at most ``most`` bytes (any JSON value); ``missing``: what to say where there is no file."""
    return _parse(json.loads, _text(path, error, missing, most), str(path), "JSON", error)


def parse_toml(text: str, where: str, *, error: Raises = InputError) -> dict[str, Any]:
    """The table in TOML text; ``where`` starts the message."""
    if _LONG_KEY.search(text):
        raise error(f"{where}: not valid TOML here: a key of more than 100 parts.")
    table: dict[str, Any] = _parse(tomllib.loads, text, where, "TOML", error)
    return table


def brief(value: Any, most: int = 80) -> str:
    """The value as it stands in a message: its repr, cut in the middle where it is longer than ``most`` characters."""
    if isinstance(value, int) and not isinstance(value, bool) and abs(value) >= _INT64:
        return "a whole number of more than 64 bits"
    if isinstance(value, str) and len(value) > most:
        value = value[: most // 2] + " ... " + value[-most // 4 :]
    try:
        text = repr(value)
    except (RecursionError, ValueError):  # too deep, or a number of too many digits inside
        return f"a {type(value).__name__}"
    return text if len(text) <= most + 16 else text[: most // 2] + " ... " + text[-most // 4 :]


def _text(path: Path, error: Raises, missing: str, most: int) -> str:
    try:
        if not path.is_file():
            raise error(f"{path}: {missing if not path.exists() else 'no plain file'}.")
        with path.open("rb") as stream:
            content = stream.read(most + 1)
    except OSError as reason:
        raise error(f"{path}: cannot be read ({reason.strerror or reason}).") from None
    except ValueError as reason:  # a path with a NUL
        raise error(f"{str(path)!r}: no path ({reason}).") from None
    if len(content) > most:
        raise error(f"{path}: larger than {most / _MB:g} MB, which no such document is; is it the right file?")
    if content[:2] in (b"\xff\xfe", b"\xfe\xff"):
        raise error(f"{path}: the text is UTF-16; save it as UTF-8.")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as reason:
        line = content[: reason.start].count(b"\n") + 1
        raise error(f"{path}: the text is not UTF-8 (line {line}); save it as UTF-8.") from None


def _parse(reader: Callable[[str], Any], text: str, where: str, kind: str, error: Raises) -> Any:
    try:
        document = reader(text)
    except (RecursionError, MemoryError):
        raise error(f"{where}: not valid {kind} here: nested deeper than {MOST_DEPTH} levels.") from None
    except ValueError as reason:
        words = str(reason)
        if "integer string conversion" in words:
            words = "a whole number of thousands of digits"
        raise error(f"{where}: not valid {kind}: {words[:200].rstrip('.')}.") from None
    _check(document, where, error)
    return document


def _check(document: Any, where: str, error: Raises) -> None:
    """Depth, count and whole numbers; without recursion."""
    stack: list[tuple[Any, tuple[str, ...]]] = [(document, ())]
    seen = 0
    while stack:
        value, path = stack.pop()
        seen += 1
        if isinstance(value, int) and not -_INT64 <= value < _INT64:
            key = ".".join(path)
            raise error(f"{where}: {key + ': ' if key else ''}a whole number of more than 64 bits; write it as 1.0e20.")
        if not isinstance(value, (dict, list)):
            continue
        if len(path) >= MOST_DEPTH:
            raise error(f"{where}: {brief(path[0])}: nested deeper than {MOST_DEPTH} levels.")
        if seen + len(stack) + len(value) > MOST_VALUES:
            raise error(f"{where}: more than {MOST_VALUES:,} values, which no such document has; is it the right file?")
        stack += (
            [(v, (*path, str(k))) for k, v in value.items()]
            if isinstance(value, dict)
            else [(v, (*path, str(i))) for i, v in enumerate(value)]
        )
