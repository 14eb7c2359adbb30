"""What belongs to a file that is named: a header's voxels, the other files of a mesh of several."""

from __future__ import annotations

import re
from pathlib import Path

from lacli.anatomy.inputs.meshes import carp

_META, _NRRD, _PAIR = (".mha", ".mhd"), (".nrrd", ".nhdr"), (".hdr", ".img")
_CARP = (".elem", ".pts", ".lon")
_HEADER = 1 << 16  # bytes; no header is longer
_KEY = {**dict.fromkeys(_META, r"ElementDataFile\s*="), **dict.fromkeys(_NRRD, r"data ?file:")}


def parts(file: Path) -> list[Path]:
    """The files that are read with this one, sorted; none where it is whole by itself. Files that are not there are left out."""
    name = file.name.lower()
    if not file.is_file():
        return []
    found: list[Path] = []
    if (ending := next((e for e in _KEY if name.endswith(e)), None)) is not None:
        found = _named(file, _KEY[ending])
    elif (plain := name.removesuffix(".gz")).endswith(_PAIR):
        base = file.name[: len(plain) - len(_PAIR[0])]
        found = [file.with_name(base + ending + packed) for ending in _PAIR for packed in ("", ".gz")]
    elif plain.endswith(_CARP):
        base = carp.stem(file).name
        found = [file.with_name(base + ending + packed) for ending in _CARP for packed in ("", ".gz")]
    return sorted({one for one in found if one.is_file() and one != file})


def _named(header: Path, key: str) -> list[Path]:
    """The files that a header names behind ``key``: one, a list of them in the lines that follow, or a pattern of numbers."""
    with header.open("rb") as stream:
        text = stream.read(_HEADER).decode("latin-1").replace("\r", "")
    match = re.search(rf"^\s*{key}(.*)$", text, re.MULTILINE | re.IGNORECASE)
    if match is None:
        return []
    said = match[1].strip()
    if said.upper().startswith("LIST"):
        return [header.parent / line.strip() for line in text[match.end() :].splitlines() if 0 < len(line.strip()) < 256]
    if "%" in said:
        pattern = re.sub(r"%0?\d*d", "*", said.split()[0])
        place = header.parent / pattern
        return list(place.parent.glob(place.name)) if place.parent.is_dir() else []
    return [header.parent / said] if said and len(said) < 1024 else []
