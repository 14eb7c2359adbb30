"""Every opening of a closed surface: candidates from all sources at once, one assignment of names, a cut for each."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from lacli.anatomy.inputs.image import Image
from lacli.anatomy.openings import branches, closed_valve, naming, ostium, refusals
from lacli.anatomy.openings.branches import Branch, Skeleton
from lacli.anatomy.openings.candidate import BRANCH, CAP, CONTACT, GIVEN, GUESS, PATCH, RIM, Candidate, halves, place
from lacli.anatomy.openings.landmarks import Axes, Landmarks, Opening, override
from lacli.anatomy.openings.mitral import SHARP_DEG, border_turn_deg, mitral_from_shape
from lacli.base.arrays import FloatArray
from lacli.base.errors import AnatomyError
from lacli.contracts.labels import OPENINGS
from lacli.geometry.surface import Surface

KEPT_STUB_MM = 12.0  # a vessel whose rim is no farther than that from its ostium ends at the rim, a longer one is cut
GUESSED = 0.5  # confidence in names that rest on a guess, or on a reading that no atrium of the 23 measured comes near
HOLE_MM = 6.0  # an unnamed rim narrower than that is a hole, a wider one a further vein
VESSEL = 1.7  # of its rim's diameter: what is wider inside is the body, what is narrower no section of it
WIDER, LEAST_VALVE_MM = 1.2, 15.0  # the valve's rim is that much wider than any other, and as wide at least
AT_RIM = 0.8  # a branch that ends within that many diameters of a rim is the rim's vessel


class OpeningsError(AnatomyError):
    """Openings that are not certain or not there; ``readings``: title and landmarks of each way to read what there is, the
    likeliest first; ``surface``: what they lie on, once known."""

    def __init__(self, words: str, readings: Sequence[tuple[str, Landmarks]] = (), surface: Surface | None = None) -> None:
        super().__init__(words)
        self.readings, self.surface = tuple(readings), surface


@dataclass(frozen=True)
class Found:
    """Landmarks, all candidates, and the readings of them (None where all openings were given)."""

    landmarks: Landmarks
    candidates: tuple[Candidate, ...] = ()
    naming: naming.Naming | None = None


def find(
    surface: Surface,
    seen: Sequence[Candidate],
    axes: Axes | None,
    given: Landmarks | None = None,
    field: Image | None = None,
    ring_mm: float = 2.5,
    accept_low_confidence: bool = False,
) -> Found:
    """Names and cuts for all openings of ``surface``.

    ``seen``: candidates of the input itself (rims, caps, labels, contact); branches of the cavity's ``field`` (about 1 inside, 0
    outside) join them. ``given``: what stands there wins. Raises AnatomyError where too few openings are found or the best
    reading's confidence is below naming.LEAST_CONFIDENCE, unless that is accepted.
    """
    given = None if given is None else at_caps(given, seen)
    if given is not None and set(OPENINGS) - {"appendage"} <= set(given.openings):
        return Found(replace(given, notes=(*given.notes, *against_shape(given, axes))))
    from lacli.anatomy.inputs.voxels import voxel_field

    field = voxel_field(surface, 1.0) if field is None else field
    skeleton = branches.find(field)
    cast = ray_caster(field)
    everything, branch_of = gather(surface, at_ostia(seen, skeleton, cast, ring_mm), skeleton, given)
    flat = False  # whether the valve is a flat patch with a sharp border at a likely place: closed by a plane
    if everything and everything[-1].source == GUESS:
        patch = everything.pop()
        named, valve = closed_valve.name(surface, everything, patch, axes)
        flat = valve.centre is patch.centre and not patch.said and border_turn_deg(surface, patch) >= SHARP_DEG
        everything.append(valve)
    else:
        named = naming.assign(everything, axes)

    def cuts(reading: naming.Reading, confidence: float) -> dict[str, Opening]:
        """Where the openings of a reading are cut; what was given is cut where it was given."""
        openings = {n: _opening(n, everything[i], branch_of.get(i), confidence, cast, ring_mm) for n, i in reading.names.items()}
        if reading.trunk is not None:
            openings |= _parted(everything[reading.names[reading.trunk[0]]], reading.trunk, openings)
        return openings

    def refusal(words: str) -> OpeningsError:
        return OpeningsError(words, refusals.readings(everything, named, cuts, given), surface)

    if named is None or (len(everything) < 5 and named.best.trunk is None):
        raise refusal(refusals.too_few(everything))
    if named.best.missing:
        raise refusal(refusals.without(named.best, everything))
    notes: list[str] = []
    valve = everything[named.best.names["mv"]]
    words = refusals.doubts(everything, named)
    if valve.source == GUESS:
        certain = named.confidence >= naming.LEAST_CONFIDENCE and named.best.cost <= naming.MOST_COST
        words = (
            "the mitral valve is closed in the file, and its place cannot be told from the shape; it may be at "
            f"{place(valve.centre)}. Give [mv] in landmarks.toml (centre, normal out of the atrium, mm), or the ventricle's "
            f"label with --lv, or take that place with --accept-low-confidence. {refusals.veins(everything, named, certain)}"
        )
        if flat and certain:
            notes.append(
                f"the mitral valve is closed in the file: taken as its flat patch ({valve.words()}, confidence {GUESSED:g}), "
                "whose border is sharp as that of a cut; look at it"
            )
        else:
            named = replace(named, confidence=min(named.confidence, GUESSED))
    if named.best.cost > naming.MOST_COST:
        named = replace(named, confidence=min(named.confidence, GUESSED))
        words = words if valve.source == GUESS else refusals.doubts(everything, named)
    if named.confidence < naming.LEAST_CONFIDENCE:
        if not accept_low_confidence:
            raise refusal(words)
        notes.append(words)
    if named.best.mirrored:
        notes.append(
            "the atrium is a mirror image (left and right are exchanged): its openings are named as in a mirror; "
            "look for a flipped axis in the tool that wrote it"
        )
    openings = cuts(named.best, named.confidence)
    if named.best.trunk is not None:
        notes.append(
            f"{named.best.trunk[0].upper()} and {named.best.trunk[1].upper()} leave by a common trunk "
            f"({everything[named.best.names[named.best.trunk[0]]].words()}); a carina parts its opening in two"
        )
    openings |= _further(everything, branch_of, named, openings, cast, ring_mm, notes)
    if valve.source == GUESS:
        openings["mv"] = replace(openings["mv"], confidence=GUESSED, confirmed=False)
    if named.confidence < naming.LEAST_CONFIDENCE:
        openings = {n: replace(o, confirmed=False) for n, o in openings.items()}
    if "appendage" not in openings:
        notes.append(
            "no appendage was found; its ring and plane are left out. If the file has an open one and lacks the LSPV, the LSPV "
            f"at {place(everything[named.best.names['lspv']].centre)} is that appendage: compare the names with the surface"
        )
    ordered = sorted(openings, key=lambda n: (OPENINGS.index(n) if n in OPENINGS else 99, n))
    landmarks = Landmarks({n: openings[n] for n in ordered}, {}, tuple(notes))
    return Found(override(landmarks, given), tuple(everything), named)


def at_caps(given: Landmarks, seen: Sequence[Candidate]) -> Landmarks:
    """Given openings that lie on a cap of the surface (within 2 mm of its plane and half its radius of its middle) use it."""
    openings = dict(given.openings)
    for name, opening in given.openings.items():
        for candidate in seen:
            gap = opening.centre - candidate.centre
            along = float(gap @ candidate.direction)
            beside = float(np.linalg.norm(gap - along * candidate.direction))
            reach = 0.35 * candidate.diameter_mm if opening.shares else 0.25 * candidate.diameter_mm
            if candidate.cap and abs(along) < 2.0 and beside < reach:
                openings[name] = replace(opening, cap=candidate.cap)
    return replace(given, openings=openings)


def _parted(trunk: Candidate, names: tuple[str, str], openings: dict[str, Opening]) -> dict[str, Opening]:
    """The two openings of a common trunk, about its one cut."""
    one, two = halves(trunk)
    cut = openings[names[0]]
    parted = {}
    for name, other, half in ((names[0], names[1], one), (names[1], names[0], two)):
        step = half.centre - trunk.centre
        step = step - (step @ cut.normal) * cut.normal
        parted[name] = replace(cut, name=name, centre=cut.centre + step, diameter_mm=half.diameter_mm, shares=other)
    return parted


def at_ostia(seen: Sequence[Candidate], skeleton: Skeleton, cast: ostium.RadiusAt, ring_mm: float) -> list[Candidate]:
    """The candidates, rims at the end of long vessels put at those vessels' ostia: there they are named, and cut.

    Where a rim is no farther than KEPT_STUB_MM from the ostium, or the section there is no vessel's, it stays what it is; so does
    the one that is wide as a valve's, however narrow the atrium becomes towards it.
    """
    stays = [c for c in seen if c.said == "mv"]
    if not stays and (rim := _valve_rim([c for c in seen if c.source in (RIM, CAP)])) is not None:
        stays = [rim]
    return [
        _at_ostium(c, skeleton, cast, ring_mm) if c.source == RIM and c.cap and not any(c is s for s in stays) else c
        for c in seen
    ]


def _valve_rim(among: Sequence[Candidate]) -> Candidate | None:
    """The rim or cap that is wide as a valve's, and by a fifth wider than the second widest of all: the mitral valve's, wherever
    valve and veins are open."""
    widest = max((c for c in among if c.source in (RIM, CAP)), key=lambda c: c.diameter_mm, default=None)
    second = max(sorted((c.diameter_mm for c in among), reverse=True)[1:], default=0.0)
    if widest is None or widest.diameter_mm < WIDER * second or widest.diameter_mm < LEAST_VALVE_MM:
        return None
    return widest


def _at_ostium(rim: Candidate, skeleton: Skeleton, cast: ostium.RadiusAt, ring_mm: float) -> Candidate:
    ends = [(float(np.linalg.norm(b.tip - rim.centre)), b) for b in skeleton.branches if b.length_mm > KEPT_STUB_MM]
    ends = [(gap, b) for gap, b in ends if gap < AT_RIM * max(rim.diameter_mm, 1.0)]
    if not ends:
        return rim
    branch = min(ends, key=lambda one: one[0])[1]
    cut = ostium.of_branch("", branch, 0.0, cast, ring_mm)
    length = float(np.linalg.norm(cut.centre - rim.centre))
    wider = cut.diameter_mm / max(rim.diameter_mm, 1e-6)
    if not (KEPT_STUB_MM < length < branch.length_mm + KEPT_STUB_MM and 1.0 / VESSEL < wider < VESSEL):
        return rim
    half = ostium.across(cut.normal) * cut.diameter_mm / 2
    area = np.pi * cut.diameter_mm**2 / 4
    return replace(rim, centre=cut.centre, direction=cut.normal, area_mm2=area, half_axis=half, length_mm=length,
                   tip=rim.centre, cap=0)  # fmt: skip


def gather(
    surface: Surface, seen: Sequence[Candidate], skeleton: Skeleton, given: Landmarks | None
) -> tuple[list[Candidate], dict[int, Branch]]:
    """All candidates, and for those that a branch leads to, that branch."""
    everything = list(seen)
    branch_of: dict[int, Branch] = {}
    for branch in skeleton.branches:
        gap = [_gap(branch, c) for c in everything]
        at = int(np.argmin(gap)) if gap else -1
        if at >= 0 and gap[at] < AT_RIM:
            if at not in branch_of:
                branch_of[at] = branch
            continue
        branch_of[len(everything)] = branch
        everything.append(of_branch(branch))
    for name, opening in ({} if given is None else given.openings).items():
        everything, branch_of = _replaced(everything, branch_of, opening, name)
        if name in OPENINGS and not any(c.said == name for c in everything):
            everything.append(replace(_of_opening(opening), source=GIVEN, said=name))
    if not any(c.said == "mv" or c.source == CONTACT for c in everything) and _valve_rim(everything) is None:
        everything.append(replace(_of_opening(mitral_from_shape(surface, skeleton, everything)), source=GUESS))
    return everything, branch_of


def _replaced(
    everything: list[Candidate], branch_of: dict[int, Branch], opening: Opening, name: str
) -> tuple[list[Candidate], dict[int, Branch]]:
    """Without the candidate that a given opening stands for: the nearest, within its own diameter or 10 mm."""
    if not everything:
        return everything, branch_of
    places = [[c.centre] if c.tip is None else [c.centre, c.tip] for c in everything]  # of a long vessel, either end
    gap = [min(float(np.linalg.norm(p - opening.centre)) for p in both) for both in places]
    at = int(np.argmin(gap))
    if opening.cap and everything[at].cap == opening.cap:
        return [replace(c, said=name) if k == at else c for k, c in enumerate(everything)], branch_of
    if gap[at] > max(10.0, 0.5 * everything[at].diameter_mm):
        return everything, branch_of
    moved = {k - (k > at): b for k, b in branch_of.items() if k != at}
    return everything[:at] + everything[at + 1 :], moved


def _gap(branch: Branch, candidate: Candidate) -> float:
    ends = [branch.tip, branch.centre] if candidate.source in (RIM, CAP) else [branch.centre]
    return float(min(np.linalg.norm(e - candidate.centre) for e in ends)) / max(candidate.diameter_mm, 1.0)


def _of_opening(opening: Opening) -> Candidate:
    width = opening.diameter_mm or (30.0 if opening.name == "mv" else 12.0)  # given without: a usual one
    area = np.pi * width**2 / 4
    across = ostium.across(opening.normal) * width / 2
    said = "mv" if opening.confidence <= 0.2 or opening.source != "largest flat patch" else ""
    return Candidate(opening.centre, opening.normal, area, CAP, across, tip=opening.beyond, said=said)


def of_branch(branch: Branch) -> Candidate:
    """A branch's ostium."""
    area = float(branch.area[branch.ostium])
    across = ostium.across(branch.axis) * np.sqrt(area / np.pi)
    return Candidate(branch.centre, branch.axis, area, BRANCH, across, branch.length_mm, branch.tip)


def _opening(
    name: str, candidate: Candidate, branch: Branch | None, confidence: float, cast: ostium.RadiusAt, ring_mm: float
) -> Opening:
    """Where a named candidate is cut: at its own rim or cap where that is near the ostium, else beyond the ostium."""
    beyond = candidate.centre + 2.0 * candidate.direction if candidate.tip is None else candidate.tip
    at, way = candidate.centre, candidate.direction
    as_it_is = Opening(name, at, way, beyond, candidate.diameter_mm, confidence, candidate.source, candidate.cap)
    if name == "mv" or (candidate.cap == 0 and branch is None):
        return as_it_is
    if candidate.source == PATCH:
        out = min(ring_mm, 0.5 * candidate.length_mm)
        return replace(as_it_is, centre=at + out * way)
    if candidate.cap:
        inside = ostium.of_opening(as_it_is, cast, ring_mm)
        near = float(np.linalg.norm(inside.centre - at)) <= KEPT_STUB_MM
        return as_it_is if near or branch is None or branch.length_mm <= KEPT_STUB_MM else replace(inside, cap=0)
    assert branch is not None
    return replace(ostium.of_branch(name, branch, confidence, cast, ring_mm), source=candidate.source)


def _further(
    everything: Sequence[Candidate],
    branch_of: dict[int, Branch],
    named: naming.Naming,
    openings: dict[str, Opening],
    cast: ostium.RadiusAt,
    ring_mm: float,
    notes: list[str],
) -> dict[str, Opening]:
    """Openings without a name of their own: a further vein takes the ring and plane of its neighbour, a hole is closed."""
    found: dict[str, Opening] = {}
    used = set(named.best.names.values())
    for i, candidate in enumerate(everything):
        if i in used or candidate.source in (CONTACT, CAP, GUESS):
            continue
        if candidate.source == BRANCH and candidate.length_mm < 1.2 * candidate.diameter_mm:
            continue
        if candidate.diameter_mm < HOLE_MM:
            if candidate.cap:
                notes.append(f"an opening {candidate.diameter_mm:.1f} mm wide at {place(candidate.centre)} was closed as a hole")
            continue
        near = min(naming.VEINS, key=lambda n: float(np.linalg.norm(openings[n].centre - candidate.centre)))
        name = f"extra{len(found) + 1}"
        made = _opening(name, candidate, branch_of.get(i), 0.5, cast, ring_mm)
        found[name] = replace(made, takes=near)
        notes.append(f"a fifth vein ({candidate.words()}) takes the ring of {near.upper()}, its neighbour")
    return found


def against_shape(given: Landmarks, axes: Axes | None) -> list[str]:
    """What speaks against names that were all given, in words: openings that lie to each other as in no atrium, or as others
    with confidence would be named."""
    if any(o.shares for o in given.openings.values()):
        return []
    mine = {n: o for n, o in given.openings.items() if n in OPENINGS}
    candidates = [replace(_of_opening(o), source=GIVEN, said="") for o in mine.values()]
    order = list(mine)
    as_said = naming.assign([replace(c, said=n) for c, n in zip(candidates, order, strict=True)], axes)
    plain = naming.assign(candidates, axes)
    if as_said is None or plain is None:
        return []
    best = {n: order[i] for n, i in plain.best.names.items()}
    other = [f"{n.upper()} where {best[n].upper()} is given" for n in OPENINGS if n in best and best[n] != n]
    if plain.confidence >= naming.LEAST_CONFIDENCE and not plain.best.missing and plain.best.trunk is None and other:
        return [
            f"the names given contradict the shape (confidence {plain.confidence:.2f}), which says {', '.join(other)}: check them"
        ]
    if as_said.best.cost > naming.MOST_COST:
        return ["the openings given lie to each other as in no atrium that was measured: check their places and names"]
    return []


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
