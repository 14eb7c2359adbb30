"""Names of a module that are loaded from their homes when they are first used, so that an import is quick."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping, Sequence


def names_from(module: str, homes: Mapping[str, Sequence[str]]) -> Callable[[str], object]:
    """A ``__getattr__`` of ``module``: homes: a module's name -> the names that it has, ``theirs as ours`` where they differ."""
    home: dict[str, tuple[str, str]] = {}
    for place, names in homes.items():
        for name in names:
            theirs, _, ours = name.partition(" as ")
            home[ours or theirs] = (place, theirs)

    def find(name: str) -> object:
        if name not in home:
            raise AttributeError(f"module {module!r} has no attribute {name!r}")
        place, theirs = home[name]
        return getattr(importlib.import_module(place), theirs)

    return find
