"""Whether two products are the same: bit for bit, or to the solver's tolerance. Used by shots.py."""

from __future__ import annotations


def same(one: object, other: object) -> str:
    """``bit``, ``tolerance`` (numbers within 1e-6 of each other) or ``NO``."""
    if repr(one) == repr(other):
        return "bit"
    if isinstance(one, dict) and isinstance(other, dict) and one.keys() == other.keys():
        kinds = {same(one[key], other[key]) for key in one}
    elif isinstance(one, list) and isinstance(other, list) and len(one) == len(other):
        kinds = {same(a, b) for a, b in zip(one, other, strict=True)}
    elif isinstance(one, float) and isinstance(other, float) and abs(one - other) <= 1e-6 * max(1.0, abs(one)):
        return "tolerance"
    else:
        return "NO"
    return "NO" if "NO" in kinds else "tolerance" if "tolerance" in kinds else "bit"
