"""What `lacli stats` answers over simulated cohorts whose truth is known: size, slope, coverage; plain and carried.

    python benchmarks/cohort_statistics.py [--cohorts 200] [--sd 0.8] [--rho 0] [--seed 0] [--only structural]

Ten patients, five regions. The true stiffness x has regional means, a patient's part (sd .6) and a region's in the
patient (sd .8); y = region + beta x + patient (.7) + rest (.7). Only x + noise of the posterior's sd is seen. As predictor:
y on stiffness, beta 0 and .5. As response: noisy y on a quantity known exactly. --rho: correlation of the errors of a
patient's regions, as joint posterior draws have it (the stiffnesses share loads and springs). Exit code 1 where a carried
answer misses its aim.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable

import numpy as np

from lacli.base.arrays import FloatArray
from lacli.base.threads import one_thread
from lacli.cohort.analysis.errors_in_variables import structural_slope
from lacli.cohort.analysis.mixed import known_error, normal_draws, published, rubin
from lacli.cohort.analysis.observations import Observations

PATIENTS, REGIONS = 10, 5
Answer = tuple[float, float, float, float]  # slope, low, high, p


def cohort(rng: np.random.Generator, beta: float) -> tuple[FloatArray, FloatArray]:
    """True x and y, (patients, regions)."""
    x = rng.normal(0, 0.5, REGIONS) + rng.normal(0, 0.6, (PATIENTS, 1)) + rng.normal(0, 0.8, (PATIENTS, REGIONS))
    y = rng.normal(0, 1, REGIONS) + beta * x + rng.normal(0, 0.7, (PATIENTS, 1)) + rng.normal(0, 0.7, (PATIENTS, REGIONS))
    return x, y


def plain(y: FloatArray, x: FloatArray) -> Answer:
    """MixedLM as published."""
    names = tuple(f"r{i}" for i in range(REGIONS))
    observed = Observations(tuple(f"p{i}" for i in range(PATIENTS)), names, {"y": y, "x": x}, {}, {}, "simulated")
    c = published(observed, "y", "x").of("x")
    return c.estimate, c.low, c.high, c.p


def methods(sd: float, rho: float = 0.0) -> dict[str, Callable[[np.random.Generator, float], Answer]]:
    """What is measured: name -> answer on one cohort. rho: of the errors of a patient's regions."""
    none = np.zeros((PATIENTS, REGIONS, REGIONS))
    error = none + sd**2 * ((1 - rho) * np.eye(REGIONS) + rho)

    def noisy(rng: np.random.Generator, q: FloatArray) -> FloatArray:
        own = np.sqrt(1 - rho) * rng.normal(size=q.shape)
        return q + sd * (own if rho == 0 else own + np.sqrt(rho) * rng.normal(size=(len(q), 1)))

    def structural(rng: np.random.Generator, beta: float) -> Answer:
        x, y = cohort(rng, beta)
        s = structural_slope(noisy(rng, x), y, error, none)
        return s.beta, s.low, s.high, s.p

    def plain_predictor(rng: np.random.Generator, beta: float) -> Answer:
        x, y = cohort(rng, beta)
        return plain(y, noisy(rng, x))

    def plain_response(rng: np.random.Generator, beta: float) -> Answer:
        x, y = cohort(rng, beta)
        return plain(noisy(rng, y), x)

    def known(rng: np.random.Generator, beta: float) -> Answer:
        x, y = cohort(rng, beta)
        c = known_error(noisy(rng, y), x, error)[0]
        return c.estimate, c.low, c.high, c.p

    def by_draws(rng: np.random.Generator, beta: float) -> Answer:
        x, y = cohort(rng, beta)
        c = rubin(normal_draws(noisy(rng, y), error, 20, int(rng.integers(1 << 30))), x)
        return c.estimate, c.low, c.high, c.p

    return {
        "predictor, plain": plain_predictor,
        "predictor, structural": structural,
        "response, plain": plain_response,
        "response, known error": known,
        "response, Rubin's rules": by_draws,
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cohorts", type=int, default=200)
    parser.add_argument("--sd", type=float, default=0.8)
    parser.add_argument("--rho", type=float, default=0.0, help="correlation of the errors of a patient's regions, 0 to 1")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="", help="methods whose name holds this")
    options = parser.parse_args()
    if not 0 <= options.rho < 1:
        parser.error("--rho is from 0 to less than 1")
    print(
        f"{options.cohorts} cohorts, posterior sd {options.sd:g}, correlation within patients {options.rho:g};"
        " aims of the carried: size .03 - .07, slope .45 - .55, coverage 92 - 98 %"
    )
    print(
        f"{'':24} {'size at .05':>11} {'slope (beta .5)':>16} {'median':>7} {'coverage 0 / .5':>16} {'power':>6} {'unbounded':>9}"
    )
    met = True
    for name, method in methods(options.sd, options.rho).items():
        if options.only not in name:
            continue
        with one_thread():
            of = {
                b: np.array([method(np.random.default_rng([options.seed, k, int(10 * b)]), b) for k in range(options.cohorts)])
                for b in (0.0, 0.5)
            }
        size, power = (float((of[b][:, 3] < 0.05).mean()) for b in (0.0, 0.5))
        covered = [float(((of[b][:, 1] <= b) & (b <= of[b][:, 2])).mean()) for b in (0.0, 0.5)]
        slope, middle = float(of[0.5][:, 0].mean()), float(np.median(of[0.5][:, 0]))
        unbounded = int((~np.isfinite(of[0.5][:, 1:3])).any(axis=1).sum())
        print(
            f"{name:24} {size:11.3f} {slope:16.3f} {middle:7.3f}"
            f" {covered[0]:8.1%} /{covered[1]:6.1%} {power:6.2f} {unbounded:9d}",
            flush=True,
        )
        if name in ("predictor, structural", "response, known error"):
            met &= 0.03 <= size <= 0.07 and 0.45 <= slope <= 0.55 and all(0.92 <= c <= 0.98 for c in covered)
    print("all aims met" if met else "an aim is missed")
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
