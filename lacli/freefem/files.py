"""Files in FreeFEM's own formats: meshes (medit) and arrays of numbers. Lengths and ids as they are given."""

from __future__ import annotations

from pathlib import Path
from typing import TextIO

import numpy as np
from numpy.typing import NDArray

from lacli.base.arrays import FloatArray, IntArray
from lacli.base.errors import InputError
from lacli.geometry.quadrature import triangle_shapes

# VTK's 10-node cell -> FreeFEM's: middles of edges 01 02 03 12 13 23; triangle: of 12 20 01
CELL_ORDER = [0, 1, 2, 3, 4, 6, 7, 5, 8, 9]
FACE_ORDER = [0, 1, 2, 4, 5, 3]
STATE = ("x", "y", "z", "X", "Y", "Z")  # columns of a state: positions, reference positions


def write_medit(file: Path, points: FloatArray, tets: IntArray, region: IntArray, triangles: IntArray, tags: IntArray) -> None:
    """Write straight cells (corners of ``tets`` (m, 4 or 10) with ``region`` (m,)) and boundary triangles (t, 3 or 6) with
    ``tags`` (t,), over the points (n, 3) that are corners."""
    used = np.unique(tets[:, :4])
    number = np.zeros(len(points), dtype=np.int64)
    number[used] = np.arange(1, len(used) + 1)
    with file.open("w", encoding="ascii") as out:
        out.write(f"MeshVersionFormatted 2\nDimension 3\nVertices\n{len(used)}\n")
        np.savetxt(out, np.column_stack([points[used], np.zeros(len(used))]), fmt="%.17g %.17g %.17g %d")
        out.write(f"Tetrahedra\n{len(tets)}\n")
        np.savetxt(out, np.column_stack([number[tets[:, :4]], region]), fmt="%d")
        out.write(f"Triangles\n{len(triangles)}\n")
        np.savetxt(out, np.column_stack([number[triangles[:, :3]], tags]), fmt="%d")
        out.write("End\n")


def write_arrays(file: Path, *arrays: FloatArray | IntArray) -> None:
    """Each array as FreeFEM reads it: its length twice, then its values in C order, one a line."""
    with file.open("w", encoding="ascii") as out:
        for array in arrays:
            _write_array(out, np.asarray(array).ravel())


def write_faces(file: Path, triangles: IntArray, weight: FloatArray | None = None) -> None:
    """Write loaded faces: triangles (t, 3 or 6) in VTK's order, and their weights (t, 7) at the quadrature points, else ones."""
    shape = (len(triangles), len(triangle_shapes(3).weight))
    order = FACE_ORDER if triangles.shape[1] == 6 else [0, 1, 2]
    write_arrays(file, triangles[:, order], np.ones(shape) if weight is None else weight.reshape(shape))


def _write_array(out: TextIO, values: NDArray[np.generic]) -> None:
    if values.dtype.kind == "f" and not np.isfinite(values.astype(np.float64)).all():
        raise InputError("A number that goes into the simulation is not finite; check fibres and coordinates of the bundle.")
    out.write(f"{len(values)}\n{len(values)}\n")
    np.savetxt(out, values, fmt="%d" if values.dtype.kind in "iu" else "%.17g")


def read_history(path: Path) -> dict[str, dict[str, float]]:
    """The whole lines of a script's history: numbers by name, under the first word of their line.

    Raises OSError, ValueError where a line is no such line.
    """
    lines = path.read_text(encoding="ascii").split("\n")[:-1]  # what follows the last end of line is not whole
    found: dict[str, dict[str, float]] = {}
    for words in filter(None, (line.split() for line in lines)):
        found[words[0]] = {name: float(value) for name, value in (word.split("=", 1) for word in words[1:])}
    return found


def read_rows(path: Path) -> dict[str, FloatArray]:
    """Lines of a name and numbers, stacked under their names: (lines of the name, numbers in each).

    Raises OSError, ValueError where a name's lines are not equally long or hold what is no finite number.
    """
    found: dict[str, list[FloatArray]] = {}
    with path.open(encoding="ascii") as stream:
        for line in stream:
            name, _, numbers = line.strip().partition(" ")
            if not line.endswith("\n") or not numbers:
                raise ValueError(f"{path.name}: the line {name!r} is incomplete")
            found.setdefault(name, []).append(np.array(numbers.split(), dtype=float))
    rows = {name: np.array(lines) for name, lines in found.items()}
    if bad := [name for name, table in rows.items() if not np.isfinite(table).all()]:
        raise ValueError(f"{path.name}: {', '.join(bad)} not finite")
    return rows


def read_state(path: Path, count: int) -> tuple[FloatArray, FloatArray]:
    """Positions and reference positions (n, 3) mm of a state that a script has left, by the names of its columns.

    Raises OSError, ValueError where there are not ``count`` finite rows.
    """
    with path.open(encoding="ascii") as stream:
        names = stream.readline().split()
        table = np.loadtxt(stream, ndmin=2)
    if table.shape != (count, len(names)) or not np.isfinite(table).all():
        raise ValueError(f"{path.name} is incomplete")
    column = {name: table[:, i] for i, name in enumerate(names)}
    if missing := [name for name in STATE if name not in column]:
        raise ValueError(f"{path.name} has no {', '.join(missing)}")
    return np.stack([column[name] for name in STATE[:3]], axis=1), np.stack([column[name] for name in STATE[3:]], axis=1)
