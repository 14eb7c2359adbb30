"""Every opening of a closed surface: candidates from all sources at once, one assignment of names, a cut for each."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from lacli.anatomy.inputs.image import Image
from lacli.anatomy.openings import branches, naming, ostium
from lacli.anatomy.openings.branches import Branch, Skeleton
from lacli.anatomy.openings.candidate import BRANCH, CAP, CONTACT, GIVEN, GUESS, PATCH, RIM, Candidate, halves, place
from lacli.anatomy.openings.landmarks import Axes, Landmarks, Opening, override
from lacli.anatomy.openings.mitral import mitral_from_shape
from lacli.base.arrays import FloatArray
from lacli.base.errors import AnatomyError
from lacli.contracts.labels import OPENINGS
from lacli.geometry.surface import Surface

KEPT_STUB_MM = 12.0  # a vessel whose rim is no farther than that from its ostium ends at the rim, a longer one is cut
GUESSED = 0.5  # confidence in names that rest on a guess, or on a reading that no atrium of the 23 measured comes near
HOLE_MM = 6.0  # an unnamed rim narrower than that is a hole, a wider one a further vein
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
        return Found(given)
    from lacli.anatomy.inputs.voxels import voxel_field

    field = voxel_field(surface, 1.0) if field is None else field
    skeleton = branches.find(field)
    everything, branch_of = gather(surface, seen, skeleton, given)
    named = naming.assign(everything, axes)
    if named is None or (len(everything) < 5 and named.best.trunk is None):
        raise OpeningsError(too_few(everything), readings(everything, named), surface)
    if named.best.missing:
        raise OpeningsError(without(named.best, everything), readings(everything, named), surface)
    notes: list[str] = []
    valve = everything[named.best.names["mv"]]
    words = doubts(everything, named)
    if valve.source == GUESS:
        guess = f"the mitral valve is closed in the file and was placed by the shape alone ({valve.words()})"
        # without axes, opposite the veins, or where the veins contradict it: all names would follow from a guess
        if axes is None or valve.said or named.best.cost > naming.MOST_COST:
            named = replace(named, confidence=min(named.confidence, GUESSED))
            words = (
                f"{guess}; all names would follow from it. Give [mv] in landmarks.toml (centre, normal out of the "
                "atrium, mm), or the ventricle's label with --lv, or go on with --accept-low-confidence."
            )
        else:
            notes.append(f"{guess}: look at it, and correct it in landmarks.toml")
    if named.best.cost > naming.MOST_COST:
        named = replace(named, confidence=min(named.confidence, GUESSED))
        words = words if valve.source == GUESS else doubts(everything, named)
    if named.confidence < naming.LEAST_CONFIDENCE:
        if not accept_low_confidence:
            raise OpeningsError(words, readings(everything, named), surface)
        notes.append(words)
    if named.best.mirrored:
        notes.append(
            "the atrium is a mirror image (left and right are exchanged): its openings are named as in a mirror; "
            "look for a flipped axis in the tool that wrote it"
        )
    cast = ray_caster(field)
    openings: dict[str, Opening] = {}
    for name, i in named.best.names.items():
        openings[name] = _opening(name, everything[i], branch_of.get(i), named.confidence, cast, ring_mm)
    if named.best.trunk is not None:
        openings |= _parted(everything[named.best.names[named.best.trunk[0]]], named.best.trunk, openings)
        notes.append(
            f"{named.best.trunk[0].upper()} and {named.best.trunk[1].upper()} leave by a common trunk "
            f"({everything[named.best.names[named.best.trunk[0]]].words()}); a carina parts its opening in two"
        )
    openings |= _further(everything, branch_of, named, openings, cast, ring_mm, notes)
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
    if not any(c.said == "mv" or c.source == CONTACT for c in everything):
        widest = max((c.diameter_mm for c in everything if c.source in (RIM, CAP)), default=0.0)
        veins = sorted((c.diameter_mm for c in everything), reverse=True)[1:]
        if widest < 1.2 * max(veins, default=0.0) or widest < 15.0:
            everything.append(replace(_of_opening(mitral_from_shape(surface, skeleton)), source=GUESS))
    return everything, branch_of


def _replaced(
    everything: list[Candidate], branch_of: dict[int, Branch], opening: Opening, name: str
) -> tuple[list[Candidate], dict[int, Branch]]:
    """Without the candidate that a given opening stands for: the nearest, within its own diameter or 10 mm."""
    if not everything:
        return everything, branch_of
    gap = [float(np.linalg.norm(c.centre - opening.centre)) for c in everything]
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
    area = np.pi * max(opening.diameter_mm, 1.0) ** 2 / 4
    across = ostium.across(opening.normal) * opening.diameter_mm / 2
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


def readings(everything: Sequence[Candidate], named: naming.Naming | None) -> list[tuple[str, Landmarks]]:
    """Title and landmarks of the likeliest readings (two at most); candidates without a name where there is none."""
    if named is None:
        return [
            ("found, without names", Landmarks({f"extra{k + 1}": _sketch(f"extra{k + 1}", c) for k, c in enumerate(everything)}))
        ]
    found = []
    for title, reading in (("first reading", named.best), ("second reading", named.second)):
        if reading is None:
            continue
        openings = {n: _sketch(n, everything[i]) for n, i in reading.names.items()}
        if reading.trunk is not None:
            one, two = halves(everything[reading.names[reading.trunk[0]]])
            openings |= {n: _sketch(n, c) for n, c in zip(reading.trunk, (one, two), strict=True)}
        words = f"{title}: {reading.missing.upper()} is missing" if reading.missing else title
        found.append((words, Landmarks(openings)))
    return found


def _sketch(name: str, candidate: Candidate) -> Opening:
    beyond = candidate.centre + 2.0 * candidate.direction if candidate.tip is None else candidate.tip
    return Opening(name, candidate.centre, candidate.direction, beyond, candidate.diameter_mm, 0.0, candidate.source)


def too_few(everything: Sequence[Candidate]) -> str:
    """What is there, what is missing, and what to give."""
    listing = "; ".join(c.words() for c in everything) or "none"
    return (
        f"only {len(everything)} opening{'s' * (len(everything) != 1)} found ({listing}); the mitral valve and four veins are "
        "needed. Include at least 5 mm of each vein, or give the missing in landmarks.toml (centre, normal out of the atrium)."
    )


def without(best: naming.Reading, everything: Sequence[Candidate]) -> str:
    """Which vein is missing, and what to give."""
    name = best.missing
    mate = f"{name[0]}{'i' if name[1] == 's' else 's'}pv"
    there = "; ".join(f"{n.upper()}: {everything[i].words()}" for n, i in best.names.items())
    return (
        f"only one vein was found on the {'left' if name[0] == 'l' else 'right'}, {name.upper()} is missing ({there}): either it "
        f"is not in the file, or it shares a common trunk with {mate.upper()}. Include 5 mm of each vein beyond the trunk, or "
        f"give the ostium ([{name}]: centre, normal out of the atrium, mm) in landmarks.toml."
    )


def doubts(everything: Sequence[Candidate], named: naming.Naming) -> str:
    """The two readings that compete, in words."""
    best, second = named.best, named.second
    if second is None:
        return ""
    parts = []
    for name in OPENINGS:
        a, b = best.names.get(name), second.names.get(name)
        if a != b or ((best.trunk is not None) != (second.trunk is not None) and a is not None and name in (best.trunk or ())):
            there = [place(everything[k].centre) if k is not None else "none" for k in (a, b)]
            parts.append(f"{name.upper()} at {there[0]} or {there[1]}")
    return (
        f"the names of the openings are not certain (confidence {named.confidence:.2f}, {naming.LEAST_CONFIDENCE:g} is asked): "
        f"{', '.join(parts) or 'a common trunk or two veins'}. Look at these places, give the true ones in landmarks.toml "
        "(--landmarks), or take the first reading with --accept-low-confidence."
    )


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
