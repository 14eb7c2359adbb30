"""A second end-systole: what a deck that sought it found, and by how much the features of both differ."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from lacli.anatomy.surface_features import Endocardium
from lacli.contracts.case import Case
from lacli.contracts.features import KEYS
from lacli.mechanics.features import regional_extras
from lacli.mechanics.results import EQUILIBRIA, Results

FOUND, SPREAD = "equilibria", "equilibria_spread"  # of features


def told(case: Case, results: Results) -> dict[str, Any]:
    """What features say of a run that sought end-systole along a second way; nothing where it was not asked to.

    ``equilibria``: ``found`` (1: both ways end at one state; 2; 0: the second way ends nowhere), ``kept`` (the way whose state is
    the result, 1 or 2), ``energy_above_uj`` (of the other's potential over the kept one's, uJ), ``farthest_mm`` (of a component
    of a node between both). ``equilibria_spread``: difference of both by feature, in its unit, 0 where there is one state; absent
    where the second way ends nowhere.
    """
    if EQUILIBRIA not in results.numbers:
        return {}
    line = results.numbers[EQUILIBRIA]
    found, kept = int(line["found"]), int(line["kept"])
    said: dict[str, Any] = {"found": found, "kept": kept}
    if found:
        above = line["second_energy"] - line["first_energy"]  # kPa mm3 are uJ
        said |= {"energy_above_uj": above if kept == 1 else -above, "farthest_mm": line["far_mm"]}
    return {FOUND: said, SPREAD: _spread(case, results)} if found else {FOUND: said}


def _spread(case: Case, results: Results) -> dict[str, float]:
    """By feature at end-systole; 0 of the one state that both ways end at, for what is left is the solver's tolerance."""
    surface = Endocardium.of(case.bundle)
    ed, es = results.states["ed"].x, results.states["es"].x
    pair = []
    for x in (es, es if results.other is None else results.other):
        features = surface.features(x)
        extras = regional_extras(case.bundle, ed, x) if case.scene.outputs.strain else {}
        pair.append({"esv_ml": features.pop("volume_ml"), **features, **extras})
    return {name: abs(pair[1][name] - value) for name, value in pair[0].items()}


def said_of(features: Mapping[str, Any]) -> str:
    """What a user is told of a run that sought end-systole twice: what differs most; '' where it found one, or sought none."""
    stated = features.get(FOUND)
    if not isinstance(stated, Mapping):
        return ""
    if stated["found"] == 0:
        return "No second end-systole: the load found no equilibrium in parts, and whether there is another is not known."
    if stated["found"] < 2:
        return ""
    spread = features[SPREAD]
    lengths = {name: value for name, value in spread.items() if name in KEYS and KEYS[name].unit == "mm"}
    most = max(lengths, key=lambda name: lengths[name])
    way = "the first" if stated["kept"] == 1 else "the second"
    return (
        f"This wall has more than one equilibrium at end-systole: two ways to it end apart by {lengths[most]:.2g} mm in {most} "
        f"and {spread['esv_ml']:.2g} mL in volume. Shown is the one with less energy, {way} way's."
    )
