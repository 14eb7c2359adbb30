"""Paired t-tests between all pairs of regions, corrected by Bonferroni and Holm."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy import stats

from lacli.base.arrays import FloatArray
from lacli.cohort.analysis.observations import Observations

_FEWEST_FOR_SHAPIRO = 3


@dataclass(frozen=True)
class PairedTest:
    """First minus second region over the patients.

    difference: mean, in the quantity's unit; sd: of the differences; t with df degrees of freedom; p two-sided; bonferroni and
    holm: p corrected over all pairs; shapiro: p of the differences' normality (with ten patients it finds only gross
    departures); wilcoxon: p of the signed-rank test, which needs no normality. NaN where undefined.
    """

    first: str
    second: str
    difference: float
    sd: float
    t: float
    df: int
    p: float
    bonferroni: float
    holm: float
    shapiro: float
    wilcoxon: float

    @property
    def stars(self) -> str:
        """Of the Bonferroni-corrected p: ``*`` < .05, ``**`` < .01, ``***`` < .001."""
        return "*" * sum(self.bonferroni < level for level in (0.05, 0.01, 0.001))


def paired_tests(observed: Observations, name: str) -> list[PairedTest]:
    """One test for each pair of regions, in the table's order."""
    values = observed.values[name]
    pairs = list(combinations(range(len(observed.regions)), 2))
    rows = []
    for i, j in pairs:
        d = values[:, i] - values[:, j]
        sd = float(d.std(ddof=1))
        constant = not sd > 1e-12 * float(np.abs(values).max() or 1.0)
        t = float("nan") if constant else float(d.mean() / (sd / np.sqrt(len(d))))
        p = float("nan") if constant else float(2 * stats.t.sf(abs(t), len(d) - 1))
        shapiro = float("nan") if constant or len(d) < _FEWEST_FOR_SHAPIRO else float(stats.shapiro(d).pvalue)
        wilcoxon = float("nan") if constant else float(stats.wilcoxon(d, method="auto").pvalue)
        rows.append((observed.regions[i], observed.regions[j], float(d.mean()), sd, t, len(d) - 1, p, shapiro, wilcoxon))
    raw = np.array([row[6] for row in rows])
    return [
        PairedTest(*row[:7], bonferroni=float(b), holm=float(h), shapiro=row[7], wilcoxon=row[8])
        for row, b, h in zip(rows, bonferroni(raw), holm(raw), strict=True)
    ]


def bonferroni(p: FloatArray) -> FloatArray:
    """Bonferroni's p; a test that is undefined (NaN) counts among the tests and stays undefined."""
    corrected: FloatArray = np.minimum(1.0, p * len(p))
    return corrected


def holm(p: FloatArray) -> FloatArray:
    """Holm's step-down p; a test that is undefined (NaN) counts among the tests and stays undefined."""
    order = np.argsort(p)  # NaN last
    stepped = np.maximum.accumulate(np.minimum(1.0, p[order] * (len(p) - np.arange(len(p)))))
    result: FloatArray = np.empty(len(p))
    result[order] = stepped
    return result
