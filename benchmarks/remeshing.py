"""Our remesher beside Mmg's (``pip install mmgpy``) on labelled cavities: CPU seconds, quality, borders, closedness.

``python benchmarks/remeshing.py [FILE ...] [--sizes 4 2 1]``: the synthetic cavity, then each surface file, as ``lacli mesh``
cuts and labels it. Mmg gets the edges between labels as edges of their own, with each pair of hausd (of the size) and hgrad,
with and without (``smooth``) its own search for sharp edges, in a process of its own that has 10 s; once the cavity as it is,
once with its label borders evened before (``evened``: an edge of a border shorter than 0.3 of the size is collapsed along the
border). Of each of the two the setting with the best least quality is shown, of all that ended and of those as coarse as
ours. ``border_mm``: farthest point of the new borders from the old ones; ``edges``: of the borders; ``open``: what is wrong
with the closed surface. Quality: twice the area over the squared longest edge, 1 for an equilateral triangle.
"""

from __future__ import annotations

import argparse
import itertools
import logging
import multiprocessing
import time
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from lacli.anatomy import build
from lacli.anatomy.inputs.meshes import anything
from lacli.anatomy.remeshing.projection import Reference, border_edges
from lacli.anatomy.remeshing.remesh import remesh_on
from lacli.anatomy.wall import shell
from lacli.base.arrays import FloatArray
from lacli.geometry.surface import Surface, compact, defects
from lacli.geometry.triangles import shape_quality
from lacli.synthetic.atrium import synthesize

HAUSD, HGRAD = (0.01, 0.05, 0.2, 0.5), (1.1, 1.3, 1.6)  # of the size; ratio of neighbouring edges
PATIENCE_S = 10.0
SHORT = 0.3  # of the size asked: shorter edges of a border are collapsed before Mmg
_Caught = type("_Caught", (Exception,), {})


def labelled(make: object) -> Surface:
    """The labelled cavity that ``make`` was about to remesh."""
    found: list[Surface] = []

    def catch(reference: Reference, size_mm: float) -> Surface:
        found.append(compact(reference.surface))
        raise _Caught

    before, shell.remesh_on = shell.remesh_on, catch  # type: ignore[assignment]
    try:
        make()  # type: ignore[operator]
    except _Caught:
        pass
    finally:
        shell.remesh_on = before
    return found[0]


def evened(surface: Surface, size_mm: float) -> Surface:
    """Without the shortest edges of the borders: of each such edge one end becomes the other, where only two such edges meet."""
    points, triangles, label = surface.points, surface.triangles, surface.label
    for _ in range(20):
        edges = border_edges(triangles, label)
        degree = np.bincount(edges.ravel(), minlength=len(points))
        length = np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1)
        goes = np.arange(len(points))
        busy = np.zeros(len(points), dtype=bool)
        for k in np.argsort(length):
            a, b = edges[k]
            if length[k] >= SHORT * size_mm:
                break
            if degree[b] != 2:
                a, b = b, a
            ring = np.unique(triangles[(triangles == b).any(axis=1) | (triangles == a).any(axis=1)])
            if degree[b] != 2 or busy[ring].any():
                continue
            near_a, near_b = (np.setdiff1d(np.unique(triangles[(triangles == v).any(axis=1)]), [a, b]) for v in (a, b))
            if len(np.intersect1d(near_a, near_b)) == 2:  # the surface stays a manifold
                goes[b] = a
                busy[ring] = True
        if not busy.any():
            break
        moved = goes[triangles]
        proper = (moved[:, 0] != moved[:, 1]) & (moved[:, 1] != moved[:, 2]) & (moved[:, 2] != moved[:, 0])
        triangles, label = moved[proper], label[proper]
    return compact(Surface(points, triangles, label))


def by_mmg(surface: Surface, size_mm: float, hausd: float, hgrad: float, sharp: bool) -> tuple[Surface, float]:
    """Mmg's surface remesher at a constant size, labels as references, and its CPU seconds; hausd in units of the size."""
    from mmgpy import MmgMeshS

    begin = time.process_time()
    mesh = MmgMeshS()
    edges = border_edges(surface.triangles, surface.label)
    mesh.set_mesh_size(vertices=len(surface.points), triangles=len(surface.triangles), edges=len(edges))
    mesh.set_vertices(surface.points)
    mesh.set_triangles(surface.triangles.astype(np.int32), surface.label.astype(np.int64))
    mesh.set_edges(edges.astype(np.int32), np.ones(len(edges), dtype=np.int64))
    options = {"hmin": 0.3 * size_mm, "hmax": 1.3 * size_mm, "hsiz": size_mm, "hausd": hausd * size_mm, "hgrad": hgrad}
    mesh.remesh(**options, **({} if sharp else {"angle": 0}), verbose=-1)
    triangles, label = mesh.get_triangles_with_refs()
    after = Surface(np.asarray(mesh.get_vertices()), np.asarray(triangles, dtype=np.int64), np.asarray(label, dtype=np.int64))
    return after, time.process_time() - begin


def row(name: str, before: Surface, after: Surface, cpu_s: float) -> str:
    """One line of the table."""
    quality = shape_quality(after.points[after.triangles])
    edges = border_edges(after.triangles, after.label)
    old = before.points[border_edges(before.triangles, before.label)]
    share = np.linspace(0.0, 1.0, 21)[None, :, None]
    along: FloatArray = (old[:, :1] * (1 - share) + old[:, 1:] * share).reshape(-1, 3)
    off = float(cKDTree(along).query(after.points[np.unique(edges)])[0].max())
    said = defects(after.triangles) or "no"
    return (
        f"  {name:12s} {cpu_s:6.2f} s  triangles {len(quality):6d}  quality mean {quality.mean():.3f} min {quality.min():.3f}"
        f"  border_mm {off:.3f}  edges {len(edges):5d}  open {said}  volume {after.volume_ml() - before.volume_ml():+.2f} mL"
    )


def best(way: str, surface: Surface, given: Surface, size_mm: float, count: int) -> str:
    """The rows of Mmg's settings with the best least quality: of all, and of those with at most 1.5 times as many triangles as
    ours (``count``). Raises RuntimeError where none ended."""
    rows = []
    for hausd, hgrad, sharp in itertools.product(HAUSD, HGRAD, (True, False)):
        with multiprocessing.get_context("fork").Pool(1) as pool:  # some settings never end
            try:
                after, cpu_s = pool.apply_async(by_mmg, (given, size_mm, hausd, hgrad, sharp)).get(PATIENCE_S)
            except (RuntimeError, ValueError, multiprocessing.TimeoutError):
                continue
        least = float(shape_quality(after.points[after.triangles]).min())
        rows.append(
            (
                len(after.triangles) <= 1.5 * count,
                least,
                row(way, surface, after, cpu_s),
                f"hausd {hausd:g}, hgrad {hgrad:g}{'' if sharp else ', smooth'}",
            )
        )
    if not rows:
        raise RuntimeError("no setting ended")
    alike = [one for one in rows if one[0]]
    chosen = [max(rows, key=lambda one: one[1]), *([max(alike, key=lambda one: one[1])] if alike else [])]
    words = (f"best of {len(rows)}", f"best of {len(alike)} as coarse as ours")
    return "\n".join(f"{text}  ({setting}: {said})" for (_, _, text, setting), said in zip(chosen, words, strict=False))


def compare(name: str, surface: Surface, sizes: list[float]) -> None:
    """The rows of one cavity."""
    for size in sizes:
        print(f"{name}, {size:g} mm", flush=True)
        count = 0
        for way in ("ours", "mmg", "evened + mmg"):
            begin = time.process_time()
            try:
                if way == "ours":
                    after = remesh_on(Reference(surface), size)
                    count = len(after.triangles)
                    print(row(way, surface, after, time.process_time() - begin), flush=True)
                else:
                    print(best(way, surface, evened(surface, size) if way != "mmg" else surface, size, count), flush=True)
            except (RuntimeError, ValueError) as error:
                print(f"  {way:12s} failed: {error}", flush=True)


def main() -> None:
    """Parse and run."""
    logging.disable()
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="*", type=Path)
    parser.add_argument("--sizes", nargs="+", type=float, default=[4.0, 2.0, 1.0])
    given = parser.parse_args()
    compare("synthetic", labelled(lambda: synthesize(3, cell_size_mm=4.0)), given.sizes)
    for file in given.files:
        mesh = anything.read(file)
        compare(file.name, labelled(lambda mesh=mesh: build.from_mesh(mesh, build.Options(), say=lambda *_: None)), given.sizes)


if __name__ == "__main__":
    main()
