"""Every feature of a deformed atrium that images and simulations share: key, unit, definition. Targets bear the same names.

A feature at a time of the cycle is ``<key>@<time>``, the time as a fraction of the RR interval from end-diastole (ED):
``n_septum_mm@0.25``. A key alone, and ``esv_ml``, stand at end-systole (ES), the peak of the volume.

Displacements and strains are from ED as it was imaged, the bundle's shape. A simulation's own ED is that shape, but where the
wall has settled from it (``numerics.settle_ed``) or an unloaded shape was sought (``numerics.unloading`` "backward"): there they
hold what lies between both too, and of this table ``edv_ml`` alone is of the simulation's own ED.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from lacli.contracts.labels import BODY_REGIONS

TIME_DIGITS = 4
SAME_TIME = 10.0**-TIME_DIGITS  # times nearer than this have one name


@dataclass(frozen=True)
class Feature:
    """``key`` as in every table; ``unit`` ("" for a ratio); ``definition`` in a sentence; ``region`` or None for the whole;
    ``possible``: a closed range that no atrium leaves."""

    key: str
    unit: str
    definition: str
    region: str | None = None
    possible: tuple[float, float] = (-math.inf, math.inf)


_VOLUME, _LENGTH, _ALONG = (0.0, 2000.0), (0.0, 200.0), (-200.0, 200.0)
_REGIONAL = {
    "d_{}_mm": ("mm", _LENGTH, "mean of |u|, u the displacement of the endocardium from ED as imaged"),
    "n_{}_mm": ("mm", _ALONG, "mean of u along the outward normal of the ED surface"),
    "a_{}_mm": ("mm", _ALONG, "mean of u along the unit tangent of growing UAC alpha (septal to lateral), fixed at ED"),
    "b_{}_mm": ("mm", _ALONG, "mean of u along the unit tangent of growing UAC beta (posterior to anterior), fixed at ED"),
    "area_strain_{}": ("", (-1.0, 20.0), "deformed over ED area of the endocardium, minus 1"),
    "fibre_strain_{}": ("", (-0.5, 20.0), "mean Green-Lagrange strain of the endocardial surface along the fibre"),
}

FEATURES: tuple[Feature, ...] = (
    Feature("edv_ml", "mL", "volume inside endocardium and valve planes at ED, curved faces", possible=_VOLUME),
    Feature("esv_ml", "mL", "volume inside endocardium and valve planes at ES, curved faces", possible=_VOLUME),
    Feature("volume_ml", "mL", "volume inside endocardium and valve planes, curved faces", possible=_VOLUME),
    Feature(
        "d_global_mm",
        "mm",
        "mean of |u| over the body's endocardium by ED area, u the displacement from ED as imaged",
        possible=_LENGTH,
    ),
    *(
        Feature(pattern.format(region), unit, f"{text}; {region}, by ED area", region, possible)
        for pattern, (unit, possible, text) in _REGIONAL.items()
        for region in BODY_REGIONS
    ),
)
KEYS: dict[str, Feature] = {feature.key: feature for feature in FEATURES}
PUBLISHED: tuple[str, ...] = ("esv_ml", "d_global_mm", *(f"d_{region}_mm" for region in BODY_REGIONS))


def at_time(key: str, time: float) -> str:
    """``<key>@<time>``: at most four digits after the point, no trailing zeros. ValueError for a time outside 0 - 1."""
    if not (math.isfinite(time) and 0.0 <= time <= 1.0):
        raise ValueError(f"a time is a fraction of the RR interval, 0 to 1, got {time}")
    return f"{key}@{round(float(time), TIME_DIGITS):g}"


def parse(name: str) -> tuple[Feature, float | None]:
    """The feature of a name and its time, None where it has none (ES). ValueError where the name is no feature's."""
    key, mark, time = name.partition("@")
    if key not in KEYS:
        raise ValueError(f"{name!r}: no feature {key!r}; there are {', '.join(KEYS)}")
    if not mark:
        return KEYS[key], None
    try:
        value = float(time)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and 0.0 <= value <= 1.0):
        raise ValueError(f"{name!r}: the time after @ is a fraction of the RR interval, 0 to 1")
    return KEYS[key], value


def kind_of(key: str) -> tuple[str, str]:
    """Kind of a feature and its region ("" for the whole): ("n", "roof")."""
    for region in BODY_REGIONS:
        if f"_{region}" in key:
            return key.replace(f"_{region}", "").removesuffix("_mm"), region
    return ("d_global" if key == "d_global_mm" else key.removesuffix("_ml")), ""


def family(name: str) -> str:
    """What features of all times share: ``n_roof_mm`` of ``n_roof_mm@0.25``, ``volume_ml`` of ``esv_ml``. ValueError for what is
    no feature."""
    feature, _ = parse(name)
    return "volume_ml" if feature.key == "esv_ml" else feature.key
