"""For each kind of thing that is kept: a determining input, whichever, is changed, and nothing old comes back.

Stored runs, run logs, figures and calibrations here, by drawn changes; fields of a scene, emulators, regions, chains, errors of
trade-offs one by one in contracts/test_identity, steps of a study in cohort/test_kept_steps, calibrations by the command in
cli/test_kept. Tracked frames, segmentations, bundles and matches are made anew by every call.
"""

from __future__ import annotations

import dataclasses
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from hypothesis import given, settings
from hypothesis import strategies as st
from membranes import OUTPUTS, box

from lacli.base.errors import UsageError
from lacli.base.files import write_json
from lacli.calibration.sequential.calibration import Settings, sequential_identity
from lacli.cli.mechanics.simulate import _drawing
from lacli.contracts.identity import conflict, identify, run_key
from lacli.contracts.scene import build_scene
from lacli.contracts.targets import Targets
from lacli.inference.runs import Outcome, RunLog, runs_identity
from lacli.mechanics.store import open_run

quick = settings(max_examples=60, deadline=None)
NUMBERS = ("bf", "kappa_kpa", "ring_c_kpa", "edp_mmhg", "esp_mmhg", "pth", "k_peri_kpa_per_um", "tolerance_mm", "es_time")
PLACES = {
    "bf": "materials", "kappa_kpa": "materials", "ring_c_kpa": "materials", "edp_mmhg": "loads", "esp_mmhg": "loads",
    "pth": "pericardium", "k_peri_kpa_per_um": "pericardium", "tolerance_mm": "numerics", "es_time": "motion",
}  # fmt: skip


@quick
@given(name=st.sampled_from(NUMBERS), factor=st.sampled_from([1 + 1e-12, 0.999, 1.01]))
def test_stored_runs(name: str, factor: float) -> None:
    with tempfile.TemporaryDirectory() as home:
        folder = Path(home)
        (folder / "b").mkdir()
        for file in ("wall.vtu", "boundary.vtp"):
            (folder / "b" / file).write_bytes(file.encode())
        old = build_scene({"anatomy": {"bundle": "b"}}, [], folder=folder, where="test")
        value = getattr(getattr(old, PLACES[name]), name)
        new = build_scene({"anatomy": {"bundle": "b"}, PLACES[name]: {name: value * factor}}, [], folder=folder, where="test")
        with open_run(folder / "runs", run_key(old)) as run:
            write_json(run.folder / "features.json", {"edv_ml": 80.5})
            run.finish()
        with open_run(folder / "runs", run_key(old)) as run:
            assert run.stored is not None
        with open_run(folder / "runs", run_key(new)) as run:
            assert run.stored is None


class Toy:
    """Anything, determined by what it is told."""

    def __init__(self, told: Mapping[str, Any]) -> None:
        self.told, self.calls = dict(told), 0

    def __call__(self, inputs: pd.DataFrame) -> Iterator[tuple[int, Outcome]]:
        for index in range(len(inputs)):
            self.calls += 1
            yield index, Outcome({"f": float(len(str(sorted(self.told.items()))))})

    def determined_by(self, inputs: Sequence[str]) -> Mapping[str, Any]:
        return self.told


VALUES = st.one_of(st.integers(-5, 5), st.floats(-1, 1), st.text(max_size=4), st.lists(st.floats(0, 1), max_size=3))


@quick
@given(
    told=st.dictionaries(st.sampled_from("abcde"), VALUES, min_size=1, max_size=4),
    other=st.dictionaries(st.sampled_from("abcde"), VALUES, min_size=1, max_size=4),
)
def test_run_logs(told: dict[str, Any], other: dict[str, Any]) -> None:
    """A log of one simulator, asked by another: refused, or it is the same."""
    with tempfile.TemporaryDirectory() as home:
        file, x = Path(home) / "runs.csv", np.array([[0.1], [0.2]])
        first, second = Toy(told), Toy(other)
        RunLog(file, ["x"], ["f"], runs_identity(first, ["x"], ["f"])).run(first, x)
        same = runs_identity(first, ["x"], ["f"]).content == runs_identity(second, ["x"], ["f"]).content
        try:
            RunLog(file, ["x"], ["f"], runs_identity(second, ["x"], ["f"])).run(second, x)
        except UsageError as error:
            assert not same
            assert any(key in str(error) for key in {*told, *other})
        else:
            assert same and second.calls == 0


@quick
@given(data=st.data())
def test_figures(data: st.DataObject) -> None:
    """Pictures are taken again only where their sources and they themselves are as they were."""
    with tempfile.TemporaryDirectory() as home:
        pictures = [Path(home) / name for name in ("transients.png", "shapes.png")]
        for picture in pictures:
            picture.write_bytes(picture.name.encode())
        sources = {"transients.csv": "a" * 64, "fields/es.vtu": "b" * 64}
        kept = _drawing(sources, pictures)
        assert _drawing(sources, pictures) == kept
        if data.draw(st.booleans()):
            key = data.draw(st.sampled_from(sorted(sources)))
            sources[key] = data.draw(st.text("cdef", min_size=1, max_size=8))
        else:
            data.draw(st.sampled_from(pictures)).write_bytes(data.draw(st.binary(max_size=8)))
        assert conflict(kept, _drawing(sources, pictures), "figures")


@quick
@given(data=st.data())
def test_sequential_calibrations(data: st.DataObject) -> None:
    """Any number of box, targets, covariance, settings, sampler or runs; budgets alone may change."""
    n = len(OUTPUTS)
    runs = {"scene": "one"}
    targets = Targets(OUTPUTS, np.linspace(1, 2, n), np.full(n, 0.1), 0.01 * np.eye(n))
    chosen, space = Settings(), box()
    before = sequential_identity(space, targets, chosen, identify("runs", **runs))
    what = data.draw(st.sampled_from(["lower", "upper", "mean", "sd", "covariance", "settings", "sampler", "runs", "order"]))
    budget = False
    if what in ("lower", "upper"):
        values = getattr(space, what).copy()
        values[data.draw(st.integers(0, space.d - 1))] *= 0.999
        space = dataclasses.replace(space, **{what: values})
    elif what in ("mean", "sd", "covariance"):
        values = getattr(targets, what).copy()
        values.flat[data.draw(st.integers(0, values.size - 1))] += 1e-9
        targets = dataclasses.replace(targets, **{what: values})
    elif what == "order":
        targets = targets.select(OUTPUTS[::-1])
    elif what == "runs":
        runs["scene"] = "two"
    else:
        owner: Any = chosen if what == "settings" else chosen.mcmc
        names = [f.name for f in dataclasses.fields(owner) if isinstance(getattr(owner, f.name), (int, float))]
        name = data.draw(st.sampled_from(names))
        budget = name in ("max_runs", "reference_runs", "share", "correction_share", "rhat", "ess", "max_steps")
        changed = dataclasses.replace(owner, **{name: getattr(owner, name) * 2 + 1})
        chosen = changed if what == "settings" else dataclasses.replace(chosen, mcmc=changed)
    after = sequential_identity(space, targets, chosen, identify("runs", **runs))
    assert (after == before) == budget, what
