"""Kinds of failure: those of a scene are results, those of the machine are not. The one list of both.

A run that ends with a kind of ``MACHINE`` is kept nowhere: it is no row, no failure that an emulator or a feasibility
model learns from, and it runs again when it is asked for again. Whoever keeps or counts runs asks ``of_the_machine``.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

# of the machine: what happened, in words
MACHINE: Mapping[str, str] = MappingProxyType(
    {
        "killed": "ended from outside (a signal)",
        "out_of_memory": "the memory was not enough",
        "disk_full": "the disk was full",
        "lost_worker": "the worker of the cluster that did it was lost",
        "cancelled": "cancelled before it had ended",
        "starved": "given too little of a processor in numerics.timeout_s",
    }
)

# of the scene: the same scene ends so again, whatever the machine
SCENE: Mapping[str, str] = MappingProxyType(
    {
        "timeout": "longer than numerics.timeout_s, most of them computing",
        "load_step_underflow": "no equilibrium found at the next load, however small the step",
        "inverted_element": "a cell turned inside out",
        "linear_solver": "the linear system could not be solved",
        "newton_limit": "no equilibrium found within the steps allowed",
        "diverged": "the search for an equilibrium ran away",
        "unstable": "end-systole is no stable equilibrium, and none is near it",
        "unloading_diverged": "no unloaded shape found",
        "mesh_order": "FreeFEM reordered the cells of the mesh",
        "engine": "the engine cannot do what the scene asks for",
        "freefem_error": "FreeFEM stopped with an error",
        "bad_output": "FreeFEM's results cannot be read",
    }
)

# a run that was stopped after its time, and had a processor for less than this share of it, waited for the machine
STARVED_BELOW = 0.5
TRANSIENT_KINDS = frozenset(MACHINE)
# after so many ends of one run by the machine it is no accident: it is given up, with what would help
MOST_ATTEMPTS = 3


def of_the_machine(kind: str | None) -> bool:
    """Whether a run that ended with this kind says nothing about its scene and is to be done again."""
    return kind in MACHINE


def out_of_time(cpu_s: float, timeout_s: float) -> tuple[str, str]:
    """Kind and message of a run that was stopped after ``timeout_s`` seconds by the clock, having computed for ``cpu_s`` of them.

    ``timeout`` where it had a processor for most of them: the scene takes longer. ``starved`` where it had not: how long the
    scene takes is not known.
    """
    if cpu_s < STARVED_BELOW * timeout_s:
        return "starved", (
            f"FreeFEM was stopped after {timeout_s:g} s (numerics.timeout_s), but had a processor for {cpu_s:.2g} s of them: "
            "the machine was busy with other work, or its disk was slow."
        )
    return "timeout", f"FreeFEM was stopped after {timeout_s:g} s (numerics.timeout_s)."
