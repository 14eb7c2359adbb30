"""What a mesh's layers, curved cells and graded sizes buy: difference from a fine mesh, unknowns, CPU seconds. Real atrium.

    python benchmarks/meshes.py [--size 4] [--finest 2] [--only uniform layers ...] [--set KEY=VALUE] [--data DIR] [--out DIR]

Rodero et al. 2021, case 01, wall of 2 mm, quadratic cells. Variants of cells of --size mm: ``uniform`` (as `lacli mesh` makes
them; also of 5/4 and 7/8 of the size), ``layers`` (two through the wall), ``straight`` (all edge middles on the chords), ``rims``
(those of the rims alone), ``graded`` (7/8 and 3/4 of the size where the wall bends by .2 rad along an edge, up to 1.7 and 2 times
as long where it bends less, growing by .15 mm a mm), ``thickness`` (a wall of 1 - 3 mm, one layer, uniform and graded by the
square root of the thickness; against a fine mesh of its own). Displacements at end-systole over the regions of the finest mesh.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from unittest import mock

import numpy as np
from numpy.typing import NDArray
from real_atrium import DATA, FEATURES, FILES, displacement
from scipy.spatial import cKDTree

from lacli.anatomy.coordinates.describe import describe
from lacli.anatomy.inputs.meshes.tagged import read_mesh
from lacli.anatomy.remeshing import bends, remesh
from lacli.anatomy.wall.shell import mesh_shell
from lacli.contracts import bundle as bundles
from lacli.contracts.bundle import Bundle
from lacli.contracts.labels import REGIONS, is_plane
from lacli.contracts.motion import save_motion
from lacli.contracts.scene import build_scene
from lacli.geometry.surface import Surface, unique_edges
from lacli.geometry.tetrahedra import TET10_EDGES
from lacli.mechanics.simulation import RunResult, run_scene
from lacli.motion.annulus import descend

THICKNESS_MM, TURN, GROWTH, SMOOTHING_MM = 2.0, 0.2, 0.15, 3.0
SETTINGS = ("outputs.fields=es", "outputs.unloaded=false", "numerics.timeout_s=7200")
Wanted = Callable[[Surface, float], NDArray[np.float64]]  # cavity, cell size -> edge length (n,) mm at its points
Floats = NDArray[np.float64]


def thick(points: Floats) -> Floats:
    """A wall of 1 to 3 mm (n,) that varies from left to right."""
    x = points[:, 0]
    return np.asarray(2.0 + np.sin(np.pi * (x - x.mean()) / np.ptp(x)))


def by_bending(most: float) -> Wanted:
    """The size where the wall turns by TURN along an edge, up to ``most`` times it where it turns less."""

    def wanted(surface: Surface, size: float) -> Floats:
        bend, _, _ = bends.bending(surface, SMOOTHING_MM)
        return np.where(bend > 0, np.clip(TURN / np.maximum(bend, 1e-9), size, most * size), size)

    return wanted


def by_thickness(surface: Surface, size: float) -> Floats:
    """The size times the square root of the thickness over its mean."""
    return np.asarray(size * np.sqrt(thick(surface.points) / THICKNESS_MM))


@contextmanager
def graded(wanted: Wanted) -> Iterator[None]:
    """Remeshing to these lengths, no shorter than where rims and folds ask for less."""
    plain = remesh._size_field

    def field(surface: Surface, size: float) -> Callable[[Floats], Floats]:
        tight = plain(surface, size)
        edges, _ = unique_edges(surface.triangles)
        length = np.linalg.norm(np.diff(surface.points[edges], axis=1)[:, 0], axis=1)
        local = bends.grown(wanted(surface, size), edges, length, GROWTH)
        tree = cKDTree(surface.points)

        def asked(points: Floats) -> Floats:
            distance, near = (np.asarray(x) for x in tree.query(points))
            there, small = local[near] + GROWTH * distance, tight(points)
            return np.where(small < 0.999 * size, np.minimum(small, there), there)

        return asked

    with mock.patch.object(remesh, "_size_field", field):
        yield


def straightened(bundle: Bundle, rims_alone: bool) -> Bundle:
    """Edge middles on the chords: all, or those of edges that wall and a plane share."""
    points, tets = bundle.points.copy(), bundle.tets
    tags = bundle.tags
    planes = np.unique(bundle.triangles[is_plane(tags)])
    walls = np.unique(bundle.triangles[~is_plane(tags)])
    shared = np.zeros(len(points), dtype=bool)
    shared[np.intersect1d(planes, walls)] = True
    for i, (a, b) in enumerate(TET10_EDGES):
        middle = tets[:, 4 + i]
        here = shared[middle] if rims_alone else np.ones(len(tets), dtype=bool)
        points[middle[here]] = (points[tets[here, a]] + points[tets[here, b]]) / 2
    return replace(bundle, points=points)


def variants(cavity: Surface, size: float, finest: float) -> dict[str, dict[str, Callable[[], Bundle]]]:
    """By kind and name: what makes the bundle; the kinds "uniform" and "thickness" have the finest mesh first."""

    def plain(cells: float, wall: float | Floats = THICKNESS_MM, layers: int | None = None) -> Callable[[], Bundle]:
        return lambda: mesh_shell(cavity, wall, cells, layers=layers)

    def sized(cells: float, wanted: Wanted, wall: float | Floats = THICKNESS_MM) -> Callable[[], Bundle]:
        def make() -> Bundle:
            with graded(wanted):
                return mesh_shell(cavity, wall, cells, layers=1)

        return make

    varying = thick(cavity.points)
    return {
        "uniform": {f"{cells:g} mm": plain(cells) for cells in (finest, 1.25 * size, size, 0.875 * size)},
        "layers": {f"{size:g} mm, 2 layers": plain(size, layers=2)},
        "straight": {f"{size:g} mm, straight": lambda: straightened(plain(size)(), False)},
        "rims": {f"{size:g} mm, rims straight": lambda: straightened(plain(size)(), True)},
        "graded": {
            f"{share * size:g} mm, up to {most:g} times": sized(share * size, by_bending(most))
            for share, most in ((0.875, 1.7), (0.75, 2.0))
        },
        "thickness": {
            f"1 - 3 mm wall, {finest:g} mm": plain(finest, varying, 1),
            f"1 - 3 mm wall, {size:g} mm": plain(size, varying, 1),
            f"1 - 3 mm wall, {size:g} mm graded": sized(size, by_thickness, varying),
        },
    }


def simulated(make: Callable[[], Bundle], name: str, overrides: list[str], out: Path) -> tuple[Path, RunResult]:
    """The variant's bundle, made once, and its run."""
    folder = out / "bundles" / name.replace(" ", "_").replace(",", "")
    if not folder.is_dir():
        bundle = describe(make(), rule="laplace-dirichlet").bundle
        bundles.save(bundle, folder)
        save_motion(descend(bundle, descent_mm=8.0, circumference_change=0.0), folder)
    scene = build_scene({"anatomy": {"bundle": str(folder.resolve())}}, [*SETTINGS, *overrides], folder=folder, where="meshes")
    return folder, run_scene(scene, out / "runs")


def regional(folder: Path, run: RunResult, fine: tuple[Floats, Floats] | None) -> tuple[list[float], tuple[Floats, Floats]]:
    """Volume and mean displacements over the regions of the fine mesh (its points and regions; None: this is it)."""
    points, area, length, region = displacement(folder, run.folder)
    fine = (points, region) if fine is None else fine
    region = fine[1][cKDTree(fine[0]).query(points)[1]]
    means = [float((area * length)[region == k].sum() / area[region == k].sum()) for k in REGIONS.values()]
    return [run.features["esv_ml"], float((area * length).sum() / area.sum()), *means], fine


def main() -> None:
    """Make, run, and print."""
    kinds = ("uniform", "layers", "straight", "rims", "graded", "thickness")
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=float, default=4.0)
    parser.add_argument("--finest", type=float, default=2.0)
    parser.add_argument("--only", nargs="+", choices=kinds, default=list(kinds))
    parser.add_argument("--set", action="append", default=[], dest="overrides")
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--out", type=Path, default=Path("results/meshes"))
    choice = parser.parse_args()
    if not choice.data.is_dir():
        raise SystemExit(f"{choice.data}: no such folder; examples/rodero/README.md says where to get the data.")
    cavity = read_mesh(*(choice.data / name for name in FILES), "Left atrium").cavity
    head = f"{'mesh':34s} {'unknowns':>9s} {'systems':>8s} {'CPU s':>7s}  off: volume %, mm: "
    print(head + " ".join(FEATURES[1:]), flush=True)
    exact: dict[bool, tuple[list[float], tuple[Floats, Floats]]] = {}
    for kind, made in variants(cavity, choice.size, choice.finest).items():
        if kind not in choice.only and kind != "uniform":
            continue
        for i, (name, make) in enumerate(made.items()):
            if kind == "uniform" and i and kind not in choice.only:
                continue
            folder, run = simulated(make, name, choice.overrides, choice.out)
            if run.status != "done":
                print(f"{name:34s} {run.kind}: {run.message}", flush=True)
                continue
            other = kind == "thickness"
            values, fine = regional(folder, run, exact[other][1] if other in exact else None)
            wanted = exact.setdefault(other, (values, fine))[0]
            off = [100 * (values[0] / wanted[0] - 1), *(v - w for v, w in zip(values[1:], wanted[1:], strict=True))]
            f = run.features
            print(
                f"{name:34s} {f['unknowns']:9d} {f['newton_iterations']:8d} {run.manifest['cpu_s']:7.1f}  "
                + " ".join(f"{v:7.3f}" for v in off) + f"  worst {max(map(abs, off[1:])):.3f} mm", flush=True,
            )  # fmt: skip


if __name__ == "__main__":
    main()
