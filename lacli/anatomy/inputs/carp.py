"""CARP's text meshes: .pts (micrometres), .elem, .lon, plain or gzipped. Lengths here are mm."""

from __future__ import annotations

import gzip
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lacli.base.arrays import FloatArray, IntArray
from lacli.base.errors import InputError

CORNERS = {"Tt": 4, "Tr": 3, "Ln": 2, "Qd": 4, "Py": 5, "Pr": 6, "Hx": 8}


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
    rows = _lines(base, ".pts")
    points = _numbers(base, ".pts", rows[1:], 3) / 1000.0
    _count(base, ".pts", rows[0], len(points))
    if not np.isfinite(points).all():
        raise InputError(f"{base}.pts: point {int(np.flatnonzero(~np.isfinite(points).all(axis=1))[0])} is not finite.")
    rows = _lines(base, ".elem")
    kinds = sorted({row.split(None, 1)[0] for row in rows[1:]})
    if len(kinds) != 1 or kinds[0] not in ("Tt", "Tr"):
        raise InputError(f"{base}.elem: expected only Tt, or only Tr elements, found {', '.join(kinds) or 'none'}.")
    corners = CORNERS[kinds[0]]
    table = _numbers(base, ".elem", [row.split(None, 1)[1] if " " in row else "" for row in rows[1:]], None)
    _count(base, ".elem", rows[0], len(table))
    if table.shape[1] not in (corners, corners + 1):
        raise InputError(f"{base}.elem: expected {corners} points and a tag per element, found {table.shape[1]} numbers.")
    cells = table[:, :corners].astype(np.int64)
    tag = table[:, corners].astype(np.int64) if table.shape[1] > corners else np.zeros(len(cells), dtype=np.int64)
    if cells.min() < 0 or cells.max() >= len(points):
        raise InputError(f"{base}.elem: an element names point {int(cells.max())}, there are {len(points)} (numbered from 0).")
    fibre = sheet = None
    if _find(base, ".lon") is not None:
        rows = _lines(base, ".lon")
        # the first line is the number of directions, 1 or 2; some tools leave it out
        head = rows[0].split()
        body = rows[1:] if len(head) == 1 else rows
        values = _numbers(base, ".lon", body, None)
        if values.shape[1] not in (3, 6) or len(values) != len(cells):
            raise InputError(f"{base}.lon: expected 3 or 6 numbers for each of {len(cells)} elements, found {values.shape}.")
        fibre = values[:, :3]
        sheet = values[:, 3:] if values.shape[1] == 6 else None
    return CarpMesh(points, kinds[0], cells, tag, fibre, sheet)


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


def _lines(base: Path, ending: str) -> list[str]:
    file = _find(base, ending)
    if file is None:
        raise InputError(f"{base}{ending}: no such file (nor gzipped).")
    try:
        content = gzip.decompress(file.read_bytes()).decode() if file.suffix == ".gz" else file.read_text()
    except (OSError, EOFError, UnicodeDecodeError) as error:
        raise InputError(f"{file}: cannot be read ({error}).") from None
    rows = [row for row in content.splitlines() if row.strip()]
    if not rows:
        raise InputError(f"{file}: the file is empty.")
    return rows


def _numbers(base: Path, ending: str, rows: list[str], columns: int | None) -> FloatArray:
    try:
        values = np.array([row.split() for row in rows], dtype=np.float64)
    except ValueError:
        raise InputError(
            f"{base}{ending}: a line is not made of numbers, or lines differ in length; the file may be truncated."
        ) from None
    if values.ndim != 2 or (columns is not None and values.shape[1] != columns):
        raise InputError(f"{base}{ending}: expected {columns or 'the same number of'} numbers a line.")
    return values


def _count(base: Path, ending: str, head: str, found: int) -> None:
    try:
        said = int(head.split()[0])
    except ValueError:
        raise InputError(f"{base}{ending}: the first line must be the number of lines that follow.") from None
    if said != found:
        raise InputError(f"{base}{ending}: the first line promises {said} lines, there are {found}; the file is truncated.")
