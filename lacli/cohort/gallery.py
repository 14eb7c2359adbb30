"""The atria of a study side by side: what their bundles show, from one side."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import pandas as pd

from lacli.anatomy.coordinates.describe import cell_label
from lacli.anatomy.pictures import views
from lacli.base.errors import AnatomyError
from lacli.contracts.bundle import load
from lacli.contracts.labels import ENDO, REGION_COLOURS, REGIONS, RING_COLOUR
from lacli.report.cohort_figures import Atrium

_NAMES = {number: name for name, number in REGIONS.items()}
_BACK = 1  # of ``views``: the posterior wall, between the veins
_YES = ("1", "1.0", "yes", "true", "y", "af", "paroxysmal", "persistent")


def atria(anatomies: pd.DataFrame, study: Path) -> tuple[list[Atrium], list[str]]:
    """The endocardia of a study's table of anatomies, and in words those whose bundle is gone or damaged."""
    found, lacking = [], []
    for patient, place in zip(anatomies["participant_id"].astype(str), anatomies["bundle"].astype(str), strict=True):
        try:
            bundle = load(study / place)
        except AnatomyError as error:
            lacking.append(f"{patient} is not shown: {error}")
            continue
        faces = bundle.triangles[bundle.tags == ENDO][:, :3]
        owner = cell_label(bundle, faces).tolist()
        colours = [REGION_COLOURS[_NAMES[number]] if number in _NAMES else RING_COLOUR for number in owner]
        _, direction, up = views(bundle)[_BACK]
        found.append(Atrium(patient, bundle.points[faces], colours, direction, up))
    return found, lacking


def with_fibrillation(others: Mapping[str, str]) -> bool:
    """Whether a participant's column ``af`` says that they have atrial fibrillation."""
    return str(others.get("af", "")).strip().lower() in _YES
