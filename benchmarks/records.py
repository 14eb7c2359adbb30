"""What a long benchmark has found so far, a line of JSON each: it can be interrupted, and goes on where it was."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeVar

Found = TypeVar("Found")


def read(file: Path | None, kind: type[Found]) -> list[Found]:
    """The records in a file, dataclasses of that kind; none without a file."""
    if file is None or not file.is_file():
        return []
    return [kind(**json.loads(line)) for line in file.read_text(encoding="utf-8").splitlines()]


def add(file: Path | None, found: Any) -> None:
    """A record more."""
    if file is not None:
        with file.open("a", encoding="utf-8") as stream:
            stream.write(json.dumps(asdict(found)) + "\n")
