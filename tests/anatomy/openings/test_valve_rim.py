"""The valve's own rim is where an open atrium's valve is, however much the atrium narrows towards it."""

from __future__ import annotations

import numpy as np
import pytest

from lacli.anatomy.inputs.repair import repair
from lacli.anatomy.inputs.voxels import voxel_field
from lacli.anatomy.openings.branches import find as find_branches
from lacli.anatomy.openings.finding import find
from lacli.synthetic import variants


@pytest.mark.parametrize("seed", [5, 12])
def test_a_valve_at_the_end_of_a_funnel_stays_there(seed: int) -> None:
    # towards both valves the cavity narrows enough to look like a long vessel, whose rim would be moved to its ostium
    points, triangles, openings = variants.make(seed, "open")
    whole = repair(points, triangles)
    field = voxel_field(whole.surface, 1.0)
    valve = max(whole.rims, key=lambda rim: rim.diameter_mm)
    tips = [branch.tip for branch in find_branches(field).branches]
    assert min(np.linalg.norm(tip - valve.centre) for tip in tips) < valve.diameter_mm
    found = find(whole.surface, whole.rims, None, field=field).landmarks.openings
    for name in ("mv", "rspv", "ripv", "lspv", "lipv"):
        assert np.linalg.norm(found[name].centre - openings[name]) < 2.0, name
    assert found["mv"].diameter_mm == pytest.approx(valve.diameter_mm)
