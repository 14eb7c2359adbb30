"""Names that are loaded when they are first used."""

from __future__ import annotations

import json

import pytest

from lacli.base.lazy import names_from


def test_a_name_is_its_home_s_under_either_name() -> None:
    find = names_from("here", {"json": ("loads", "dumps as write")})
    assert find("loads") is json.loads and find("write") is json.dumps
    for name in ("dumps", "nothing"):
        with pytest.raises(AttributeError, match=f"module 'here' has no attribute '{name}'"):
            find(name)


def test_homes_are_not_imported_before() -> None:
    find = names_from("here", {"lacli.no_such_module": ("thing",)})
    with pytest.raises(ModuleNotFoundError):
        find("thing")
