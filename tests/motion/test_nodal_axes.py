"""The wall's own axes at the bundle's points."""

from __future__ import annotations

import numpy as np
import pytest

from lacli.anatomy.surface_features import Endocardium
from lacli.contracts.labels import PLANES
from lacli.motion.axes import nodal_axes, wall_normals
from lacli.motion.errors.uncertainty import EASIER, as_of_a_true_motion
from lacli.synthetic.atrium import synthesize


def test_an_error_across_a_valve_plane_is_one_along_its_normal() -> None:
    bundle = synthesize(1, volume_ml=40.0, cell_size_mm=6.0, order=1, descent_mm=4.0)[0]
    surface = Endocardium.of(bundle)
    normal, endocardial = wall_normals(bundle, surface), nodal_axes(bundle, surface)["normal"]
    plane = np.unique(bundle.triangles[bundle.tags == PLANES["mv"]])
    inside = plane[~endocardial[plane].any(axis=1)]
    assert len(inside)
    across = bundle.points[plane].mean(axis=0) - bundle.points[np.unique(bundle.cavity_triangles())].mean(axis=0)
    mean = normal[inside].mean(axis=0)
    assert mean @ across / np.linalg.norm(across) > 0.8, "out of the cavity"
    error = 0.3 * normal
    assert as_of_a_true_motion(error, normal)[inside] == pytest.approx(EASIER[0] * error[inside])
    on = endocardial.any(axis=1)
    assert np.array_equal(normal[on], endocardial[on])
    rest = np.setdiff1d(np.arange(len(normal)), np.unique(surface.closed))
    assert not normal[rest].any()
