"""What a calibration tells is of the same targets: also where the very last run shows that a frame has several states."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from test_sequential_branches import EARLY, ES, calibrated, targets_at

from lacli.calibration.sequential import branches
from lacli.calibration.sequential.branches import Branches
from lacli.calibration.sequential.evidence import Evidence
from lacli.contracts.targets import Targets

TRUTH = (3.0, 6.0)


@pytest.mark.parametrize("runs_before_the_end", [0, 2])
def test_a_frame_that_falls_at_the_end_is_in_nothing_that_is_told(runs_before_the_end: int, tmp_path: Path) -> None:
    whole = calibrated(targets_at(TRUTH), tmp_path / "whole", swing=0.0)
    assert whole.left_out == ()
    look, last = branches.look, len(whole.x) - runs_before_the_end

    def late(evidence: Evidence, targets: Targets, order: object = None) -> Branches:
        seen = look(evidence, targets, order)  # type: ignore[arg-type]
        several = len(evidence.z) >= last and set(EARLY) <= set(targets.names)
        return Branches((0.1,), seen.strays, seen.torn) if several else seen

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(branches, "look", late)
        found = calibrated(targets_at(TRUTH), tmp_path / "late", swing=0.0)
    assert found.left_out == EARLY
    assert [row["feature"] for row in found.fit] == list(ES)
    for row in found.fit:  # the emulator speaks of the same features
        assert float(row["emulated"]) == pytest.approx(float(row["simulated"]), abs=0.02)
    # and so does the posterior: as that of the targets that are left
    fewer = calibrated(targets_at(TRUTH).select(ES), tmp_path / "fewer", swing=0.0)
    flat, exact = found.chain.flat(), fewer.chain.flat()
    assert np.abs(flat.mean(0) - exact.mean(0)).max() < 0.2 * exact.std(0).max()
    assert flat.std(0) == pytest.approx(exact.std(0), rel=0.15)
    assert exact.std(0)[1] > 1.05 * whole.chain.flat().std(0)[1]  # the frame did tell something
