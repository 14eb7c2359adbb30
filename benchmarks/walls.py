"""Meshes of walls from thin to thick with cells from small to large: worst cells, cost, and what was refused with its reason.

    python benchmarks/walls.py [FILES ...] [--walls .5 1 2 4 6] [--cells 6 4 3 2 1] [--record FILE.jsonl]

Each of the files (surfaces that `lacli mesh` takes without help) and the synthetic atrium of seed 1, open, is meshed by the
command in a process of its own with quadratic cells. With ``--record`` what is done is kept, and a later call goes on.

A cell that is wider than high has a small scaled Jacobian however well it is shaped: beside the smallest of a mesh stands that of
the best cell of its height and width, and what part of it the mesh's worst reaches.

Asked: none inverted, a third of the best, every refusal a message, at most 4 GB.
"""

from __future__ import annotations

import argparse
import itertools
import json
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyvista as pv
import records

from lacli.geometry.tetrahedra import scaled_jacobian
from lacli.synthetic.variants import make

SHARE, MOST_MB = 1 / 3, 4096.0  # asked
LIMIT_CPU_S = 900
LACLI = [sys.executable, "-c", "from lacli.cli.main import run; run()"]
SYNTHETIC = "synthetic"
# the command with a limit on its processor time, its usage as the last line
TIMED = f"""
import json, resource, subprocess, sys
limit = lambda: resource.setrlimit(resource.RLIMIT_CPU, ({LIMIT_CPU_S}, {LIMIT_CPU_S}))
code = subprocess.run(sys.argv[1:], preexec_fn=limit).returncode
used = resource.getrusage(resource.RUSAGE_CHILDREN)
print(json.dumps(dict(cpu_s=used.ru_utime + used.ru_stime, mb=used.ru_maxrss / 1024)), file=sys.stderr)
sys.exit(code if code >= 0 else 128 - code)
"""


@dataclass(frozen=True)
class Row:
    """A mesh: file, wall and cells asked (mm); what went wrong ("" nothing); smallest scaled and curved Jacobian, number of
    cells, inverted ones, mean edge (mm); median thickness of the thinnest region (mm); cost."""

    file: str
    wall_mm: float
    cells_mm: float
    wrong: str
    jacobian: float
    curved: float
    cells: int
    inverted: int
    edge_mm: float
    thinnest_mm: float
    notes: str
    cpu_s: float
    mb: float


def best(high: float, wide: float) -> float:
    """The smallest scaled Jacobian of an upright prism on an equilateral triangle, split into three tetrahedra."""
    base = wide * np.array([[0, 0, 0], [1, 0, 0], [0.5, np.sqrt(0.75), 0]])
    points = np.vstack([base, base + np.array([0, 0, high])])
    return float(scaled_jacobian(points, np.array([[0, 1, 2, 5], [0, 1, 5, 4], [0, 4, 5, 3]])).min())


def one(name: str, file: Path, wall: float, cells: float) -> Row:
    """Mesh by the command."""
    with tempfile.TemporaryDirectory() as place:
        words = [*LACLI, "mesh", str(file), "--out", f"{place}/anatomy", "--no-pictures", "--json"]
        words += ["--thickness-mm", str(wall), "--cell-size-mm", str(cells)]
        run = subprocess.run([sys.executable, "-c", TIMED, *words], capture_output=True, text=True, check=False)
    *lines, last = run.stderr.strip().splitlines()
    used = json.loads(last)
    if run.returncode:
        words = ["TRACEBACK " * ("Traceback" in run.stderr), f"exit {run.returncode}: " * (run.returncode != 1), *lines]
        return Row(name, wall, cells, " ".join(words)[-300:].strip(), 0.0, 0.0, 0, 0, 0.0, 0.0, "", **used)
    got = json.loads(run.stdout)
    thinnest = min(region["laplace"] for region in got["thickness_mm"].values())
    notes = "; ".join(note for note in got["notes"] if "wall" in note or "thin" in note)
    return Row(name, wall, cells, "", got["scaled_jacobian_min"], got["curved_jacobian_min"], got["cells"], got["inverted_cells"],
               got["mean_edge_mm"], thinnest, notes, **used)  # fmt: skip


def ideal(row: Row) -> float:
    """``best`` for the height and width that were asked for."""
    return best(row.wall_mm / max(1, round(row.wall_mm / row.cells_mm)), row.cells_mm)


def words(row: Row) -> str:
    """A line."""
    start = f"{row.file:16s}{row.wall_mm:5g}{row.cells_mm:6g}"
    if row.wrong:
        return f"{start}  {row.cpu_s:5.0f} CPU s {row.mb:6.0f} MB  REFUSED {row.wrong}"
    most = ideal(row)
    return (f"{start}{row.jacobian:8.3f}{most:7.3f}{row.jacobian / most:7.2f}{row.curved:8.3f}{row.inverted:5d}{row.cells:9d}"
            f"{row.edge_mm:7.2f}{row.thinnest_mm:7.2f}{row.cpu_s:7.0f}{row.mb:7.0f}  {row.notes}")  # fmt: skip


def main() -> None:
    """Mesh what is not in the record yet, and sum up all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", type=Path, nargs="*")
    parser.add_argument("--walls", type=float, nargs="+", default=[0.5, 1.0, 2.0, 4.0, 6.0])
    parser.add_argument("--cells", type=float, nargs="+", default=[6.0, 4.0, 3.0, 2.0, 1.0])
    parser.add_argument("--record", type=Path, help="file of rows, to go on with")
    choice = parser.parse_args()
    rows = records.read(choice.record, Row)
    print(f"{'file':16s}{'wall':>5}{'cells':>6}{'min SJ':>8}{'best':>7}{'share':>7}{'curved':>8}{'inv':>5}{'cells':>9}{'edge':>7}"
          f"{'thin':>7}{'CPU s':>7}{'MB':>7}")  # fmt: skip
    for row in rows:
        print(words(row))
    with tempfile.TemporaryDirectory() as place:
        files = {SYNTHETIC: Path(place) / "open.vtp"} | {file.name: file for file in choice.files}
        points, triangles, _ = make(1, "open")
        pv.PolyData.from_regular_faces(points, triangles).save(files[SYNTHETIC])
        for cells, name, wall in itertools.product(choice.cells, files, choice.walls):
            if not any((r.file, r.wall_mm, r.cells_mm) == (name, wall, cells) for r in rows):
                row = one(name, files[name], wall, cells)
                rows.append(row)
                records.add(choice.record, row)
                print(words(row), flush=True)
    made = [row for row in rows if not row.wrong]
    share = min((row.jacobian / ideal(row) for row in made), default=0.0)
    print(f"{len(made)} of {len(rows)} meshed, {sum('TRACEBACK' in row.wrong for row in rows)} tracebacks")
    print(f"inverted cells {sum(row.inverted for row in made)} (asked 0); worst over best {share:.2f} (asked {SHARE:.2f}); "
          f"MB at most {max(row.mb for row in rows):.0f} (asked {MOST_MB:.0f})")  # fmt: skip


if __name__ == "__main__":
    main()
