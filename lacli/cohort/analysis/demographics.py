"""Who the participants are, over all of them: numbers by mean, spread and range, words by how often they stand."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd

HEAD = ("quantity", "known", "mean ± sd", "least to most", "how many")
_MOST_WORDS = 6


def demographics(people: pd.DataFrame, leave: Sequence[str] = ()) -> list[tuple[str, ...]]:
    """A row a column of the table of participants, in its units: known in how many, mean ± sd and range of numbers, counts of
    words. Left out are ``leave`` and words that differ in nearly all."""
    rows: list[tuple[str, ...]] = []
    for name in people.columns:
        if name in leave:
            continue
        known = people[name].dropna()
        numbers = pd.to_numeric(known, errors="coerce")
        few = known.nunique() <= _MOST_WORDS and (known.nunique() < len(known) or len(known) == 1)
        if len(known) and numbers.notna().all() and not (set(numbers) <= {0, 1}):
            values = numbers.to_numpy(float)
            spread = f" ± {values.std(ddof=1):.3g}" if len(values) > 1 else ""
            rows.append(
                (str(name), str(len(values)), f"{values.mean():.4g}{spread}", f"{np.min(values):.4g} to {np.max(values):.4g}", "")
            )
        elif len(known) and few:
            counts = known.astype(str).value_counts(sort=False)
            said = ", ".join(
                f"{word}: {count}" for word, count in sorted(counts.items(), key=lambda pair: (-pair[1], str(pair[0])))
            )
            rows.append((str(name), str(len(known)), "", "", said))
    return rows
