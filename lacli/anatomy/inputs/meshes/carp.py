"""CARP's text meshes: .pts (micrometres), .elem, .lon, plain or gzipped. Lengths here are mm."""

from __future__ import annotations

import gzip
import io
import os
import re
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lacli.base.arrays import FloatArray, IntArray
from lacli.base.errors import InputError

CORNERS = {"Tt": 4, "Tr": 3, "Ln": 2, "Qd": 4, "Py": 5, "Pr": 6, "Hx": 8}
MOST_BYTES = 256 << 20  # of text: six million elements
FURTHEST_MM = 1e5


@dataclass(frozen=True)
class CarpMesh:
    """points (n, 3) mm; kind "Tt" (tetrahedra) or "Tr" (triangles); cells (m, 4) or (m, 3); tag (m,); fibre (m, 3) and
    sheet (m, 3), or None."""

    points: FloatArray
    kind: str
    cells: IntArray
    tag: IntArray
    fibre: FloatArray | None = None
    sheet: FloatArray | None = None


def read(prefix: Path) -> CarpMesh:
    """Read ``prefix``.pts, .elem and, if it is there, .lon (also gzipped). ``prefix`` may carry one of these endings.

    Raises InputError on missing files, wrong counts, unknown or mixed elements, ids out of range, values that are no numbers.
    """
    base = stem(prefix)
    head, body = _text_of(base, ".pts")
    points = _numbers(base, ".pts", body, (3,)) / 1000.0
    _count(base, ".pts", head, len(points))
    if not np.isfinite(points).all():
        raise InputError(f"{base}.pts: point {int(np.flatnonzero(~np.isfinite(points).all(axis=1))[0])} is not finite.")
    if np.abs(points).max() > FURTHEST_MM:
        bad = int(np.argmax(np.abs(points).max(axis=1)))
        raise InputError(
            f"{base}.pts: point {bad} lies at {np.abs(points[bad]).max():.3g} mm; no heart does. CARP has micrometres."
        )
    head, body = _text_of(base, ".elem")
    kinds = sorted(set(re.findall(r"^[ \t]*([^\s]+)", body, re.M)))
    if len(kinds) != 1 or kinds[0] not in ("Tt", "Tr"):
        shown = ", ".join(kinds[:5]) or "none"
        raise InputError(f"{base}.elem: expected only Tt, or only Tr elements, found {shown}.")
    corners = CORNERS[kinds[0]]
    table = _numbers(base, ".elem", re.sub(r"^[ \t]*T[rt]", "", body, flags=re.M), (corners, corners + 1))
    _count(base, ".elem", head, len(table))
    if not np.isfinite(table).all() or np.any(table != np.round(table)) or np.abs(table).max() > 1 << 40:
        raise InputError(f"{base}.elem: points and tags must be whole numbers.")
    cells = table[:, :corners].astype(np.int64)
    tag = table[:, corners].astype(np.int64) if table.shape[1] > corners else np.zeros(len(cells), dtype=np.int64)
    if cells.min() < 0 or cells.max() >= len(points):
        bad = int(cells.min()) if cells.min() < 0 else int(cells.max())
        raise InputError(f"{base}.elem: an element names point {bad}, there are {len(points)} (numbered from 0).")
    fibre = sheet = None
    if _find(base, ".lon") is not None:
        fibre, sheet = _directions(base, len(cells))
    return CarpMesh(points, kinds[0], cells, tag, fibre, sheet)


def _directions(base: Path, cells: int) -> tuple[FloatArray, FloatArray | None]:
    """Fibres, and sheets where there are two vectors. The first line is their number, 1 or 2; some tools leave it out."""
    head, body = _text_of(base, ".lon")
    said = {"1": 3, "2": 6}.get(head)
    if said is None and len(head.split()) == 1:
        raise InputError(f"{base}.lon: the first line is '{head[:20]}'; it must be the number of directions, 1 or 2.")
    values = _numbers(base, ".lon", body if said else f"{head}\n{body}", (3, 6) if said is None else (said,))
    if len(values) != cells:
        raise InputError(f"{base}.lon: expected a line for each of {cells} elements, found {len(values)}.")
    return values[:, :3], values[:, 3:] if values.shape[1] == 6 else None


def write(mesh: CarpMesh, prefix: Path) -> list[Path]:
    """Write .pts (micrometres), .elem and, with fibres, .lon; full precision, under temporary names first."""
    base = stem(prefix)
    files = {
        ".pts": _text(str(len(mesh.points)), mesh.points * 1000.0),
        ".elem": "\n".join(
            [str(len(mesh.cells))]
            + [f"{mesh.kind} {' '.join(map(str, c))} {t}" for c, t in zip(mesh.cells.tolist(), mesh.tag.tolist(), strict=True)]
        )
        + "\n",
    }
    if mesh.fibre is not None:
        columns = mesh.fibre if mesh.sheet is None else np.column_stack([mesh.fibre, mesh.sheet])
        files[".lon"] = _text("1" if mesh.sheet is None else "2", columns)
    written = []
    for ending, content in files.items():
        target = base.with_name(base.name + ending)
        temporary = target.with_name(f".part-{os.getpid()}-{target.name}")
        temporary.write_text(content)
        temporary.replace(target)
        written.append(target)
    return written


def stem(path: Path) -> Path:
    """The path without .pts, .elem, .lon and .gz."""
    name = path.name
    for ending in (".gz", ".pts", ".elem", ".lon"):
        name = name.removesuffix(ending)
    return path.with_name(name)


def _text(head: str, values: FloatArray) -> str:
    return head + "\n" + "\n".join(" ".join(map(repr, row)) for row in values.tolist()) + "\n"


def _find(base: Path, ending: str) -> Path | None:
    for name in (base.name + ending, base.name + ending + ".gz"):
        if base.with_name(name).is_file():
            return base.with_name(name)
    return None


def _text_of(base: Path, ending: str) -> tuple[str, str]:
    """The first line, and the others; empty lines and comments (#) are left out."""
    file = _find(base, ending)
    if file is None:
        raise InputError(f"{base}{ending}: no such file (nor gzipped).")
    try:
        with gzip.open(file) if file.suffix == ".gz" else file.open("rb") as stream:
            content = stream.read(MOST_BYTES + 1)  # a compressed file is not unpacked any further
        if len(content) > MOST_BYTES:
            raise InputError(f"{file}: more than {MOST_BYTES >> 20} MB of text; is it the mesh of an atrium?")
        text = content.decode()
    except (OSError, EOFError, UnicodeDecodeError, zlib.error) as error:
        raise InputError(f"{file}: cannot be read ({error}).") from None
    text = re.sub(r"^[^\S\n]*(#[^\n]*)?\n?", "", text.replace("\r", "\n"), flags=re.M)
    if not text.strip():
        raise InputError(f"{file}: the file is empty.")
    head, _, body = text.partition("\n")
    return head.strip(), body


def _numbers(base: Path, ending: str, body: str, columns: tuple[int, ...]) -> FloatArray:
    """(n, columns) of text with any white space; ``columns``: how many may stand in a line."""
    if not body.strip():
        raise InputError(f"{base}{ending}: the first line is all there is; the file may be truncated.")
    try:
        values = np.loadtxt(io.StringIO(body), dtype=np.float64, ndmin=2, comments=None)
    except ValueError:
        raise InputError(
            f"{base}{ending}: a line is not made of numbers, or lines differ in length; the file may be truncated."
        ) from None
    if values.shape[1] not in columns:
        wanted = " or ".join(map(str, columns))
        raise InputError(f"{base}{ending}: expected {wanted} numbers a line, found {values.shape[1]}.")
    return values


def _count(base: Path, ending: str, head: str, found: int) -> None:
    if not re.fullmatch(r"[0-9]{1,12}", head):
        raise InputError(f"{base}{ending}: the first line must be the number of lines that follow, it is '{head[:20]}'.")
    if int(head) != found:
        raise InputError(f"{base}{ending}: the first line promises {int(head)} lines, there are {found}; the file is truncated.")
