"""Named errors. Each message says what was wrong, where, and what to do; the command line prints it bare."""

from __future__ import annotations


class LacliError(Exception):
    """Base of every expected failure: the command line prints the message and exits with ``exit_code``."""

    exit_code = 1


class UsageError(LacliError):
    """The call itself is wrong (an option, a key of a scene, a column name)."""

    exit_code = 2


class Cancelled(LacliError):
    """The caller of a function no longer wanted it; what was finished is kept, as after Ctrl-C."""


class SceneError(UsageError):
    """A scene, or an override of it, is not valid."""


class InputError(LacliError):
    """An input file is missing, damaged or not what it claims to be."""


class AnatomyError(InputError):
    """A bundle, surface or image does not describe a usable left atrium."""


class TableError(InputError):
    """A table of runs, or a targets file, cannot be used."""


class SolverMissingError(LacliError):
    """FreeFEM, or a part of it, is not installed."""


class SimulationError(LacliError):
    """A simulation ended without a result; ``kind`` names why (``timeout``, ``inverted_element``, ...)."""

    def __init__(self, kind: str, message: str) -> None:
        super().__init__(message)
        self.kind = kind


class MachineError(SimulationError):
    """The machine, not the scene, ended something: killed, no memory, a lost worker (``lacli.contracts.failures``)."""


class StorageError(LacliError):
    """A result could not be written (disk full, no permission)."""
