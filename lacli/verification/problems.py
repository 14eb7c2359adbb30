"""The verification problems by name: each compares what the engine computes with what is known."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from lacli.base.errors import SimulationError, UsageError
from lacli.verification.equilibria import beam, ellipsoid, sphere, unload
from lacli.verification.forms import patch, pressure, spring
from lacli.verification.laws import law
from lacli.verification.prestrain import prestrain
from lacli.verification.runs import Check
from lacli.verification.sensitivities import sensitivities

__all__ = ["PROBLEMS", "Check", "choose", "verify"]

# quick ones first
PROBLEMS: dict[str, Callable[[], list[Check]]] = {
    "law": law,
    "patch": patch,
    "pressure": pressure,
    "spring": spring,
    "sphere": sphere,
    "beam": beam,
    "ellipsoid": ellipsoid,
    "unload": unload,
    "prestrain": prestrain,
    "sensitivities": sensitivities,
}


def choose(names: Sequence[str]) -> list[str]:
    """The problems asked for, all if none is named, each once. Raises UsageError for an unknown name."""
    if unknown := [name for name in names if name not in PROBLEMS]:
        raise UsageError(f"No verification problem is called {', '.join(unknown)}. There are: {', '.join(PROBLEMS)}.")
    return [name for name in PROBLEMS if name in names or not names]


def verify(name: str) -> list[Check]:
    """Run one problem. One that does not converge is a failed check, so that the others are still seen.

    Raises SolverMissingError, UsageError.
    """
    (name,) = choose([name])
    try:
        return PROBLEMS[name]()
    except SimulationError as error:
        nothing = float("nan")
        return [Check(name, f"did not end: {error}", nothing, nothing, nothing, nothing, False, 0, nothing)]
