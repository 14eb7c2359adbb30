"""Verification: asked against measured, refinement tables (unknowns, error, CPU seconds), compressibility, load steps.

Run: python benchmarks/verification.py [--quick]
One thread. CPU s: FreeFEM's whole process; "prep": mesh and files, in Python. Unknowns count held ones too.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from lacli.base.errors import SimulationError
from lacli.verification import meshes
from lacli.verification import problems as verification
from lacli.verification.equilibria import (
    BEAM_MOVED,
    ELLIPSOID_APICES,
    ELLIPSOID_VOLUME,
    SPHERE_RADII,
    beam_mesh,
    solve_beam,
    solve_ellipsoid,
    solve_sphere,
)
from lacli.verification.runs import Solution

# CPU seconds (whole process, one thread) in which other codes come within 0.02 mm of problems 1 and 2
OTHERS = {"beam": {"dolfinx 0.5": 7.7, "pulse": 8.9, "ngsolve": 8.0, "felupe": 15.7}}
OTHERS["ellipsoid"] = {"dolfinx 0.5": 9.8, "ngsolve": 12.5, "felupe": 20.5}

# beyond what is asked, by problem or quantity
AIMS = {"law": 1e-9, "patch": 1e-9, "pressure": 1e-9, "spring": 1e-9, "sphere": 2e-4, "beam": 0.005}
AIMS |= {"ed_volume_error": 1e-4, "ed_shape_mean_mm": 0.01}


def line(*words: object) -> None:
    """A row: the first word wide."""
    print(f"{words[0]!s:<34}" + "".join(f"{word!s:>12}" for word in words[1:]), flush=True)


def counts(solution: Solution, prep: float) -> tuple[str, ...]:
    """Columns that every refinement row ends with."""
    return f"{solution.newton}", f"{solution.steps}", f"{solution.min_jacobian:.3f}", f"{prep:.2f}", f"{solution.cpu_s:.2f}"


COUNTS = ("Newton", "load steps", "min J", "prep s", "CPU s")


def row(label: str, work: Callable[[], tuple[Solution, Sequence[str], float]]) -> tuple[float, float] | None:
    """One row of a refinement table; its error and CPU seconds with the preparation."""
    start = time.process_time()
    try:
        solution, errors, worst = work()
    except SimulationError as failure:
        line(label, f"did not converge: {failure}")
        return None
    prep = time.process_time() - start
    line(label, solution.unknowns, *errors, *counts(solution, prep))
    return worst, solution.cpu_s + prep


def beam_row(
    bricks: tuple[int, int, int], kappa: tuple[float, float] = (10.0, 0.0), **steering: float
) -> tuple[float, float] | None:
    """One solution of problem 1."""

    def work() -> tuple[Solution, Sequence[str], float]:
        solution, at = solve_beam(beam_mesh(bricks), kappa, **steering)
        errors = at[0] - BEAM_MOVED["x"], at[2] - BEAM_MOVED["z"]
        return solution, [f"{e:+.4f}" for e in errors], float(np.abs(errors).max())

    return row(f"{bricks}, kappa {text(kappa)}", work)


def ellipsoid_row(
    size: float,
    layers: int,
    kappa: tuple[float, float] = (100.0, 0.0),
    series: list[list[float]] | None = None,
    **steering: float,
) -> tuple[float, float] | None:
    """One solution of problem 2."""

    def work() -> tuple[Solution, Sequence[str], float]:
        solution, found = solve_ellipsoid(meshes.ellipsoid(size, layers), kappa, **steering)
        errors = [found[name] - z for name, (_, z) in ELLIPSOID_APICES.items()]
        volume = 100 * (found["cavity_volume"] / ELLIPSOID_VOLUME - 1)
        # apices may be right by luck: a row counts only with its cavity within the 0.3 % asked for
        worst = float(np.abs(errors).max()) if abs(volume) <= 0.3 else np.inf
        if series is not None:
            series.append([found[name] for name in ELLIPSOID_APICES])
        return solution, [*[f"{e:+.4f}" for e in errors], f"{volume:+.3f}"], worst

    return row(f"{size:g} mm, {layers} layers, kappa {text(kappa)}", work)


def sphere_row(size: float, radius: float, kappa: tuple[float, float] = (0.0, 0.0)) -> tuple[float, float] | None:
    """One inflation of the sphere; the worst inner node counts."""

    def work() -> tuple[Solution, Sequence[str], float]:
        solution, radii = solve_sphere(meshes.sphere(*SPHERE_RADII, size), radius, kappa)
        worst = 100 * float(np.abs(radii / radius - 1).max())
        return solution, [f"{100 * (radii.mean() / radius - 1):+.4f}", f"{worst:.4f}"], worst

    return row(f"{size:g} mm to {radius:g} mm, kappa {text(kappa)}", work)


def text(kappa: tuple[float, float]) -> str:
    """Bulk moduli in words."""
    return f"{kappa[0]:g} + {kappa[1]:g}" if kappa[1] > 0 else f"{kappa[0]:g} + inf"


def against(name: str, rows: Sequence[tuple[float, float] | None], asked: float) -> None:
    """The cheapest row within the error asked for, beside other codes."""
    good = [r for r in rows if r is not None and r[0] <= asked]
    if not good:
        print(f"  no row is within {asked:g} mm")
        return
    error, seconds = min(good, key=lambda r: r[1])
    print(f"  cheapest within {asked:g} mm: {error:.4f} mm in {seconds:.2f} CPU s with preparation")
    print(
        "  CPU s of others (on their own meshes) / ours: "
        + ", ".join(f"{code} {cpu / seconds:.1f}" for code, cpu in OTHERS[name].items())
    )


def refinements(quick: bool) -> Iterator[str]:
    """All tables but the checks; yields their titles as they begin."""
    yield "Land 1, beam: bricks (x, y, z), kappa at the points + on the field (kPa); errors in mm"
    line("", "unknowns", "x", "z", *COUNTS)
    bricks = [(8, 1, 1), (12, 2, 2), (16, 2, 2), (24, 4, 4)] + ([] if quick else [(28, 4, 5), (32, 4, 6), (40, 6, 6)])
    against("beam", [beam_row(b) for b in bricks], 0.02)
    for kappa in ((0.0, 0.0), (100.0, 0.0), (10.0, 990.0), (10.0, 9990.0)):
        beam_row((16, 2, 2), kappa)
    line("  in load steps of a fifth")
    beam_row((16, 2, 2), first_step=0.2)
    line("  damped on demand alone")
    beam_row((16, 2, 2), viscosity=0.002, first_viscosity=0.0)

    yield "Land 2, ellipsoid: cells' size, layers in the wall; errors in mm, of the cavity in %"
    line("", "unknowns", "endo", "epi", "cavity", *COUNTS)
    series: list[list[float]] = []
    sizes = [(4.5, 1), (3.5, 1), (2.8, 1), (2.8, 2)] + ([] if quick else [(2.2, 2), (1.8, 2)])
    against("ellipsoid", [ellipsoid_row(size, layers, series=series if layers == 2 else None) for size, layers in sizes], 0.02)
    for kappa in ((20.0, 0.0), (100.0, 900.0), (100.0, 9900.0)):
        ellipsoid_row(2.8, 1, kappa)
    line("  in load steps of an eighth")
    ellipsoid_row(2.8, 1, first_step=0.125)
    line("  damped on demand alone")
    ellipsoid_row(2.8, 1, viscosity=0.3, first_viscosity=0.0)
    if len(series) == 3:
        for k, (name, (_, z)) in enumerate(ELLIPSOID_APICES.items()):
            # errors fall as h^3 (2.8 to 2.2 mm against 2.2 to 1.8 mm says so too): from the last two meshes
            last, before = series[2][k], series[1][k]
            limit = last + (last - before) / ((2.2 / 1.8) ** 3 - 1)
            print(f"  {name}: extrapolated with h^3 {limit:.4f}, reference {z}, {limit - z:+.4f} mm (aim 0.01)")

    yield "Sphere: cells' size, inner radius; mean and worst node, %"
    line("", "unknowns", "mean", "worst", *COUNTS)
    for size in (4.0, 3.0, 2.0, 1.5):
        for radius in (11.0, 13.0):
            sphere_row(size, radius)
    sphere_row(2.0, 13.0, (0.0, 2e3))
    sphere_row(2.0, 13.0, (0.0, 2e5))


def main() -> None:
    """Checks with asked and aim, then the tables."""
    line("check", "measured", "asked", "", "aim", "", "CPU s")
    for name in verification.PROBLEMS:
        for check in verification.verify(name):
            aim = AIMS.get(check.quantity, AIMS.get(name))
            beyond = ("-", "") if aim is None else (f"{aim:g}", "ok" if check.error <= aim else "missed")
            verdict = "ok" if check.passed else "MISSED"
            line(f"{name} {check.quantity}", f"{check.error:.2e}", f"{check.tolerance:g}", verdict, *beyond, f"{check.cpu_s:.2f}")
    tables = refinements("--quick" in sys.argv)
    for title in tables:
        print(f"\n{title}")


if __name__ == "__main__":
    main()
