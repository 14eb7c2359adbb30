"""A closed valve: the veins' names follow from all the places where it may be; its own place is asked for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import pyvista as pv

from lacli.anatomy.openings import closed_valve, naming
from lacli.anatomy.openings.candidate import GUESS, RIM, Candidate, of_ring
from lacli.geometry.surface import Surface

# veins and appendage of a plain atrium, LPS mm: centre, diameter, direction; the valve would be at (10, -12, -28)
PLACES = {
    "rspv": ((-30.0, 6.0, 20.0), 14.0, (-0.85, -0.2, 0.5)),
    "ripv": ((-30.0, 14.0, -6.0), 13.0, (-0.85, 0.5, -0.15)),
    "lspv": ((28.0, 8.0, 20.0), 13.0, (0.7, 0.1, 0.7)),
    "lipv": ((28.0, 16.0, -4.0), 12.0, (0.8, 0.6, 0.0)),
    "appendage": ((30.0, -8.0, 8.0), 15.0, (0.7, -0.65, 0.3)),
}


def vessel(centre: tuple[float, ...], diameter: float, way: tuple[float, ...]) -> Candidate:
    out = np.array(way) / np.linalg.norm(way)
    e = np.cross(out, [0.3, 0.1, 0.95])
    e /= np.linalg.norm(e)
    angle = np.linspace(0, 2 * np.pi, 40, endpoint=False)[:, None]
    return of_ring(np.array(centre) + diameter / 2 * (np.cos(angle) * e + np.sin(angle) * np.cross(out, e)), out, RIM)


def body() -> Surface:
    ball = pv.ParametricEllipsoid(32.0, 26.0, 32.0).triangulate().clean()
    return Surface(np.asarray(ball.points, dtype=float), ball.regular_faces, np.zeros(ball.n_cells, dtype=np.int64))


def guess(at: tuple[float, float, float]) -> Candidate:
    out = np.array(at) / np.linalg.norm(at)
    return replace(vessel(at, 22.0, tuple(out)), source=GUESS)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_veins_are_named_whatever_the_first_guess_of_the_valve(seed: int) -> None:
    rng = np.random.default_rng(seed)
    order = list(rng.permutation(list(PLACES)))
    vessels = [vessel(*PLACES[n]) for n in order]
    # a guess that alone would exchange left and right: nearer the right veins
    found, valve = closed_valve.name(body(), vessels, guess((-22.0, -14.0, -20.0)), None)
    assert found is not None
    names = {n: order[i] for n, i in found.best.names.items() if n in naming.VEINS}
    assert names == {n: n for n in naming.VEINS}
    assert found.best.names["mv"] == len(vessels) and valve.said == "mv"


def test_places_are_apart_and_clear_of_vessels() -> None:
    vessels = [vessel(*place) for place in PLACES.values()]
    found = np.array([c.centre for c in closed_valve.places(body(), vessels)])
    assert 10 <= len(found) <= closed_valve.PLACES
    gap = np.linalg.norm(found[:, None] - found[None], axis=2) + 1e9 * np.eye(len(found))
    assert gap.min() >= closed_valve.APART_MM
    for one in vessels:
        assert np.linalg.norm(found - one.centre, axis=1).min() > closed_valve.CLEAR_MM


def test_no_vessels_no_names() -> None:
    found, valve = closed_valve.name(body(), [], guess((10.0, -12.0, -28.0)), None)
    assert found is None and valve.source == GUESS
