"""Which candidate is which opening: every assignment is scored by where valve, veins and appendage lie to each other.

The score is a negative logarithm of likelihood ("nats") summed over independent features. It needs no axes: the atrium is chiral.
Features and their spread are those of 23 public atria (rule by rule below); known axes and labels of the file add to it. The
confidence is the best reading's share of the likelihood of all readings: veins that are missing, common trunks and mirror images
among them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import permutations

import numpy as np

from lacli.anatomy.openings.candidate import BRANCH, CONTACT, VEIN, Candidate, halves
from lacli.anatomy.openings.landmarks import Axes
from lacli.base.arrays import BoolArray, FloatArray, IntArray

VEINS = ("rspv", "ripv", "lspv", "lipv")
LEAST_CONFIDENCE = 0.9
MOST_COST = 9.0  # nats: a best reading that fits worse is none
MOST = 9  # candidates that take part; the rest are the smallest

# A term is half the square of the distance from the mean in spreads, no more than TERM: one odd feature does not decide alone.
TERM = 12.0
VALVE_OVER_VEIN = (0.45, 0.15)  # ln(valve / next diameter): at least ln 1.24 everywhere
PAIR_OVER_WIDTH = (0.55, 0.12)  # distance in a pair / between the pairs: at most 0.74
PAIR_APART = (0.31, 0.07)  # the same, at least 0.31
RIGHT_OVER_LEFT = (0.33, 0.15)  # ln(distance of the right pair from the valve / of the left): ln 1.02 - ln 1.79
SUPERIOR = (1.0, 0.35)  # cosine of a pair's direction with left x up: 0.66 - 1
TWIST = (0.55, 0.22)  # angle between the two sides' superior directions, rad: 7 - 56 degrees, 3.9 sd being the range of 23
LEANS = 0.6  # the same angle from which on what is named LSPV may be an appendage
APPENDAGE = (0.0, 0.12)  # (|e - LSPV| + up(e - LSPV) - superior(e - LSPV)) / width: -0.2 - 0 but for one, hand-made
APPENDAGE_TERM = 6.0
NO_APPENDAGE = 1.5
MIRRORED = 5.0
UNUSED_RIM, UNUSED_BRANCH = 3.0, 1.0
BETWEEN = (0.0, 0.12)  # how far a middle vein is off the line between its neighbours / width
BLIND_VEIN = 4.0  # a vein that ends blind where the others of the file are open
WAYS_TERM = 3.0  # at most, for each: a rim looks where someone's knife went
POUCH = 0.8  # of a vein's diameter: a blind branch that is wider is no bump
LATERAL = (0.1, 0.15)  # ln(distance of a blind pouch from the right veins / from the left): it is the appendage, closed
MISSING = 5.0  # a vein that is not there
LONE_SIZE = (0.1, 0.2)  # ln(diameter of its mate / mean of the other side's veins): where it is wide it is a trunk
TRUNK = 2.0  # one atrium in five to ten has one
TRUNK_ELONGATION = (0.12, 0.08)  # ln(longest diameter / that of its area's circle); single veins have up to 0.56
TRUNK_SIZE = (0.35, 0.15)  # ln(diameter / mean of the other side's veins): of the area of two veins, ln 1.41
IN_ITS_PLACE = 0.8  # confidence where an open appendage may stand in for a missing LSPV; below LEAST_CONFIDENCE
SAME_WAY = (0.52, 0.16)  # cosine of the directions of a side's two veins: 0.35 - 0.77
ASIDE = (0.08, 0.16)  # cosine of the appendage's direction and the left inferior vein's: -0.1 - 0.25
AXES = (1.0, 0.3)  # cosine of found with known axes
SAID = 15.0


@dataclass(frozen=True)
class Reading:
    """One way to name the candidates: opening -> index (both veins of a common trunk -> that trunk's); trunk: the vein at
    the end of its half_axis and the other; whether the atrium is a mirror image; cost in nats; the vein that is not there."""

    names: dict[str, int]
    trunk: tuple[str, str] | None
    mirrored: bool
    cost: float
    missing: str = ""


@dataclass(frozen=True)
class Naming:
    """The best reading, the best that differs from it, and the confidence (0 - 1) in the former."""

    best: Reading
    second: Reading | None
    confidence: float


@dataclass(frozen=True)
class _Places:
    """What the score needs of candidates: centres and directions (n, 3), diameters (n,), sources, what is said, and mates of
    split trunks."""

    centre: FloatArray
    direction: FloatArray
    diameter: FloatArray
    branch: BoolArray
    contact: BoolArray
    said: tuple[str, ...]
    whole: IntArray  # candidate that each entry belongs to


def assign(candidates: Sequence[Candidate], axes: Axes | None) -> Naming | None:
    """Names for the candidates (five at least, or four with a common trunk); None where no assignment exists.

    ``axes``: known directions of the image, None where left and right must follow from the shape.
    """
    order = sorted(range(len(candidates)), key=lambda i: (not candidates[i].said, -candidates[i].area_mm2))[:MOST]
    chosen = sorted(order)
    readings = _whole(candidates, chosen, axes)
    readings += _missing(candidates, chosen, axes)
    if len(chosen) <= MOST - 2:
        readings += _trunks(candidates, chosen, axes)
    if not readings:
        return None
    readings.sort(key=lambda r: r.cost)
    apart: dict[object, Reading] = {}  # one that differs by its handedness alone, or by a blind pouch's name, is no other
    for reading in readings:
        open_ones = ((n, i) for n, i in reading.names.items() if n != "appendage" or candidates[i].source != BRANCH)
        apart.setdefault((tuple(sorted(open_ones)), reading.trunk), reading)
    best, *others = apart.values()
    gaps = np.array([other.cost - best.cost for other in others])
    confidence = float(1.0 / (1.0 + np.exp(-gaps).sum()))
    if _leans(candidates, best):
        confidence = min(confidence, IN_ITS_PLACE)
    return Naming(best, others[0] if others else None, confidence)


def _leans(candidates: Sequence[Candidate], best: Reading) -> bool:
    """Whether what is named LSPV, no appendage beside it, leans forward as an appendage does where that vein is missing.

    The two sides' superior directions then differ by more than LEANS; in a mirror image, where superior and
    inferior are exchanged, no reading of the others says so.
    """
    if best.missing or best.trunk is not None or "appendage" in best.names or candidates[best.names["lspv"]].said:
        return False
    if any(c.source == BRANCH and c.diameter_mm > POUCH * candidates[best.names["lspv"]].diameter_mm for c in candidates):
        return False
    rs, ri, ls, li = (candidates[best.names[n]].centre for n in VEINS)
    return bool(np.arccos(np.clip(_dot(_unit(rs - ri), _unit(ls - li)), -1.0, 1.0)) > LEANS)


def _whole(candidates: Sequence[Candidate], chosen: list[int], axes: Axes | None) -> list[Reading]:
    entries = [candidates[i] for i in chosen]
    places = _places(entries, np.array(chosen))
    rows = _rows(places)
    return _readings(places, rows, axes) if len(rows) else []


def _missing(candidates: Sequence[Candidate], chosen: list[int], axes: Axes | None) -> list[Reading]:
    """Readings with one vein that is not there: it would lie beside its mate as the other side's do."""
    places = _places([candidates[i] for i in chosen], np.array(chosen))
    three = _rows(places, veins=3)
    found: list[Reading] = []
    if len(three) == 0:
        return found
    for k, name in enumerate(VEINS):
        rows = np.insert(three, 1 + k, three[:, 1 + (k ^ 1) - ((k ^ 1) > k)], axis=1)  # the mate stands in for it
        at = _at(places, rows)
        upper, lower = (1, 2) if k >= 2 else (3, 4)
        step = at[:, upper] - at[:, lower]
        at[:, 1 + k] = at[:, 1 + (k ^ 1)] + (step if k % 2 == 0 else -step)
        other = places.diameter[rows[:, (3, 4) if k < 2 else (1, 2)]].mean(axis=1)
        lone = MISSING + _above(np.log(places.diameter[rows[:, 1 + k]] / other), LONE_SIZE)
        for one in _readings(places, rows, axes, lone, at):
            names = {n: i for n, i in one.names.items() if n != name}
            found.append(replace(one, names=names, missing=name))
    return found


def _trunks(candidates: Sequence[Candidate], chosen: list[int], axes: Axes | None) -> list[Reading]:
    found: list[Reading] = []
    for i in chosen:
        if candidates[i].source == CONTACT or candidates[i].said not in ("", VEIN):
            continue
        others = [k for k in chosen if k != i]
        entries = [*(candidates[k] for k in others), *halves(candidates[i])]
        places = _places(entries, np.array([*others, i, i]))
        rows = _rows(places)
        n = len(entries)
        if len(rows) == 0:
            continue
        pair = np.sort(rows[:, 1:5].reshape(-1, 2, 2), axis=2)
        rows = rows[((pair[..., 0] == n - 2) & (pair[..., 1] == n - 1)).any(axis=1)]
        if len(rows):
            found += _readings(places, rows, axes, _trunk(places, rows, candidates[i]), trunk=True)
    return found


def _places(entries: Sequence[Candidate], whole: IntArray) -> _Places:
    return _Places(
        np.array([c.centre for c in entries]).reshape(-1, 3),
        np.array([c.direction for c in entries]).reshape(-1, 3),
        np.array([c.diameter_mm for c in entries]),
        np.array([c.source == BRANCH for c in entries]),
        np.array([c.source == CONTACT for c in entries]),
        tuple(c.said for c in entries),
        whole,
    )


def _rows(places: _Places, veins: int = 4) -> IntArray:
    """(r, 2 + veins) indices of valve, veins (RSPV, RIPV, LSPV, LIPV), appendage (-1: none), all different."""
    n = len(places.diameter)
    if n < veins + 1:
        return np.zeros((0, veins + 2), dtype=np.int64)
    known = [i for i in range(n) if places.said[i] == "mv" or places.contact[i]]
    valves = known or np.argsort(-np.where(places.branch, 0.5, 1.0) * places.diameter)[:3].tolist()
    out = []
    for valve in valves:
        rest = [i for i in range(n) if i != valve]
        more = np.array(list(permutations(rest, veins + 1)), dtype=np.int64).reshape(-1, veins + 1)
        less = np.array(list(permutations(rest, veins)), dtype=np.int64)
        both = np.vstack([more, np.column_stack([less, np.full(len(less), -1)])])
        out.append(np.column_stack([np.full(len(both), valve), both]))
    return np.vstack(out)


def _at(places: _Places, rows: IntArray) -> FloatArray:
    """Centres (r, 6, 3) mm of the rows' entries."""
    return places.centre[np.maximum(rows, 0)]


def _readings(
    places: _Places,
    rows: IntArray,
    axes: Axes | None,
    more: FloatArray | float = 0.0,
    at: FloatArray | None = None,
    trunk: bool = False,
    keep: int = 12,
) -> list[Reading]:
    """The ``keep`` likeliest rows, as they are and as mirror images; ``more`` (r,) is added to their cost."""
    found = []
    at = _at(places, rows) if at is None else at
    for mirrored in (False, True):
        cost = score(places, rows, at, axes, mirrored) + more
        for k in np.argsort(cost, kind="stable")[:keep]:
            row = rows[k]
            names = {n: int(places.whole[i]) for n, i in zip(("mv", *VEINS, "appendage"), row, strict=True) if i >= 0}
            pair = None
            if trunk:
                column = {int(i): n for n, i in zip(("mv", *VEINS), row, strict=False)}
                mine = [column[len(places.diameter) - k] for k in (2, 1)]
                pair = (mine[0], mine[1])
            found.append(Reading(names, pair, mirrored, float(cost[k])))
    return found


def _trunk(places: _Places, rows: IntArray, trunk: Candidate) -> FloatArray:
    """Cost (r,) of two veins that leave as one: it is longer than wide, and wider than a vein."""
    veins = rows[:, 1:5].reshape(-1, 2, 2)
    split = veins[:, 0, 0] >= len(places.diameter) - 2  # the halves are the last entries
    other = np.where(split[:, None], veins[:, 1], veins[:, 0])
    size = np.log(trunk.diameter_mm / places.diameter[other].mean(axis=1))
    return TRUNK + _below(np.full(len(rows), np.log(trunk.elongation)), TRUNK_ELONGATION) + _below(size, TRUNK_SIZE)


def score(places: _Places, rows: IntArray, at: FloatArray, axes: Axes | None, mirrored: bool) -> FloatArray:
    """Cost (r,) in nats of each row of ``_rows`` with centres ``at`` (r, 6, 3) mm."""
    valve, rs, ri, ls, li, e = (at[:, k] for k in range(6))
    right, left = (rs + ri) / 2, (ls + li) / 2
    across, up = left - right, (left + right) / 2 - valve
    width = np.maximum(_size(across), 1e-6)
    across, up = _unit(across), _unit(up)
    superior = _unit(np.cross(across, up)) * (-1.0 if mirrored else 1.0)
    has = rows[:, 5] >= 0
    pouch = _pouches(places, rows)
    cost = np.where(has | pouch.any(axis=1), 0.0, NO_APPENDAGE) + (MIRRORED if mirrored else 0.0)

    size = places.diameter[np.maximum(rows, 0)]
    veins = size[:, 1:5].max(axis=1)
    veins = np.maximum(veins, np.where(has, size[:, 5], 0.0))
    cost += _below(np.log(size[:, 0] / veins), VALVE_OVER_VEIN)
    pair = np.maximum(_size(rs - ri), _size(ls - li)) / width
    cost += _above(pair, PAIR_OVER_WIDTH)
    cost += _below(np.minimum(_size(rs - ri), _size(ls - li)) / width, PAIR_APART)
    ratio = np.log(np.maximum(_size(right - valve), 1e-6) / np.maximum(_size(left - valve), 1e-6))
    cost += _term(ratio, RIGHT_OVER_LEFT)
    for upper, lower in ((rs, ri), (ls, li)):
        cost += _term(_dot(_unit(upper - lower), superior), SUPERIOR)
    turn = np.arccos(np.clip(_dot(_unit(rs - ri), _unit(ls - li)), -1.0, 1.0))
    cost += _above(turn, TWIST)
    j = (_size(e - ls) + _dot(e - ls, up) - _dot(e - ls, superior)) / width
    nearest = np.min([_size(e - v) for v in (li, rs, ri)], axis=0)
    farther = np.where(_size(e - ls) > nearest, 3.0, 0.0)
    cost += np.where(has, np.minimum(_above(j, APPENDAGE), APPENDAGE_TERM) + farther, 0.0)
    cost += _ways(places, rows) + _blind(places, rows, pouch, right, left)
    cost += _unused(places, rows, at, width, pouch)
    if axes is not None:
        cost += _term(_dot(across, axes.left), AXES)
        cost += _term(_dot(superior, _unit(axes.superior - axes.posterior)), (0.9, AXES[1]))
    return cost + _against_words(places, rows)


def _ways(places: _Places, rows: IntArray) -> FloatArray:
    """Cost (r,) of where openings look: two veins of a side much the same way, the appendage forward of the left inferior vein.

    It is what tells an appendage from a left superior vein where one of the two is not there: their places overlap.
    """
    way = places.direction[np.maximum(rows, 0)]
    cost = np.zeros(len(rows))
    for upper, lower in ((1, 2), (3, 4)):
        both = rows[:, upper] != rows[:, lower]  # a vein that is missing has its mate's direction
        same = _below(_dot(way[:, upper], way[:, lower]), SAME_WAY)
        cost += np.where(both, np.minimum(same, WAYS_TERM), 0.0)
    aside = np.minimum(_above(_dot(way[:, 5], way[:, 4]), ASIDE), WAYS_TERM)
    there = (rows[:, 5] >= 0) & (rows[:, 3] != rows[:, 4])
    return cost + np.where(there, aside, 0.0)


def _pouches(places: _Places, rows: IntArray) -> BoolArray:
    """(r, n) whether a candidate without a name ends blind beside veins that are open: the appendage, closed."""
    typical = np.median(places.diameter[rows[:, 1:5]], axis=1)
    free = (rows[:, :, None] != np.arange(len(places.diameter))).all(axis=1)
    return np.asarray(free & places.branch & (places.diameter > POUCH * typical[:, None]) & _veins_open(places, rows)[:, None])


def _veins_open(places: _Places, rows: IntArray) -> BoolArray:
    return np.asarray((~places.branch[rows[:, 1:5]]).sum(axis=1) >= 2)


def _blind(places: _Places, rows: IntArray, pouch: BoolArray, right: FloatArray, left: FloatArray) -> FloatArray:
    """Cost (r,) of veins that end blind where others are open, and of pouches on the right."""
    cost = np.where(_veins_open(places, rows), BLIND_VEIN * places.branch[rows[:, 1:5]].sum(axis=1), 0.0)
    for i in np.flatnonzero(pouch.any(axis=0)):
        apart = [np.maximum(_size(places.centre[i] - side), 1e-6) for side in (right, left)]
        side = _below(np.log(apart[0] / apart[1]), LATERAL)
        cost += np.where(pouch[:, i], UNUSED_BRANCH + np.minimum(side, APPENDAGE_TERM), 0.0)
    return cost


def _unused(places: _Places, rows: IntArray, at: FloatArray, width: FloatArray, pouch: BoolArray) -> FloatArray:
    """Cost of candidates that get no name: small holes and bumps little, a vein only between two others of its side."""
    cost = np.zeros(len(rows))
    typical = np.median(places.diameter[rows[:, 1:5]], axis=1)
    for i in range(len(places.diameter)):
        free = (rows != i).all(axis=1)
        if not free.any():
            continue
        free &= ~pouch[:, i]
        off = np.min([_off(places.centre[i], at[:, a], at[:, b]) for a, b in ((1, 2), (3, 4))], axis=0) / width
        share = np.clip(places.diameter[i] / typical, 0.3, 1.0) ** 2
        one = (UNUSED_BRANCH if places.branch[i] else UNUSED_RIM) + _term(off, BETWEEN) * (0.2 if places.branch[i] else 1.0)
        cost += np.where(free, share * one, 0.0)
    return cost


def _off(point: FloatArray, a: FloatArray, b: FloatArray) -> FloatArray:
    """Distance (r,) of a point from the middle half of segments a-b (r, 3)."""
    d = b - a
    t = np.clip(_dot(point - a, d) / np.maximum(_dot(d, d), 1e-12), 0.2, 0.8)
    return _size(point - a - t[:, None] * d)


def _against_words(places: _Places, rows: IntArray) -> FloatArray:
    """Cost of names that the input's own words contradict."""
    cost = np.zeros(len(rows))
    columns = ("mv", *VEINS, "appendage")
    for i, said in enumerate(places.said):
        said = "mv" if places.contact[i] else said
        if not said:
            continue
        wanted = [1, 2, 3, 4] if said == VEIN else [columns.index(said)]
        mine = rows == i
        wrong = mine.any(axis=1) & ~mine[:, wanted].any(axis=1)
        cost += np.where(wrong, SAID, 0.0)
        if said != VEIN:
            cost += np.where(mine.any(axis=1), 0.0, SAID)
    return cost


def _term(value: FloatArray, about: tuple[float, float]) -> FloatArray:
    return np.minimum(0.5 * ((value - about[0]) / about[1]) ** 2, TERM)


def _above(value: FloatArray, about: tuple[float, float]) -> FloatArray:
    return _term(np.maximum(value, about[0]), about)


def _below(value: FloatArray, about: tuple[float, float]) -> FloatArray:
    return _term(np.minimum(value, about[0]), about)


def _size(v: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.norm(v, axis=-1))


def _dot(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.asarray((a * b).sum(axis=-1))


def _unit(v: FloatArray) -> FloatArray:
    return np.asarray(v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-12))
