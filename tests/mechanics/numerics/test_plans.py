"""The plan of a scene is code: it is in no run's key but by METHODS["runs"], so whoever changes it must raise that."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from shapes import fibrous_ball

from lacli.contracts.identity import METHODS, content_hash, flatten
from lacli.contracts.motion import Motion
from lacli.contracts.scene import build_scene
from lacli.mechanics import plan

# METHODS["runs"], and the digest of the plans below
KEPT = (3, "b15daf1a75c4629f")
LOADS = ("loads.edp_mmhg=8", "loads.esp_mmhg=18", "loads.vein_spring_kpa_per_um=0")
SCENES = [
    LOADS,
    (*LOADS, "outputs.frames=4"),
    (*LOADS, "outputs.frames=4", "outputs.conduit=true"),
    (*LOADS, "outputs.times=[0.1, 0.4, 0.7]", "outputs.equilibria=true"),
    (*LOADS, "loads.edp_mmhg=0", "pericardium.k_peri_kpa_per_um=0"),
    (*LOADS, "numerics.unloading=backward"),
    (*LOADS, "numerics.rest_sweeps=2", "outputs.sensitivities=true", "outputs.unloaded=false"),
]


def digest() -> str:
    """Of the plans of the scenes with the ring held and moving, but their titles; numbers to nine digits."""
    ball = fibrous_ball(order=1)
    moving = Motion(np.array([0.0, 0.4]), np.array([0]), np.zeros((2, 1, 3)), 0.35)
    found = {}
    for number, settings in enumerate(SCENES):
        scene = build_scene({"anatomy": {"bundle": "la"}}, list(settings), folder=Path("/"), where="test")
        for motion in (None, moving):
            made = flatten(dataclasses.replace(plan.make_plan(scene, ball, motion), title=""))
            for key, value in made.items():
                found[f"{number}.{motion is not None}.{key}"] = f"{value:.9g}" if isinstance(value, float) else value
    return content_hash(found)


def test_plans_are_those_of_the_number_of_the_method() -> None:
    assert (METHODS["runs"], digest()) == KEPT, 'plans have changed: raise METHODS["runs"], and write number and digest here'


def test_another_order_of_states_is_another_digest(monkeypatch: pytest.MonkeyPatch) -> None:
    """What this is for: states before end-systole from end-diastole up, in place of from end-systole backward."""
    before, phases = digest(), plan._phases
    monkeypatch.setattr(plan, "_phases", lambda *given: tuple(sorted(phases(*given), key=lambda phase: phase.time_to)))
    assert digest() != before
