"""Mesh files of others, read in a process of its own with limits: what a library crashes or chokes on is one message.

``content(path, "surface")`` starts ``python -m lacli.anatomy.inputs.meshes.apart surface FILE OUT``, which reads the file with
VTK or meshio and leaves plain arrays; a damaged file may end that process, or ask for more memory than it gets, and no more.
"""

from __future__ import annotations

import contextlib
import resource
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from lacli.base.errors import InputError
from lacli.base.processes.process import answer_of
from lacli.base.quiet import quiet, reason
from lacli.base.schema import Array, array_file, write_arrays
from lacli.base.vtkxml import is_whole

_TIMEOUT_S = 300.0
# memory for the libraries themselves, and for each byte of the file (packed files grow fivefold, readers hold copies)
_MEMORY, _MEMORY_PER_BYTE = 1 << 30, 40
_REFUSED = 3
_TETRAHEDRA = {10: 4, 24: 10}  # VTK_TETRA, VTK_QUADRATIC_TETRA
FIBRE_NAMES = ("fibre", "fiber", "fibres", "fibers", "Fibre", "fibre_direction")

_SCHEMAS = {
    "surface": {
        "points": Array(shape=("n", 3), finite=False), "triangles": Array("int", ("t", 3)),
        "tets": Array("int", ("m", 4)), "grid_points": Array(shape=("g", 3), finite=False),
        "cell_names": Array("text", ("c",)), "grid_cells": Array("int"),
    },
    "fibres": {"centre": Array(shape=("m", 3), finite=False), "fibre": Array(shape=("m", 3), finite=False)},
}  # fmt: skip


def content(path: Path, what: str) -> dict[str, Any]:
    """Arrays of a mesh file by name, ``what`` being "surface" or "fibres" (see ``_SCHEMAS``), and for a surface its cells'
    scalar arrays as ``cell_0`` ... in the order of cell_names.

    Raises InputError where the file is missing, empty, damaged or of another kind.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file.")
    size = path.stat().st_size
    if size == 0:
        raise InputError(f"{path}: the file is empty; export it again.")
    with tempfile.TemporaryDirectory(prefix="lacli-read-") as folder:
        out = Path(folder) / "content.npz"
        memory = _MEMORY + _MEMORY_PER_BYTE * size
        command = [sys.executable, "-m", __name__, what, str(path.absolute()), str(out), str(memory)]
        try:
            answer = answer_of(command, timeout_s=_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            raise InputError(f"{path}: reading it takes longer than {_TIMEOUT_S:.0f} s; export it again, or coarser.") from None
        words = answer.stdout.strip()
        if answer.returncode == _REFUSED and words:
            raise InputError(words.replace(str(path.absolute()), str(path)))
        if answer.returncode != 0:
            how = f"signal {-answer.returncode}" if answer.returncode < 0 else f"exit code {answer.returncode}"
            raise InputError(f"{path}: the file cannot be read, its reader broke down on it ({how}): damaged. Export it again.")
        with array_file(out, "what was read of a mesh", "Export it again.", largest=memory, sealed=True) as file:
            found = file.read(_SCHEMAS[what])
            for i in range(len(found.get("cell_names", ()))):
                found |= file.read({f"cell_{i}": Array(shape=(f"cells_{i}",), finite=False)})
    return found


# --- in the process of its own ----------------------------------------------------------------------------------------


def _surface(path: Path) -> dict[str, Any]:
    """Points and triangles of the surface (other polygons cut in triangles); corners of the tetrahedra, where there are any,
    and the cells' scalars."""
    import pyvista as pv

    data: Any = pv.read(path)
    if not is_whole(data):
        raise InputError(f"{path}: a cell names a point that does not exist; export the file again.")
    grid_points = np.zeros((0, 3))
    tets, grid_cells = np.zeros((0, 4), np.int64), 0
    cells = getattr(data, "cells_dict", None) or {}
    kind = next((k for k in _TETRAHEDRA if k in cells), None)
    mine: Any = slice(None)
    if kind is not None:
        tets = np.asarray(cells[kind], np.int64)[:, :4]
        mine = np.asarray(data.celltypes) == kind
        grid_points, grid_cells = np.asarray(data.points, np.float64), int(mine.sum())
    scalars = {
        name: np.asarray(data.cell_data[name])[mine]
        for name in data.cell_data
        if np.asarray(data.cell_data[name]).ndim == 1 and np.asarray(data.cell_data[name]).dtype.kind in "fiub"
    }
    if kind is None:
        surface = data if isinstance(data, pv.PolyData) else data.extract_surface(algorithm="dataset_surface")
        surface = surface.triangulate()
        points = np.asarray(surface.points, np.float64)
        triangles = np.asarray(surface.regular_faces if surface.n_cells else np.zeros((0, 3)), np.int64).reshape(-1, 3)
    else:
        points, triangles = grid_points, np.zeros((0, 3), np.int64)
    arrays = {f"cell_{i}": np.asarray(value, np.float64) for i, value in enumerate(scalars.values())}
    names = np.array([str(name) or "?" for name in scalars], dtype="U") if scalars else np.zeros(0, "U1")
    return {
        "points": points, "triangles": triangles, "tets": tets, "grid_points": grid_points, "grid_cells": grid_cells,
        "cell_names": names, **arrays,
    }  # fmt: skip


def _fibres(path: Path) -> dict[str, Any]:
    """Centres and fibres of the tetrahedra and triangles that carry a cell array of FIBRE_NAMES."""
    import meshio

    data = meshio.read(path)
    name = next((n for n in FIBRE_NAMES if n in data.cell_data), None)
    if name is None:
        raise InputError(f"{path}: no cell array named {', '.join(FIBRE_NAMES)}; it has {', '.join(data.cell_data) or 'none'}.")
    width = {"tetra": 4, "tetra10": 4, "triangle": 3}
    pairs = [(b, np.asarray(v)) for b, v in zip(data.cells, data.cell_data[name], strict=True) if b.type in width]
    if not pairs:
        raise InputError(f"{path}: no tetrahedra or triangles carry fibres.")
    for block, values in pairs:
        if values.ndim != 2 or values.shape[1] != 3 or values.dtype.kind not in "fiu":
            raise InputError(f"{path}: '{name}' must have three components for each cell, its shape is {values.shape}.")
        if block.data.min() < 0 or block.data.max() >= len(data.points):
            raise InputError(f"{path}: a cell names a point that does not exist; export the file again.")
    centre = np.concatenate([data.points[b.data[:, : width[b.type]]].mean(axis=1) for b, _ in pairs])
    return {"centre": centre.astype(float), "fibre": np.concatenate([values for _, values in pairs]).astype(float)}


_READERS = {
    "surface": (_surface, "the surface cannot be read, the file may be truncated or of another format"),
    "fibres": (_fibres, "the mesh cannot be read"),
}


def _main() -> int:
    what, path, out, memory = sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3]), int(sys.argv[4])
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    with contextlib.suppress(ValueError, OSError):  # a system without this limit has the time-out
        resource.setrlimit(resource.RLIMIT_DATA, (memory, resource.getrlimit(resource.RLIMIT_DATA)[1]))
    read, trouble = _READERS[what]
    try:
        with quiet(meshio=True):
            found = read(path)
        write_arrays(out, found, compressed=False)
    except InputError as error:
        print(error)
    except MemoryError:
        print(f"{path}: {trouble} (it asks for more than {memory / 1e9:.1f} GB of memory).")
    except (Exception, SystemExit) as error:  # readers raise all sorts of things on damaged files; meshio ends the program
        print(f"{path}: {trouble} ({reason(error)}).")
    else:
        return 0
    return _REFUSED


if __name__ == "__main__":
    sys.exit(_main())
