"""Numbers that the FreeFEM scripts and Python share, by name; ``solvers/freefem/names.idp`` has the same, and a test compares."""

from __future__ import annotations

from enum import IntEnum


class Task(IntEnum):
    """What the engine assembles: the residual, or it and a tangent; KEEP_PRESTRAIN is a verification's question alone: x is the
    prestrain's field v, and the wall has its strain for this form (residual at X) and all that follow."""

    RESIDUAL = 0
    SYMMETRIC = 1
    UNSYMMETRIC = 2
    INVERSE = 3
    PRESTRAIN_RESIDUAL = 4
    PRESTRAIN = 5
    KEEP_PRESTRAIN = 6


class Faces(IntEnum):
    """What loads faces; OUTWARD: the pericardium against outward motion only."""

    PRESSURE = 0
    VEINS = 1
    PERICARDIUM = 2
    OUTWARD = 3


class Rates(IntEnum):
    """Which step of the derivatives went wrong."""

    RIGHT = 0
    STATE = 1
    FACTORS = 2
    SLOPES = 3
    SOLUTION = 4
    FILE = 5
