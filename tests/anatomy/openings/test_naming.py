"""Names of openings from their places alone: any order, any pose; what cannot be told is doubted, never guessed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lacli.anatomy.openings import naming
from lacli.anatomy.openings.candidate import BRANCH, RIM, Candidate, halves, of_ring
from lacli.anatomy.openings.landmarks import LPS
from lacli.synthetic.shape import draw

# a plain atrium in LPS mm: veins on the back wall, the left ones nearer the valve, the appendage before the left superior;
# centre, diameter, and which way it looks: veins sideways, the superior ones up, the appendage forward
PLACES = {
    "mv": ((10.0, -12.0, -28.0), 30.0, (0.3, -0.4, -0.86)),
    "rspv": ((-30.0, 6.0, 20.0), 14.0, (-0.85, -0.2, 0.5)),
    "ripv": ((-30.0, 14.0, -6.0), 13.0, (-0.85, 0.5, -0.15)),
    "lspv": ((28.0, 8.0, 20.0), 13.0, (0.7, 0.1, 0.7)),
    "lipv": ((28.0, 16.0, -4.0), 12.0, (0.8, 0.6, 0.0)),
    "appendage": ((30.0, -8.0, 8.0), 15.0, (0.7, -0.65, 0.3)),
}


def circle(centre: tuple[float, float, float], diameter: float, way: tuple[float, float, float] | None = None) -> Candidate:
    middle = np.array(centre)
    out = middle if way is None else np.array(way)
    out = out / np.linalg.norm(out)
    e = np.cross(out, [0.0, 0.0, 1.0] if abs(out[2]) < 0.9 else [1.0, 0, 0])
    e /= np.linalg.norm(e)
    f = np.cross(out, e)
    angle = np.linspace(0, 2 * np.pi, 40, endpoint=False)[:, None]
    return of_ring(middle + diameter / 2 * (np.cos(angle) * e + np.sin(angle) * f), out, RIM)


def atrium(without: tuple[str, ...] = ()) -> dict[str, Candidate]:
    return {n: circle(*p) for n, p in PLACES.items() if n not in without}


def moved(one: Candidate, turn: np.ndarray, scale: float) -> Candidate:
    return Candidate(
        scale * one.centre @ turn.T, one.direction @ turn.T, scale**2 * one.area_mm2, RIM, scale * one.half_axis @ turn.T
    )


def names(found: naming.Naming, order: list[str]) -> dict[str, str]:
    return {name: order[i] for name, i in found.best.names.items()}


def test_a_circle_has_its_own_size() -> None:
    ring = circle((0.0, 0.0, 10.0), 12.0)
    # the polygon of 40 corners has the area 40/2 sin(2 pi/40) r^2
    assert ring.area_mm2 == pytest.approx(20 * np.sin(2 * np.pi / 40) * 36, rel=1e-9)
    assert ring.direction == pytest.approx([0, 0, 1])
    one, two = halves(ring)
    assert np.linalg.norm(one.centre - two.centre) == pytest.approx(6.0, rel=1e-6)
    assert one.area_mm2 + two.area_mm2 == pytest.approx(ring.area_mm2)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10**6), st.booleans(), st.floats(0.7, 1.5))
def test_order_pose_and_size_do_not_matter(seed: int, with_appendage: bool, scale: float) -> None:
    rng = np.random.default_rng(seed)
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    turn = turn * np.sign(np.linalg.det(turn))
    parts = atrium(() if with_appendage else ("appendage",))
    order = list(rng.permutation(list(parts)))
    found = naming.assign([moved(parts[n], turn, scale) for n in order], None)
    assert found is not None and names(found, order) == {n: n for n in parts}
    assert found.confidence > naming.LEAST_CONFIDENCE and not found.best.mirrored and not found.best.missing


def test_a_mirror_image_is_never_named_with_confidence_as_if_it_were_none() -> None:
    parts = atrium()
    order = list(parts)
    found = naming.assign([moved(parts[n], np.diag([-1.0, 1, 1]), 1.0) for n in order], None)
    assert found is not None
    right = names(found, order) == {n: n for n in parts}
    assert (right and found.best.mirrored) or found.confidence < naming.LEAST_CONFIDENCE


@pytest.mark.parametrize("gone", ["rspv", "ripv", "lspv", "lipv"])
@pytest.mark.parametrize("appendage", [True, False])
@pytest.mark.parametrize("flip", [1.0, -1.0])
def test_a_vein_that_is_not_there_is_said_or_doubted(gone: str, appendage: bool, flip: float) -> None:
    parts = atrium((gone,) if appendage else (gone, "appendage"))
    for axes in (None, LPS) if flip > 0 else (None,):
        found = naming.assign([moved(c, np.diag([flip, 1.0, 1.0]), 1.0) for c in parts.values()], axes)
        assert found is None or found.best.missing or found.confidence < naming.LEAST_CONFIDENCE


@pytest.mark.parametrize("seed", range(1, 6))
@pytest.mark.parametrize("tilt_deg", [0.0, 25.0])
def test_whichever_opening_a_synthetic_atrium_lacks_no_other_takes_its_name(seed: int, tilt_deg: float) -> None:
    rng = np.random.default_rng(seed)
    rims: dict[str, Candidate] = {}
    for name, tube in draw(seed).tubes.items():
        aside = np.cross(tube.direction, rng.normal(size=3))
        tilt = np.tan(np.radians(tilt_deg if name != "mv" else 0.0))
        way = tube.direction + tilt * aside / np.linalg.norm(aside)
        rims[name] = circle(tuple(tube.start + tube.cut_mm * tube.direction), 2 * tube.radius_start, tuple(way))

    def certain(found: naming.Naming | None) -> bool:
        return found is not None and not found.best.missing and found.confidence >= naming.LEAST_CONFIDENCE

    for gone in naming.VEINS:
        for lost in ((gone,), (gone, "appendage")):
            assert not certain(naming.assign([c for n, c in rims.items() if n not in lost], None)), lost
    for lost in ((), ("appendage",)):
        order = [n for n in rims if n not in lost]
        found = naming.assign([rims[n] for n in order], None)
        assert found is not None and names(found, order) == {n: n for n in order}
        assert tilt_deg > 0 or certain(found)


def test_a_blind_pouch_tells_left_from_right() -> None:
    # both sides as far from the valve, superior as inferior: turned by half a turn the veins are themselves
    parts = {n: circle(*PLACES[n]) for n in ("mv", "rspv", "ripv", "lspv", "lipv")}
    parts["mv"] = circle((0.0, 11.0, -28.0), 30.0, (0.0, 0.0, -1.0))
    for name in ("rspv", "ripv", "lspv", "lipv"):
        side, height = (-1.0 if name[0] == "r" else 1.0), (11.0 if name[1] == "s" else -11.0)
        parts[name] = circle((29.0 * side, 11.0 - height, 14.0), 13.0, (side, -0.5 * np.sign(height), 0.3))
    order = list(parts)
    alone = naming.assign(list(parts.values()), None)
    assert alone is not None and alone.confidence < naming.LEAST_CONFIDENCE
    for side in (1.0, -1.0):
        pouch = replace(circle((24.0 * side, 11.0 - 20.0 * side, 6.0), 14.0), source=BRANCH)
        found = naming.assign([*parts.values(), pouch], None)
        assert found is not None and found.confidence > naming.LEAST_CONFIDENCE
        left = parts[order[found.best.names["lspv"]]].centre
        assert np.sign(left[0]) == side


def test_an_lspv_that_the_file_names_is_not_doubted_for_an_appendage() -> None:
    parts = atrium(("lspv",))
    order = ["lspv" if n == "appendage" else n for n in parts]
    found = naming.assign(
        [replace(c, said="lspv" if n == "lspv" else "") for n, c in zip(order, parts.values(), strict=True)], None
    )
    assert found is not None and names(found, order)["lspv"] == "lspv" and found.confidence > naming.LEAST_CONFIDENCE


def test_the_middle_vein_is_the_one_without_a_name() -> None:
    parts = atrium()
    parts["middle"] = circle((-31.0, 10.0, 8.0), 8.0)
    order = list(parts)
    found = naming.assign(list(parts.values()), None)
    assert found is not None and names(found, order) == {n: n for n in PLACES}


def test_what_the_input_says_wins() -> None:
    parts = atrium()
    order = list(parts)
    swapped = {"lspv": "lipv", "lipv": "lspv"}
    said = [replace(parts[n], said=swapped.get(n, "")) for n in order]
    found = naming.assign(said, None)
    assert found is not None and names(found, order)["lspv"] == "lipv"
