"""Figures asked of the anatomy, against measured ones. Data in ../shared/data; run `python benchmarks/anatomy.py [name ...]`.

Names: heart, uac, fibres, thickness, rodero, fat, cohort. Without a name: all (about ten minutes on one core).
"""

from __future__ import annotations

import gzip
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from lacli.anatomy import build, quality
from lacli.anatomy.coordinates import fibres, regions, uac
from lacli.anatomy.cuts import clipping
from lacli.anatomy.cuts.cut import Cut
from lacli.anatomy.inputs import extraction, image, repair, voxels
from lacli.anatomy.inputs.meshes import tagged
from lacli.anatomy.openings import finding, ostium
from lacli.anatomy.openings.landmarks import Landmarks, Opening
from lacli.anatomy.wall import fat, shell, thickness
from lacli.contracts.labels import OPENINGS, PLANES
from lacli.geometry import curves as paths
from lacli.geometry import subdivision
from lacli.geometry.surface import Surface
from lacli.synthetic import atrium as synthetic
from lacli.synthetic import image as synthetic_image
from lacli.synthetic.shape import Shape

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


def show(what: str, asked: str, aim: str, measured: str) -> None:
    print(f"{what:<72} asked {asked:<14} aim {aim:<14} measured {measured}", flush=True)


def quiet(_: str) -> None:
    return None


def heart() -> None:
    """Whole-heart label map to a bundle at 2 mm cells."""
    start = time.process_time()
    labels = image.read(DATA / "whole_heart_labels" / "wh.nii.gz")
    built = build.from_labels(labels, 2, 3, build.Options(cell_size_mm=2.0), say=quiet)
    seconds = time.process_time() - start
    report, _ = quality.measure(built.bundle)
    error = built.bundle.cavity_volume_ml() / built.measures["clipped_voxel_volume_ml"] - 1.0
    show("heart: openings found", "6", "6", f"{len(built.landmarks.openings)} ({', '.join(built.landmarks.openings)})")
    show("heart: cavity volume against clipped voxels", "2 %", "0.5 %", f"{100 * error:+.3f} %")
    show("heart: scaled Jacobian min", ">= 0.05", ">= 0.2", f"{report['scaled_jacobian_min']:.3f}")
    show("heart: share of cells below 0.2", "<= 0.1 %", "0", f"{100 * report['scaled_jacobian_share_below_0.2']:.4f} %")
    show("heart: time at 2 mm cells, one core", "<= 180 s", "<= 30 s", f"{seconds:.1f} s CPU")


TAGS = {11: "", 13: "appendage", 21: "lspv", 23: "lipv", 25: "rspv", 27: "ripv"}


def atlas() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Points (mm), triangles, vessel names, reference coordinates, the four landmark points (mm) of la_atlas_uac."""
    folder = DATA / "la_atlas_uac"

    def table(name: str, columns: tuple[int, ...]) -> np.ndarray:
        with gzip.open(folder / name, "rt") as stream:
            return np.loadtxt(stream, skiprows=1, usecols=columns)

    points = table("Labelled.pts.gz", (0, 1, 2)) / 1000.0
    cells = table("Labelled.elem.gz", (1, 2, 3, 4)).astype(np.int64)
    reference = table("Labelled_Coords_2D_Rescaling_v3_C.pts.gz", (0, 1))
    marks = np.loadtxt(folder / "Landmarks.txt", delimiter=",") / 1000.0
    return points, cells[:, :3], np.array([TAGS[t] for t in cells[:, 3]]), reference, marks


def rim_of(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    return max(paths.loops(paths.open_edges(triangles)), key=lambda loop: paths.perimeter(points, loop))


def coordinates_of_atlas() -> None:
    points, triangles, vessel, reference, marks = atlas()
    mitral = rim_of(points, triangles)
    own = uac.coordinates(uac.Parts(points, triangles, vessel, mitral, *marks))
    _compare("uac, its own landmarks", own, reference, "0.03, 0.10", "0.01, 0.03")
    lines = lines_from(vessel, triangles, reference)
    area = np.linalg.norm(
        np.cross(points[triangles[:, 1]] - points[triangles[:, 0]], points[triangles[:, 2]] - points[triangles[:, 0]]), axis=1
    )
    body = vessel == ""
    theirs = regions.of_triangles(reference, triangles, lines)
    ours = regions.of_triangles(own, triangles, lines_from(vessel, triangles, own))
    agree = float((area * (ours == theirs))[body].sum() / area[body].sum())
    show("five regions, area that agrees (body of the atrium)", "93 %", "98 %", f"{100 * agree:.2f} %")
    sides = uac.coordinates(uac.Parts(points, triangles, vessel, mitral))
    _compare("uac, side lines and roof found, vessel tags given", sides, reference, "0.06, 0.15", "0.03, 0.08")
    found = auto_vessels(points, triangles)
    everything = uac.coordinates(uac.Parts(points, triangles, found, mitral))
    _compare(
        "uac, everything found from the bare surface (names, ostia, lines)", everything, reference, "0.06, 0.15", "0.03, 0.08"
    )


def auto_vessels(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Vessel of each triangle from the bare surface: its openings named, each followed inward to where it widens."""
    repaired = repair.repair(points, triangles)
    landmarks = finding.find(repaired.surface, repaired.rims, None).landmarks
    field = voxels.voxel_field(repaired.surface, 0.5)
    cavity = repaired.surface
    for name, opening in landmarks.openings.items():
        if name == "mv":
            continue
        inward = ostium.of_opening(opening, finding.ray_caster(field))
        cavity = clipping.cut(cavity, inward.centre, inward.normal, opening.beyond, PLANES[name], name)
    # a triangle belongs to a vessel if it lies past that vessel's plane: nearest point of what was kept is on the plane
    middle = points[triangles].mean(axis=1)
    kept = cavity.points[cavity.triangles].mean(axis=1)
    distance, _ = cKDTree(kept[cavity.label == 0]).query(middle)
    gone = distance > 0.3
    names = {v: n for n, v in PLANES.items()}
    planes = cavity.label > 0
    _, plane = cKDTree(kept[planes]).query(middle)
    label = cavity.label[planes][plane]
    vessel = np.array([names[int(v)] if g else "" for v, g in zip(label, gone, strict=True)])
    # each vessel in one piece
    for name in set(vessel) - {""}:
        mine = vessel == name
        _, part = paths.triangle_components(triangles, mine)
        vessel[mine & (part != np.argmax(np.bincount(part[mine])))] = ""
    count, part = paths.triangle_components(triangles, vessel == "")
    if count > 1:
        body = np.argmax(np.bincount(part[part >= 0]))
        for k in range(count):
            if k != body:
                inside = part == k
                beside = np.isin(triangles, triangles[inside]).any(axis=1) & (vessel != "")
                vessel[inside] = vessel[beside][0] if beside.any() else ""
    return vessel


def lines_from(vessel: np.ndarray, triangles: np.ndarray, uv: np.ndarray) -> regions.Lines:
    rim = np.unique(paths.open_edges(triangles))
    return regions.lines_of(*(uv[np.intersect1d(rim, triangles[vessel == name])] for name in ("rspv", "lipv")))


def _compare(name: str, own: np.ndarray, reference: np.ndarray, asked: str, aim: str) -> None:
    apart = np.abs(own - reference)
    for k, axis in enumerate(("alpha", "beta")):
        show(f"{name}: |{axis}| median, 95th", asked, aim, f"{np.median(apart[:, k]):.4f}, {np.percentile(apart[:, k], 95):.4f}")


def rule() -> None:
    import pyvista as pv

    folder = DATA / "la_laplace_reference"
    mesh = pv.read(folder / "la_input.vtu")
    points = np.asarray(mesh.points, dtype=float)
    tets = mesh.cells.reshape(-1, 5)[:, 1:].astype(np.int64)
    values = {"trans": (0.0, 1.0), "ab": (-1.0, 0.0, 1.0, 2.0), "v": (0.0, 1.0), "r": (0.0, 1.0)}
    sets = {n: {v: np.flatnonzero(np.abs(mesh.point_data[n] - v) < 1e-9) for v in vs} for n, vs in values.items()}
    fields = fibres.solve_fields(points, tets, sets)
    worst = {n: float(np.abs(f - mesh.point_data[n]).max()) for n, f in fields.items()}
    show("Laplace-Dirichlet fields, largest difference", "1e-5", "1e-6", ", ".join(f"{n} {w:.1e}" for n, w in worst.items()))
    skin = pv.read(folder / "la_endo.vtk").clean()
    _, ids = cKDTree(points).query(skin.points)
    endo = ids[skin.faces.reshape(-1, 4)[:, 1:]]
    ruled = fibres.laplace_dirichlet(points, tets, fields, fibres.endocardial_normals(points, tets, endo))
    show("cells of bundle 0 (33,097)", "0.5 %", "exact", str(int((ruled.bundle == 0).sum())))
    axis = np.abs(ruled.fibre[0] - [0.54939723, 0.77379318, -0.31528842]).max()
    show("first cell's axis", "1e-3", "1e-6", f"{axis:.1e}")


def sphere(radius: float = 20.0) -> Surface:
    import pyvista as pv

    ball = pv.Icosphere(radius=radius, nsub=5)
    triangles = ball.faces.reshape(-1, 4)[:, 1:].astype(np.int64)
    return Surface(np.asarray(ball.points, dtype=float), triangles, np.zeros(len(triangles), dtype=np.int64))


def shells() -> None:
    ball = sphere()
    graded = 1.5 + 0.5 * (ball.points[:, 2] / 20.0 + 1.0)
    for name, wall, exact in (
        ("2 mm", 2.0, lambda p: np.full(len(p), 2.0)),
        ("graded 1.5 - 2.5 mm", graded, lambda p: 1.5 + 0.5 * (p[:, 2] / 20.0 + 1.0)),
    ):
        bundle = shell.mesh_shell(ball, wall, 2.0)
        got = thickness.of_bundle(bundle)
        truth = exact(bundle.points[got.ids])
        for way, value in (("eikonal", got.eikonal), ("Laplace", got.laplace)):
            show(
                f"thickness of a {name} spherical shell, {way}, largest error",
                "3 %",
                "1 %",
                f"{100 * np.abs(value / truth - 1).max():.2f} %",
            )


def rodero() -> None:
    folder = DATA / "la_rodero01"
    for size in ("2.0", "1.5"):
        bundle = tagged.read_tagged(
            folder / f"LA_tets_{size}mm.vtu",
            folder / f"LA_surfaces_{size}mm.vtp",
            folder / f"rodero_01_fullheart_{size}mm.namemap.json",
        )
        got = thickness.of_bundle(bundle)
        show(
            f"la_rodero01 {size} mm: eikonal against Laplace, median of regional means",
            "0.13 mm",
            "0.05 mm",
            f"{got.median_difference_mm:.3f} mm",
        )


def fat_volume() -> None:
    for seed in (1, 2, 3):
        made = synthetic_image.images(seed)
        pool = extraction.surface_of(extraction.blood_pool(made.labels, synthetic_image.LA).mask)
        found = {w: fat.segment(made.ct, pool, None, w).volume_ml for w in fat.WINDOWS}
        words = ", ".join(f"{w} {100 * (v / made.fat_ml - 1):+.2f} %" for w, v in found.items())
        show(f"fat of {made.fat_ml:.2f} mL in the noisy CT, seed {seed}", "3 %", "1 %", words)


CELL_MM, VOXEL_MM = 4.0, 0.8


def cohort(seeds: range = range(1, 11)) -> None:
    """Image to bundle against the parametric truth, planes found and given; the truth is cut at the exact shape's ostia.

    One definition serves both sides (ostium.flare_end): the truth applies it to exact sections across the known axes, the
    road has to find axes, sections and slopes in the voxels.
    """
    volumes, agreements, given_volumes, named = [], [], [], 0
    for seed in seeds:
        truth, _ = synthetic.synthesize(seed, cell_size_mm=CELL_MM, at_ostia=True)
        shape = synthetic.sized(seed).at_ostia()
        exact = synthetic.cavity(shape).volume_ml()
        made = synthetic_image.images(seed, spacing_mm=(VOXEL_MM,) * 3)
        built = build.from_labels(
            made.labels, synthetic_image.LA, synthetic_image.LV, build.Options(cell_size_mm=CELL_MM), say=quiet
        )
        right = vein_names(shape, built.landmarks)
        named += right
        agreement = same_region(truth, built.bundle)
        volume = curved_volume_ml(built.bundle) / exact - 1.0
        cuts = Landmarks({opening_name(c.label): cut_of(c) for c in shape.cuts() if c.label != PLANES["mv"]})
        again = build.from_labels(
            made.labels, synthetic_image.LA, synthetic_image.LV, build.Options(cell_size_mm=CELL_MM), cuts, quiet
        )
        given_volume = curved_volume_ml(again.bundle) / exact - 1.0
        volumes.append(abs(volume))
        given_volumes.append(abs(given_volume))
        agreements.append(agreement)
        print(
            f"  seed {seed}: {exact:.1f} mL, planes found {100 * volume:+.2f} %, given {100 * given_volume:+.2f} %, "
            f"regions {100 * agreement:.1f} %, names {'right' if right else 'WRONG'}",
            flush=True,
        )
    show("ten anatomies: volume, planes found (worst)", "2 %", "1 %", f"{100 * max(volumes):.2f} %")
    show("ten anatomies: volume, the truth's vessel planes given (worst)", "2 %", "1 %", f"{100 * max(given_volumes):.2f} %")
    show(
        "ten anatomies: region agreement (worst, mean)",
        "90 %",
        "97 %",
        f"{100 * min(agreements):.1f} %, {100 * np.mean(agreements):.1f} %",
    )
    show("ten anatomies: all vessels named right", "10 of 10", "10 of 10", f"{named} of {len(seeds)}")


def curved_volume_ml(bundle) -> float:  # type: ignore[no-untyped-def]
    """Cavity volume of a bundle with 10-node cells, its faces bent: each as four flat triangles."""
    faces = bundle.triangles[(bundle.tags == 1) | (bundle.tags >= 21)]
    cavity = subdivision.straight(faces)[:, ::-1]
    return Surface(bundle.points, cavity, np.zeros(len(cavity), dtype=np.int64)).volume_ml()


def opening_name(label: int) -> str:
    return next(n for n, v in PLANES.items() if v == label)


def cut_of(cut: Cut) -> Opening:
    return Opening(
        opening_name(cut.label), cut.centre, cut.direction, cut.centre + 3.0 * cut.direction, cut.reach_mm, 1.0, "landmarks file"
    )


def vein_names(shape: Shape, found: Landmarks) -> bool:
    where = {opening_name(c.label): c.centre for c in shape.cuts()}
    for name in OPENINGS:
        if name not in found.openings:
            return False
        gaps = {n: float(np.linalg.norm(found.openings[name].centre - c)) for n, c in where.items()}
        if min(gaps, key=lambda n: gaps[n]) != name:
            return False
    return True


def same_region(truth, own) -> float:  # type: ignore[no-untyped-def]
    """Share of the truth's wall volume (regions 1 - 5) whose nearest cell of ours, a body cell too, has the same region."""
    from lacli.geometry.tetrahedra import volumes

    bodies = [b.region < 10 for b in (truth, own)]
    centre = [b.points[b.tets[m, :4]].mean(axis=1) for b, m in zip((truth, own), bodies, strict=True)]
    _, nearest = cKDTree(centre[1]).query(centre[0])
    weight = volumes(truth.points, truth.tets[bodies[0], :4])
    return float(np.average(own.region[bodies[1]][nearest] == truth.region[bodies[0]], weights=weight))


JOBS: dict[str, Callable[[], None]] = {
    "heart": heart,
    "uac": coordinates_of_atlas,
    "fibres": rule,
    "thickness": shells,
    "rodero": rodero,
    "fat": fat_volume,
    "cohort": cohort,
}

if __name__ == "__main__":
    for job in sys.argv[1:] or JOBS:
        JOBS[job]()
