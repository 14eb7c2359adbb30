"""Derivatives of the residual along the study's inputs against differences of the residual. mm, kPa."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from lacli.base.arrays import FloatArray
from lacli.contracts.bundle import Bundle, as_order
from lacli.contracts.labels import BODY_REGIONS
from lacli.freefem.names import Faces, Task
from lacli.geometry.quadrature import triangle_shapes
from lacli.verification.forms import KAPPA, TOLERANCE, distorted_box, disturbed
from lacli.verification.laws import OFFSETS, difference
from lacli.verification.runs import (
    GUCCIONE,
    NEO_HOOKEAN,
    Check,
    FaceSet,
    Form,
    Slopes,
    ask,
    ask_slopes,
    compare,
    material,
    vertices,
)

H = 1e-4
REGIONS = len(BODY_REGIONS)
RING = 11
# the engine's inputs in order: C and alpha of five regions, EDP, ESP, k_peri, PTH, vein springs
INPUTS = 2 * REGIONS + 5
EDP, ESP, K_PERI, PTH, SPRINGS = range(2 * REGIONS, INPUTS)


@dataclass(frozen=True)
class _Point:
    """A wall under every load, with a prestrain: x, v (n, 3), p (nv,); stiffness by region; how each input moves v, and
    pressure and weights follow theirs."""

    bundle: Bundle
    x: FloatArray
    v: FloatArray
    p: FloatArray
    c: FloatArray
    alpha: FloatArray
    loads: FloatArray
    weights: FloatArray
    slopes: FloatArray
    rates: FloatArray
    shares: tuple[float, float]
    pericardium: int

    def materials(self, law: int = GUCCIONE) -> FloatArray:
        """A row for each cell; linear cells with the stabilisation that a simulation gives them."""
        region = self.bundle.region
        table = np.tile(material(NEO_HOOKEAN, 7.0, (8.0, 4.0, 3.0), *KAPPA, 1.0, (0.6, 0.48, 0.64)), (len(region), 1))
        for i in range(REGIONS):
            table[region == i + 1, :3] = law, self.c[i], self.alpha[i]
        if self.bundle.order == 1:
            guccione = table[:, 0] == GUCCIONE
            table[:, 11] = np.where(guccione, 1 / (5.0 * table[:, 1] * table[:, 2]), 1 / (4 * table[:, 1]))
        return table

    def faces(self) -> list[FaceSet]:
        tags = self.bundle.tags
        return [(Faces.PRESSURE, tags == 5, None), (Faces.VEINS, tags == 1, None), (self.pericardium, tags == 6, self.weights)]

    def forms(self) -> list[Form]:
        """Its prestrain kept, then its residual."""
        X = self.bundle.points
        pressure, springs, pericardium = (float(v) for v in self.loads)
        loads = (pressure, springs, pericardium)
        return [Form(Task.KEEP_PRESTRAIN, self.v, X, self.p), Form(Task.RESIDUAL, self.x, X, self.p, loads=loads)]

    def along(self, weights: FloatArray, t: float) -> _Point:
        """Moved by t along the inputs with these weights (inputs,)."""
        d = t * weights
        pressure = self.shares[0] * d[EDP] + self.shares[1] * d[ESP]
        return replace(
            self,
            v=self.v + np.einsum("k,kni->ni", d, self.rates),
            c=self.c + d[:REGIONS],
            alpha=self.alpha + d[REGIONS : 2 * REGIONS],
            loads=self.loads + np.array([pressure, d[SPRINGS], d[K_PERI]]),
            weights=self.weights + d[PTH] * self.slopes,
        )


def _point(bundle: Bundle, pericardium: int) -> _Point:
    random = np.random.default_rng(17)
    region = np.where(np.arange(len(bundle.tets)) % 7 == 6, RING, 1 + np.arange(len(bundle.tets)) % REGIONS)
    bundle = Bundle(bundle.points, bundle.tets, region, bundle.triangles, bundle.tags, info={})
    n, nv, touched = len(bundle.points), len(vertices(bundle)), int((bundle.tags == 6).sum())
    per_face = len(triangle_shapes(3).weight)
    return _Point(
        bundle,
        disturbed(bundle, 0.04, 5),
        disturbed(bundle, 0.05, 6) - bundle.points,
        10 * random.standard_normal(nv),
        np.array([1.7, 0.9, 2.6, 1.2, 3.1]),
        np.array([1.3, 2.1, 0.6, 0.9, 1.7]),
        np.array([2.0, 1.5, 2.5]),
        random.uniform(0.2, 1, (touched, per_face)),
        random.standard_normal((touched, per_face)),
        0.1 * random.standard_normal((INPUTS, n, 3)),
        (0.4, 0.6),
        pericardium,
    )


def sensitivities() -> list[Check]:
    """Of quadratic and linear cells, Guccione's and a neo-Hookean wall, with a prestrain that moves; of the prestrain."""
    curved = _point(distorted_box(True), Faces.PERICARDIUM)
    linear = _point(as_order(distorted_box(False), 1), Faces.OUTWARD)
    return [*_slopes(curved, "", 14), *_slopes(linear, "linear_", 4), _prestrain(curved, ""), _prestrain(linear, "linear_")]


def _whole(point: _Point, task: int, points: int, law: int = GUCCIONE) -> FloatArray:
    """The residual of a point, or of its prestrain problem."""
    forms = point.forms()
    if task == Task.PRESTRAIN_RESIDUAL:
        forms = [replace(forms[1], task=task, x=point.v)]
    answers, _ = ask(point.bundle, point.materials(law), forms, point.faces(), points)
    return np.concatenate([answers[-1].force.T.ravel(), answers[-1].gap])


def _directions() -> dict[str, FloatArray]:
    """Names of directions in the inputs, each input in one of them and with a weight of its own."""
    random = np.random.default_rng(19)
    groups = {"c": range(REGIONS), "alpha": range(REGIONS, 2 * REGIONS), "pressures": (EDP, ESP), "springs": (K_PERI, SPRINGS)}
    found = {}
    for name, members in {**groups, "pth": (PTH,)}.items():
        found[name] = np.zeros(INPUTS)
        found[name][list(members)] = random.uniform(0.5, 1.5, len(members)) * random.choice([-1, 1], len(members))
    return found


def _slopes(point: _Point, prefix: str, points: int) -> list[Check]:
    slopes = Slopes(point.slopes, point.shares, point.rates)
    checks = []
    for law, suffix in ((GUCCIONE, ""), (NEO_HOOKEAN, "_neo_hookean")):
        found, cpu = ask_slopes(point.bundle, point.materials(law), point.forms(), point.faces(), slopes, points)
        residual = partial(_whole, task=Task.RESIDUAL, points=points, law=law)
        for name, weights in _directions().items():
            if law == GUCCIONE or name in ("c", "alpha"):
                checks.append(_check(prefix + name + suffix, weights @ found, weights, point, residual, cpu))
    return checks


def _prestrain(point: _Point, prefix: str) -> Check:
    """Direct derivatives in the image, against differences of the prestrain problem's residual, along all inputs at once."""
    points = 14 if point.bundle.order == 2 else 4
    still = replace(point, x=point.bundle.points, rates=0 * point.rates)
    found, cpu = ask_slopes(
        still.bundle, still.materials(), still.forms(), still.faces(), Slopes(still.slopes, still.shares), points
    )
    weights = sum(_directions().values(), np.zeros(INPUTS))
    name = f"{prefix}of_the_prestrain"
    return _check(name, weights @ found, weights, still, partial(_whole, task=Task.PRESTRAIN_RESIDUAL, points=points), cpu)


def _check(
    name: str, found: FloatArray, weights: FloatArray, point: _Point, residual: Callable[[_Point], FloatArray], cpu_s: float
) -> Check:
    exact = difference(np.array([residual(point.along(weights, t)) for t in OFFSETS * H]), H)
    scale, error = float(np.abs(exact).max()), float(np.abs(found - exact).max())
    return compare("sensitivities", name, error, 0.0, TOLERANCE, len(exact), cpu_s, scale)
