"""Simulated against tracked transients, and their difference by frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lacli.contracts.labels import BODY_REGIONS, REGION_COLOURS
from lacli.motion.check.validation import Validation
from lacli.report.style import paper

_ROWS = (("volume_ml", "volume, change (mL)"), ("d_{}_mm", "|u| (mm)"), ("n_{}_mm", "normal (mm)"), ("a_{}_mm", "alpha (mm)"),
         ("b_{}_mm", "beta (mm)"))  # fmt: skip


def transients(found: Validation, picture: Path) -> Path:
    """Tracked points with bars of 2 sd, simulated lines; frames the calibration used are filled, others open; RMSE below."""
    with paper():
        import matplotlib.pyplot as plt

        rows = [(pattern, label) for pattern, label in _ROWS if pattern.format("roof") in found.keys]
        figure, axes = plt.subplots(len(rows) + 1, 1, figsize=(5.2, 1.7 * (len(rows) + 1)), sharex=True, squeeze=False)
        for axis, (pattern, label) in zip(axes[:, 0], rows, strict=False):
            for region in BODY_REGIONS if "{}" in pattern else ("",):
                key = pattern.format(region)
                if key not in found.keys:
                    continue
                j, colour = found.keys.index(key), REGION_COLOURS.get(region, "#333333")
                axis.plot(found.times, found.simulated[:, j], color=colour, linewidth=1.2, label=region or None)
                bars = 2.0 * np.nan_to_num(found.sd[:, j])
                axis.errorbar(found.times, found.tracked[:, j], yerr=bars, fmt="none", ecolor=colour, elinewidth=0.7, alpha=0.6)
                for used, face in ((True, colour), (False, "white")):
                    mine = found.used[:, j] == used
                    axis.plot(found.times[mine], found.tracked[mine, j], "o", color=colour, markerfacecolor=face, markersize=3.5)
            axis.set_ylabel(label)
        frame = found.by_frame()
        last = axes[-1, 0]
        last.bar(frame["time"], frame["in_sd"], width=0.5 * float(np.diff(found.times, prepend=0.0).min()),
                 color=["#333333" if used else "#C8C8C8" for used in frame["used"]])  # fmt: skip
        last.set_ylabel("RMS difference (sd)")
        last.set_xlabel("time (fraction of the RR interval); filled, dark: used by the calibration")
        handles, _ = axes[min(1, len(rows) - 1), 0].get_legend_handles_labels()
        if handles:
            figure.legend(loc="outside upper center", ncols=len(handles), handles=handles)
        figure.savefig(picture)
        plt.close(figure)
    return picture
