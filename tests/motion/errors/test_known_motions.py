"""Known motions, by which a patient's errors of tracking are told."""

from __future__ import annotations

import numpy as np

from lacli.anatomy.inputs.image import Image
from lacli.motion.errors import uncertainty
from lacli.motion.field import Field


def test_known_motions_start_from_one_end_diastole() -> None:
    """A patient's frames are registered to one image, and err together by its noise; the second images' noise is each its own."""
    flat = Image(np.zeros((8, 8, 8), np.float32), np.ones(3), np.zeros(3), np.eye(3))
    of = uncertainty.Template(flat, 20.0, 0.0)
    still = Field(np.zeros((8, 8, 8, 3), np.float32), np.ones(3), np.zeros(3), np.eye(3))
    points = np.full((1, 3), 3.5)
    known = [uncertainty.known_pair("again", of, None, points, 0)]
    known += [uncertainty.known_pair("frame", of, still, points, seed) for seed in (1, 2)]
    rest, moved = ([getattr(k.pair, name).array for k in known] for name in ("fixed", "moving"))
    assert np.array_equal(rest[0], rest[1]) and np.array_equal(rest[0], rest[2])
    noise = np.array([rest[0], *moved]).reshape(4, -1)
    assert np.abs(np.corrcoef(noise) - np.eye(4)).max() < 0.2
