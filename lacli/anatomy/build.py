"""The road from an image or a surface to an anatomy bundle."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy import ndimage

from lacli.anatomy.coordinates import describe as coordinates
from lacli.anatomy.cuts import closed_cut, trunk
from lacli.anatomy.cuts.closing import CAP
from lacli.anatomy.inputs import extraction, labelled, patches, repair, ripples, voxels
from lacli.anatomy.inputs.image import Image
from lacli.anatomy.inputs.meshes.anything import Mesh
from lacli.anatomy.inputs.patches import Tagged
from lacli.anatomy.inputs.repair import Repaired
from lacli.anatomy.openings import finding
from lacli.anatomy.openings.candidate import Candidate, place
from lacli.anatomy.openings.landmarks import LPS, Axes, Landmarks
from lacli.anatomy.openings.mitral import lv_contact, of_contact
from lacli.anatomy.openings.valve_tube import valve_tube
from lacli.anatomy.wall.offset import REACH
from lacli.anatomy.wall.shell import TooTightError, mesh_shell
from lacli.base.errors import AnatomyError
from lacli.contracts.bundle import Bundle
from lacli.contracts.labels import OPENINGS, PLANES
from lacli.geometry import curves as paths
from lacli.geometry.surface import Surface, nearest

Say = Callable[[str], None]
OUTER_GRID_MM = 0.8
BELOW_CONTACT = (
    "the annulus does not show between the labels of atrium and ventricle: the mitral valve was cut below their contact as it is "
    "on the smoothed surface, up to a voxel too far inside"
)
FOLD_DEG = 120.0  # between the normals of two triangles of the wall: a fold
FINE_MM, UNFOLD_MM = 0.6, 1.5  # voxels and smoothing of a surface whose folds no wall can follow
THINNED = 0.05  # share of the wall's points that may be thinner than asked without a word
UNMET = 0.01  # the same of those whose outer side as given is too near or too far to be the wall's


@dataclass(frozen=True)
class Options:
    """What the user chooses: cell size and wall thickness (mm), element order, ring width (mm), fibre rule; ``wave_mm``: shorter
    waves of the wall's surface are taken out (0: none; None: ``ripples.wave_of`` the voxels, none of a surface given)."""

    cell_size_mm: float = 3.5
    thickness_mm: float = 2.0
    order: int = 2
    ring_width_mm: float = 2.5
    fibre_rule: str = "laplace-dirichlet"
    smoothing_mm: float | None = None
    wave_mm: float | None = None
    layers: int | None = None
    accept_low_confidence: bool = False


@dataclass(frozen=True)
class Way:
    """A way to cut and wall an atrium: where its openings are, its closed surface, the wall's outer side (None: by thickness),
    and what is to be told of it."""

    openings: Landmarks
    surface: Surface
    outer: Surface | None
    note: str = ""


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
    vessels: Mapping[int, str] | None = None,
) -> Built:
    """Bundle from a label map; ``la``, ``lv``: labels of the left atrium's and ventricle's blood, ``wall``: of its wall,
    ``vessels``: of veins and appendage, where they have labels of their own (label -> opening, or candidate.VEIN)."""
    vessels = {} if vessels is None else vessels
    hint = labelled.unnamed(labels, la, {la, *vessels, *(k for k in (lv, wall) if k is not None)})
    try:
        return _of_labels(labels, la, lv, wall, vessels, options, given, say, [])
    except finding.OpeningsError as error:
        if not hint:
            raise
        some = f"label{'s' * (len(hint) > 1)} {', '.join(str(k) for k in hint)}"
        if vessels:
            words = f"{error} {some.capitalize()} touch the atrium: if they are its veins or its appendage, say so"
            raise finding.OpeningsError(f"{words} (--labels la={la},laa=...,pv=...).", error.readings, error.surface) from error
    # small labels that touch an atrium which lacks openings: its vessels, if they can be named as such
    note = f"{some} touch the atrium and were taken as its vessels (--labels says what they are)"
    try:
        return _of_labels(labels, la, lv, wall, dict.fromkeys(hint, ""), options, given, say, [note])
    except finding.OpeningsError as error:
        words = f"{error} {some.capitalize()} touch the atrium and were taken as its vessels: say what they are"
        raise finding.OpeningsError(f"{words} (--labels la={la},laa=...,pv=...).", error.readings, error.surface) from error


def _of_labels(
    labels: Image,
    la: int,
    lv: int | None,
    wall: int | None,
    vessels: Mapping[int, str],
    options: Options,
    given: Landmarks | None,
    say: Say,
    notes: list[str],
) -> Built:
    say("finding the blood pool")
    said = labelled.candidates(labels, la, vessels)
    labels = labelled.joined(labels, la, vessels)
    pool = extraction.blood_pool(labels, la)
    notes = [*notes, *pool.notes]
    say("smoothing")
    grid = float(np.clip(0.4 * options.cell_size_mm, 0.4, 0.8))
    surface = extraction.surface_of(pool.mask, options.smoothing_mm, grid)
    contact = None if lv is None else lv_contact(labels, lv, surface)
    seen = [] if contact is None else [of_contact(surface, contact)]
    if lv is not None and contact is None:
        notes.append(f"label {lv} does not touch the atrium: the mitral plane is found from the shape")
    within = None if wall is None else extraction.within_wall(labels, la, wall, notes)

    def outer_of(mask: Image) -> Surface:
        return ripples.evened(extraction.surface_of(mask, options.smoothing_mm, OUTER_GRID_MM), _wave(options, mask))

    def ways(found: Landmarks) -> Iterator[Way]:
        """The atrium led on through its annulus, where that shows in the map; else cut where its surface has the contact."""
        valve, note = found.openings.get("mv"), ""
        if lv is not None and contact is not None and valve is not None:
            part = labels.crop(*extraction.box(pool.mask, labels))
            tube = valve_tube(part, la, lv, valve, given=given is not None and "mv" in given.openings)
            if tube is not None:
                inner = extraction.surface_of(tube.led_on(pool.mask), options.smoothing_mm, grid)
                outer = None if within is None else outer_of(tube.led_on(within))
                yield Way(replace(found, openings={**found.openings, "mv": tube.opening}), inner, outer)
            note = BELOW_CONTACT
        yield Way(found, surface, None if within is None else outer_of(within), note)

    return _from_closed(surface, [*seen, *said], LPS, options, given, say, notes, pool.mask, ways)


def from_mesh(
    mesh: Mesh,
    options: Options,
    given: Landmarks | None = None,
    axes: Axes | None = None,
    say: Say = print,
    unit: str | None = None,
) -> Built:
    """Bundle from any mesh of an atrium; ``unit``: of surfacefile.UNITS, None: told from the size."""
    say("repairing the surface")
    repaired = repair.repair(mesh.points, mesh.triangles, unit, mesh.outer)
    repaired = replace(repaired, notes=(*mesh.notes, *repaired.notes))
    tagged = None
    if mesh.tag is not None:
        tagged = patches.of_triangles(repaired.scale * mesh.points, mesh.triangles, mesh.tag)
    return from_surface(repaired, options, given, axes, say, tagged)


def from_surface(
    repaired: Repaired,
    options: Options,
    given: Landmarks | None = None,
    axes: Axes | None = None,
    say: Say = print,
    tagged: Tagged | None = None,
) -> Built:
    """Bundle from a repaired surface; ``axes`` None: left and right are told from the shape."""
    seen = list(repaired.rims) if tagged is None else patches.candidates(repaired.surface, repaired.rims, tagged)

    def ways(found: Landmarks) -> Iterator[Way]:
        yield Way(found, repaired.surface, repaired.outer)

    return _from_closed(repaired.surface, seen, axes, options, given, say, list(repaired.notes), None, ways)


def _from_closed(
    surface: Surface,
    seen: Sequence[Candidate],
    axes: Axes | None,
    options: Options,
    given: Landmarks | None,
    say: Say,
    notes: list[str],
    mask: Image | None,
    ways: Callable[[Landmarks], Iterator[Way]],
) -> Built:
    say("finding valve, veins and appendage")
    field = None if mask is None else extraction.smooth_field(mask, max(0.8, 0.8 * float(mask.spacing.max())), 1.0)
    found = finding.find(surface, seen, axes, given, field, options.ring_width_mm, options.accept_low_confidence).landmarks
    notes += found.notes
    cavity, bundle, found, words = _first_walled(ways(found), options, _wave(options, mask), say)
    notes = [*notes, *words]
    _say_thinned(bundle, notes)
    _say_unmet(bundle, options.thickness_mm, notes)
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


def _first_walled(
    ways: Iterator[Way], options: Options, wave_mm: float, say: Say
) -> tuple[Surface, Bundle, Landmarks, list[str]]:
    """By the first way that leads to a wall: the cavity, the cells, where the openings were cut in the end, and notes.

    Raises AnatomyError, of the last way.
    """
    say("cutting")
    reason: AnatomyError | None = None
    for number, way in enumerate(ways):
        if number == 0:
            say("meshing the wall")
        try:
            return _walled(way, options, wave_mm)
        except AnatomyError as error:
            reason = error
    assert reason is not None, "there is a way at least"
    raise reason


def _walled(way: Way, options: Options, wave_mm: float) -> tuple[Surface, Bundle, Landmarks, list[str]]:
    """As ``_first_walled``, of one way."""
    notes = [way.note] if way.note else []
    cavity = ripples.evened(clip(way.surface, way.openings, notes), wave_mm)
    try:
        return cavity, _shell(cavity, options, way.outer, notes), way.openings, notes
    except TooTightError:
        cavity, found = _smoothed(way.surface, way.openings, notes)
        return cavity, _shell(cavity, options, way.outer, notes), found, notes


def _wave(options: Options, mask: Image | None) -> float:
    """Wave length (mm) below which the wall's surface is evened; 0 where it is not."""
    if options.wave_mm is not None:
        return options.wave_mm
    return 0.0 if mask is None else ripples.wave_of(float(mask.spacing.max()))


def _smoothed(surface: Surface, found: Landmarks, notes: list[str]) -> tuple[Surface, Landmarks]:
    """The cavity without the folds that no wall can follow, cut anew just inside the rims that it had caps for."""
    smooth = extraction.surface_of(voxels.voxels(surface, FINE_MM), UNFOLD_MM, 0.8)
    openings = {n: replace(o, cap=0, centre=o.centre - (FINE_MM if o.cap else 0.0) * o.normal) for n, o in found.openings.items()}
    found = replace(found, openings=openings)
    cavity = clip(smooth, found, notes)
    away, _ = nearest(smooth.points, surface.points)
    notes.append(
        f"the surface has folds that no wall can follow (the deepest at {place(surface.points[int(away.argmax())])}): it was "
        f"smoothed over {UNFOLD_MM:g} mm, by {np.percentile(away, 95):.1f} mm at 95 % of its points and {away.max():.1f} mm at "
        f"most; {surface.volume_ml():.1f} mL became {smooth.volume_ml():.1f} mL"
    )
    return cavity, found


def _sharpest_deg(surface: Surface) -> float:
    """The largest angle between the normals of two of the wall's triangles."""
    normals = surface.normals()
    _, _, of = paths.edge_table(surface.triangles)
    one, two = paths.side_pairs(of)[0].T // 3
    wall = (surface.label[one] == 0) & (surface.label[two] == 0)
    cosine = (normals[one] * normals[two]).sum(axis=1)[wall]
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))).max(initial=0.0))


def _say_thinned(bundle: Bundle, notes: list[str]) -> None:
    share = float(bundle.info["shell"]["thinned_share"])
    if share > THINNED:
        notes.append(
            f"the wall is thinner than asked at {100 * share:.0f} % of its points, where the surface bends too tightly for it; "
            "thickness per region is in the report"
        )


def _say_unmet(bundle: Bundle, thickness_mm: float, notes: list[str]) -> None:
    shell = bundle.info["shell"]
    if (share := float(shell["unmet_share"])) > UNMET:
        low, high = (times * thickness_mm for times in REACH)
        where = place(np.array(shell["unmet_at"]))
        notes.append(
            f"at {100 * share:.0f} % of the wall's points, around {where}, its outer side as given is not {low:.2g} to "
            f"{high:.2g} mm from the blood: the wall has {thickness_mm:g} mm there. If it is really so thin or thick, give a "
            "--thickness-mm nearer to it"
        )


def _shell(cavity: Surface, options: Options, outer: Surface | None, notes: list[str]) -> Bundle:
    """The wall's cells; where the surface bends too tightly for the size, smaller ones."""
    for factor in (1.0, 0.8, 0.64, 0.5):  # smaller cells help no wall over a fold
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
        except TooTightError:
            if factor == 0.5 or _sharpest_deg(cavity) > FOLD_DEG:
                raise
            continue
        if factor < 1.0:
            notes.append(
                f"cells of {options.cell_size_mm:g} mm do not fit this surface: {factor * options.cell_size_mm:.2g} mm were used"
            )
        return bundle
    raise AssertionError("unreachable")


def clip(surface: Surface, found: Landmarks, notes: list[str] | None = None) -> Surface:
    """Cut all openings, the mitral valve last; those that the surface has caps for keep them, other caps are wall.

    A further vein's plane has the label of the vein beside it, whose ring it takes. ``notes`` gets what had to be cut elsewhere.
    """
    notes = [] if notes is None else notes
    label = surface.label.copy()
    kept = {o.cap: PLANES[o.takes or n] for n, o in found.openings.items() if o.cap}
    for cap in np.unique(surface.label[surface.label >= CAP]):
        label[surface.label == cap] = kept.get(int(cap), 0)
    surface = replace(surface, label=label)
    done: set[str] = set()
    for name in sorted(found.openings, key=lambda n: (n == "mv", n)):
        opening = found.openings[name]
        other = found.openings.get(opening.shares)
        if other is not None:
            if opening.shares not in done:
                surface = trunk.part(surface, opening, other)
            done.add(name)
            continue
        if opening.cap:
            continue
        plane = PLANES.get(opening.takes or name, 0)
        surface, words = closed_cut.cut(surface, opening, plane, name.upper())
        notes += [words] if words else []
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
