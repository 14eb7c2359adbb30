"""Which commands there are, and the line that says what each does: read from their files, none of which is imported."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path

# as a study goes; a command that is not named here follows these, by its name
ORDER = (
    *("doctor", "synthesize", "segment", "mesh", "fat", "track", "simulate", "verify", "tradeoff"),
    *(
        "design",
        "emulate",
        "sensitivity",
        "match",
        "posterior",
        "calibrate",
        "compare",
        "validate",
        "cohort",
        "stats",
        "study",
        "report",
    ),
)
_HEAD = "\ndef command("
_QUOTES = '"""'


@dataclass(frozen=True)
class Command:
    """A command's module and its line of help."""

    module: str
    text: str


@functools.cache
def commands(folder: Path | None = None) -> dict[str, Command]:
    """Name -> command, in the order of ``lacli --help``.

    A command is a file below this folder with a function ``command``; the first line of that function's docstring is the help.
    """
    root = folder or Path(__file__).parent
    found = {}
    for file in sorted(root.rglob("*.py")):
        _, head, rest = f"\n{file.read_text(encoding='utf-8')}".partition(_HEAD)
        if head:
            module = ".".join(("lacli.cli", *file.relative_to(root).with_suffix("").parts))
            found[file.stem] = Command(module, rest.partition(_QUOTES)[2].partition(_QUOTES)[0].strip().partition("\n")[0])
    return dict(sorted(found.items(), key=lambda item: (ORDER.index(item[0]) if item[0] in ORDER else len(ORDER), item[0])))
