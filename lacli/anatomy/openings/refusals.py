"""What a refusal says and leaves: the readings of what was found, as landmarks to correct, and what to give, in words."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from lacli.anatomy.openings import naming
from lacli.anatomy.openings.candidate import GIVEN, Candidate, place
from lacli.anatomy.openings.landmarks import Landmarks, Opening
from lacli.contracts.labels import OPENINGS


def readings(
    everything: Sequence[Candidate],
    named: naming.Naming | None,
    cuts: Callable[[naming.Reading, float], dict[str, Opening]],
    given: Landmarks | None = None,
) -> list[tuple[str, Landmarks]]:
    """Title and landmarks of the likeliest readings (two at most); candidates without a name where there is none.

    Each opening is where it would be cut, and unconfirmed unless it was given.
    """
    mine = {} if given is None else given.openings
    if named is None:
        found = {f"extra{k + 1}": _sketch(f"extra{k + 1}", c) for k, c in enumerate(everything) if c.source != GIVEN}
        return [("found, without names", Landmarks(found | mine))]
    rows = []
    for title, reading in (("first reading", named.best), ("second reading", named.second)):
        if reading is None:
            continue
        openings = {n: replace(o, confirmed=False) for n, o in cuts(reading, 0.0).items()} | mine
        ordered = {n: openings[n] for n in sorted(openings, key=lambda n: (OPENINGS.index(n) if n in OPENINGS else 99, n))}
        rows.append((f"{title}: {reading.missing.upper()} is missing" if reading.missing else title, Landmarks(ordered)))
    return rows


def _sketch(name: str, candidate: Candidate) -> Opening:
    beyond = candidate.centre + 2.0 * candidate.direction if candidate.tip is None else candidate.tip
    at, way, width = candidate.centre, candidate.direction, candidate.diameter_mm
    return Opening(name, at, way, beyond, width, 0.0, candidate.source, confirmed=False)


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


def veins(everything: Sequence[Candidate], named: naming.Naming, certain: bool) -> str:
    """Where the veins are, or what speaks against their names, for a file whose valve is closed."""
    if certain:
        listing = ", ".join(f"{n.upper()} {place(everything[named.best.names[n]].centre)}" for n in naming.VEINS)
        return f"The veins' names are certain wherever it is: {listing}."
    return f"The veins' names depend on it ({named.confidence:.2f} for the first reading)."
