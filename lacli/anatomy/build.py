"""The road from an image or a surface to an anatomy bundle."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from lacli.anatomy.coordinates import describe as coordinates
from lacli.anatomy.inputs import extraction
from lacli.anatomy.inputs.image import Image
from lacli.anatomy.inputs.repair import Repaired, voxels
from lacli.anatomy.openings import branches, clipping, landmarks, ostium
from lacli.anatomy.openings.landmarks import LPS, Axes, Landmarks, Opening
from lacli.anatomy.openings.mitral import lv_contact, mitral_from_contact, mitral_from_shape
from lacli.anatomy.wall.shell import mesh_shell
from lacli.base.arrays import FloatArray
from lacli.base.errors import AnatomyError
from lacli.contracts.bundle import Bundle
from lacli.contracts.labels import OPENINGS, PLANES
from lacli.geometry.surface import Surface

Say = Callable[[str], None]
LEAST_WALL_MM = 1.0
LEAST_VALVE_MM = 50.0  # rim length
RIM_INSET_MM = 1.0  # an uneven rim is cut flat this far inside


@dataclass(frozen=True)
class Options:
    """What the user chooses: cell size and wall thickness (mm), element order, ring width (mm), fibre rule."""

    cell_size_mm: float = 3.5
    thickness_mm: float = 2.0
    order: int = 2
    ring_width_mm: float = 2.5
    fibre_rule: str = "laplace-dirichlet"
    smoothing_mm: float | None = None
    layers: int | None = None


@dataclass(frozen=True)
class Built:
    """The bundle, the landmarks used, the closed cavity surface, and what was done in words."""

    bundle: Bundle
    landmarks: Landmarks
    cavity: Surface
    notes: tuple[str, ...]
    measures: dict[str, Any] = field(default_factory=dict)


def from_labels(
    labels: Image,
    la: int,
    lv: int | None,
    options: Options,
    given: Landmarks | None = None,
    say: Say = print,
    wall: int | None = None,
) -> Built:
    """Bundle from a label map; ``la``, ``lv``: labels of the left atrium's and ventricle's blood, ``wall``: of its wall."""
    say("finding the blood pool")
    pool = extraction.blood_pool(labels, la)
    notes = list(pool.notes)
    say("smoothing")
    grid = float(np.clip(0.4 * options.cell_size_mm, 0.4, 0.8))
    surface = extraction.surface_of(pool.mask, options.smoothing_mm, grid)
    contact = None if lv is None else lv_contact(labels, lv, surface)
    if lv is not None and contact is None:
        notes.append(f"label {lv} does not touch the atrium: the mitral plane is found from the shape")
    outer = None if wall is None else outer_surface(labels, la, wall, surface, options, notes)
    return _from_closed(surface, contact, LPS, options, given, say, notes, pool.mask, outer)


def outer_surface(labels: Image, la: int, wall: int, inner: Surface, options: Options, notes: list[str]) -> Surface:
    """The wall's outer surface from its label; where the label has holes it keeps LEAST_WALL_MM from the blood.

    Raises AnatomyError where the label is absent or covers less than half of the blood pool.
    """
    if not (labels.array == wall).any():
        raise AnatomyError(f"label {wall} (atrial wall) has no voxel in the image.")
    both = labels.with_array(np.isin(labels.array, (la, wall)).astype(np.uint8))
    pool = extraction.blood_pool(both, 1)
    blood = labels.with_array(labels.array == la).crop(*_box(pool.mask, labels))
    depth = ndimage.distance_transform_edt(~blood.array, sampling=labels.spacing[::-1])
    filled = (depth <= LEAST_WALL_MM) & ~pool.mask.array
    share = float(filled.sum()) / max(float((depth <= LEAST_WALL_MM).sum() - blood.array.sum()), 1.0)
    if share > 0.5:
        raise AnatomyError(
            f"label {wall} covers only {100 * (1 - share):.0f} % of the blood pool's surface; is it the atrial wall?"
        )
    if filled.any():
        notes.append(
            f"{100 * share:.1f} % of the wall next to the blood had no label; it was given {LEAST_WALL_MM:g} mm (openings too)"
        )
    return extraction.surface_of(pool.mask.with_array(pool.mask.array | filled), options.smoothing_mm, 0.8)


def _box(mask: Image, labels: Image) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    low = np.round(labels.to_index(mask.origin[None])[0]).astype(int)
    return low, low + np.array(mask.array.shape[::-1])


def from_surface(
    repaired: Repaired, options: Options, given: Landmarks | None = None, axes: Axes | None = None, say: Say = print
) -> Built:
    """Bundle from a repaired surface; ``axes`` None: left and right are told from the shape."""
    openings = openings_of_rims(repaired)
    notes = list(repaired.notes)
    if repaired.rims and not openings:
        notes.append(
            f"the longest rim is {repaired.rims[0].length_mm:.0f} mm, no valve's ({LEAST_VALVE_MM:.0f} mm): all closed as holes"
        )
    return _from_closed(repaired.surface, openings, axes, options, given, say, notes, None)


def openings_of_rims(repaired: Repaired) -> list[Opening]:
    """The openings that an open surface came with, as cuts just inside their rims, the longest first.

    Where the longest is not as long as a valve's, all are damage. Five or six are valve, veins and appendage; of fewer only the
    valve is taken, the vessels are found from the shape.
    """
    rims = list(repaired.rims) if repaired.rims and repaired.rims[0].length_mm >= LEAST_VALVE_MM else []
    rims = rims[:6] if len(rims) >= 5 else rims[:1]
    return [
        Opening(
            "",
            r.centre - RIM_INSET_MM * r.normal,
            r.normal,
            r.centre + 0.5 * r.normal,
            r.length_mm / np.pi,
            0.9,
            "opening of the surface",
        )
        for r in rims
    ]


def _from_closed(
    surface: Surface,
    contact: FloatArray | list[Opening] | None,
    axes: Axes | None,
    options: Options,
    given: Landmarks | None,
    say: Say,
    notes: list[str],
    mask: Image | None,
    outer: Surface | None = None,
) -> Built:
    say("finding valve, veins and appendage")
    found = find_landmarks(surface, contact, axes, given, mask, options.ring_width_mm)
    notes += found.notes
    say("cutting")
    cavity = clip(surface, found)
    say("meshing the wall")
    bundle = _shell(cavity, options, outer, notes)
    say("coordinates, regions, fibres")
    described = coordinates.describe(bundle, found.sides, options.fibre_rule)
    if described.islands:
        notes.append(f"{described.islands} floating elements took the region around them")
    measures: dict[str, Any] = {
        "surface_volume_ml": surface.volume_ml(),
        "clipped_surface_volume_ml": cavity.volume_ml(),
        "cavity_volume_ml": described.bundle.cavity_volume_ml(),
    }
    if mask is not None:
        measures["voxel_volume_ml"] = float(mask.array.sum()) * mask.voxel_ml
        measures["clipped_voxel_volume_ml"] = clipped_voxels_ml(mask, cavity)
    return Built(described.bundle, found, cavity, tuple(notes), measures)


def _shell(cavity: Surface, options: Options, outer: Surface | None, notes: list[str]) -> Bundle:
    """The wall's cells; where the surface bends too tightly for the size, smaller ones."""
    for factor in (1.0, 0.8, 0.64, 0.5):
        try:
            bundle = mesh_shell(
                cavity,
                options.thickness_mm,
                factor * options.cell_size_mm,
                order=options.order,
                outer=outer,
                layers=options.layers,
                ring_width_mm=options.ring_width_mm,
            )
        except AnatomyError:
            if factor == 0.5:
                raise
            continue
        if factor < 1.0:
            notes.append(
                f"cells of {options.cell_size_mm:g} mm do not fit this surface: {factor * options.cell_size_mm:.2g} mm were used"
            )
        return bundle
    raise AssertionError("unreachable")


def find_landmarks(
    surface: Surface,
    contact: FloatArray | list[Opening] | None,
    axes: Axes | None,
    given: Landmarks | None = None,
    mask: Image | None = None,
    ring_mm: float = 2.5,
) -> Landmarks:
    """Every opening of a closed surface, found from its shape, its contact with the ventricle, and what was given.

    ``contact``: points that face the ventricle, or the openings that the surface had before it was closed.
    """
    if given is not None and set(OPENINGS) - {"appendage"} <= set(given.openings):
        return given
    field = (
        voxel_field(surface, 1.0)
        if mask is None
        else extraction.smooth_field(mask, max(0.8, 0.8 * float(mask.spacing.max())), 1.0)
    )
    skeleton = branches.find(field)
    notes: list[str] = []
    if given is not None and "mv" in given.openings:
        mitral = given.openings["mv"]
    elif isinstance(contact, list) and contact:
        mitral = replace(contact[0], name="mv")
    elif contact is not None and not isinstance(contact, list):
        mitral = mitral_from_contact(surface, contact)
    else:
        mitral = mitral_from_shape(surface, skeleton)
        notes.append("the mitral plane was found from the shape alone: look at it, and correct it in landmarks.toml")
    vessels = contact[1:] if isinstance(contact, list) else []
    if len(vessels) >= 4:
        skeleton = with_rims(skeleton, vessels, mitral)
    named, confidence, words = landmarks.name_branches(skeleton, mitral.centre, axes)
    notes += words
    openings = {"mv": mitral}
    for name in sorted(named, key=lambda n: (OPENINGS.index(n) if n in OPENINGS else 99, n)):
        rim = next((v for v in vessels if v.centre is named[name].tip), None)
        if rim is not None:
            openings[name] = replace(rim, name=name, confidence=confidence[name])
        else:
            openings[name] = ostium.of_branch(name, named[name], confidence[name], ray_caster(field), ring_mm)
    return landmarks.override(Landmarks(openings, {}, tuple(notes)), given)


def with_rims(skeleton: branches.Skeleton, vessels: list[Opening], mitral: Opening) -> branches.Skeleton:
    """The openings as branches, and of the shape's branches those that end at no opening (a closed appendage)."""
    found = []
    for vessel in vessels:
        line = vessel.centre[None] + np.outer(np.arange(0.0, 6.0), vessel.normal)
        area = np.full(6, np.pi * vessel.diameter_mm**2 / 4)
        found.append(branches.Branch(line, area, np.arange(6.0), 0, vessel.centre, 5.0))
    everything = [*vessels, mitral]
    for branch in skeleton.branches:
        gap = min(float(np.linalg.norm(branch.tip - v.centre)) / max(v.diameter_mm, 1.0) for v in everything)
        if gap > 1.0:
            found.append(branch)
    return branches.Skeleton(skeleton.middle, skeleton.radius_mm, tuple(found))


def voxel_field(surface: Surface, spacing_mm: float) -> Image:
    """A closed surface as a field, about 1 inside and 0 outside, on an isotropic grid."""
    field = voxels(surface, spacing_mm)
    return field.with_array(ndimage.gaussian_filter(field.array, 0.7))


def ray_caster(field: Image, reach_mm: float = 25.0, step_mm: float = 0.25) -> Callable[[FloatArray, FloatArray], FloatArray]:
    """Distances (k,) mm from an inner point to where the field falls below one half along unit directions (k, 3)."""
    steps = np.arange(step_mm, reach_mm, step_mm)

    def cast(centre: FloatArray, directions: FloatArray) -> FloatArray:
        at = centre + steps[None, :, None] * directions[:, None]
        index = field.to_index(at.reshape(-1, 3))[:, ::-1].T
        value = ndimage.map_coordinates(field.array, index, order=1, mode="constant").reshape(len(directions), -1)
        outside = value < 0.5
        first = np.where(outside.any(axis=1), np.argmax(outside, axis=1), len(steps) - 1)
        rows = np.arange(len(directions))
        after, before = value[rows, first], np.where(first > 0, value[rows, np.maximum(first - 1, 0)], 1.0)
        share = np.clip((before - 0.5) / np.maximum(before - after, 1e-6), 0.0, 1.0)
        return steps[first] - step_mm * (1.0 - share)

    return cast


def clip(surface: Surface, found: Landmarks) -> Surface:
    """Cut all openings, the mitral valve last; veins beyond four are cut and closed as wall."""
    for name in sorted(found.openings, key=lambda n: (n == "mv", n)):
        opening = found.openings[name]
        surface = clipping.cut(surface, opening.centre, opening.normal, opening.beyond, PLANES.get(name, 0), name.upper())
    return surface


def clipped_voxels_ml(mask: Image, cavity: Surface) -> float:
    """Volume of the mask's voxels on the inner side of the planes: voxels nearer to no removed piece than to the cavity.

    A voxel counts if it is inside the mask and not past a plane within that plane's own opening (and what hangs beyond it).
    """
    kept = mask.array.copy()
    index = np.argwhere(kept)[:, ::-1]
    world = mask.to_world(index)
    past = np.zeros(len(world), dtype=bool)
    middle = cavity.points[cavity.triangles].mean(axis=1)
    for name in OPENINGS:
        plane = cavity.label == PLANES[name]
        if not plane.any():
            continue
        normal = cavity.area_vectors()[plane].sum(axis=0)
        normal /= np.linalg.norm(normal)
        centre = np.average(middle[plane], axis=0, weights=cavity.areas()[plane])
        height = (world - centre) @ normal
        beyond = np.zeros(mask.array.shape, dtype=bool)
        beyond[tuple(index[height > 0][:, ::-1].T)] = True
        parts, _ = ndimage.label(beyond)
        of_voxel = parts[tuple(index[:, ::-1].T)]
        radius = np.linalg.norm(world - centre - height[:, None] * normal, axis=1)
        size = np.sqrt(cavity.areas()[plane].sum() / np.pi)
        touching = (height > 0) & (height < 1.5 * mask.spacing.max()) & (radius < size)
        names, counts = np.unique(of_voxel[touching], return_counts=True)
        if len(names):
            past |= of_voxel == names[int(np.argmax(counts))]
    return float((~past).sum()) * mask.voxel_ml
