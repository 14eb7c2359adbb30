"""Walls over the patients: thickness measured two ways, epicardial fat by window, region by region."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from lacli.cohort.analysis.fits import Anatomy
from lacli.contracts.labels import BODY_REGIONS

LAPLACE, EIKONAL = "thickness_laplace_mm", "thickness_eikonal_mm"


def walls(patient: str, anatomy: Anatomy | None, fat: Mapping[str, Mapping[str, float]]) -> list[dict[str, Any]]:
    """A row a region: mean thickness along Laplace's lines and by the eikonal (mm), fat in each window (mL)."""
    rows = []
    for region in BODY_REGIONS:
        row: dict[str, Any] = {"participant_id": patient, "region": region}
        if anatomy is not None:
            row |= {LAPLACE: anatomy.laplace_mm.get(region), EIKONAL: anatomy.eikonal_mm.get(region)}
        row |= {f"fat_{name}_ml": of.get(region) for name, of in fat.items()}
        if len(row) > 2:
            rows.append(row)
    return rows


def windows_of(frame: pd.DataFrame) -> list[str]:
    """The fat's windows in a table of walls, that of the answer first."""
    return sorted(
        (str(n)[4:-3] for n in frame.columns if str(n).startswith("fat_") and str(n).endswith("_ml")),
        key=lambda name: (name != "standard", name),
    )


def over_walls(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Over the patients, by region and for "all": mean and sd of either thickness and the median of their difference (mm); the
    fat's mean and sd by window (mL; of "all" the patients' totals)."""
    frame = pd.DataFrame(list(rows))
    found = []
    for region in (*BODY_REGIONS, "all"):
        mine = frame if region == "all" else frame[frame["region"] == region]
        row: dict[str, Any] = {"region": region, "patients": int(mine["participant_id"].nunique())}
        for name in (LAPLACE, EIKONAL):
            if name in frame:
                row |= _about(name.removesuffix("_mm"), "mm", mine.groupby("participant_id")[name].agg("mean"))
        if LAPLACE in frame and EIKONAL in frame:
            off = (mine[LAPLACE] - mine[EIKONAL]).abs().dropna().to_numpy(float)
            row["thickness_median_difference_mm"] = float(np.median(off)) if len(off) else None
        for window in windows_of(frame):
            total = mine.groupby("participant_id")[f"fat_{window}_ml"].sum(min_count=1)
            row |= _about(f"fat_{window}", "ml", total)
        found.append(row)
    return found


def _about(name: str, unit: str, values: pd.Series[Any]) -> dict[str, float | None]:
    known = values.dropna().to_numpy(float)
    sd = float(known.std(ddof=1)) if len(known) > 1 else None
    return {f"{name}_mean_{unit}": float(known.mean()) if len(known) else None, f"{name}_sd_{unit}": sd}
