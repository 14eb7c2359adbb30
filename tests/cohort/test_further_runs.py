"""Runs where a model of a comparison is likely and the calibration made none: its evidence against the exact one."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from membranes import INPUTS, OUTPUTS, Membranes, box, respond
from scipy.stats import multivariate_normal

import lacli
from lacli.calibration.sequential.outputs import LOG, SIMULATED, Features
from lacli.calibration.simulator import SceneSimulator, asked
from lacli.cohort.comparison import GLOBAL, REGIONAL, Model, compare, doubts, reduced, tied_regions
from lacli.cohort.models.evidence import evidence
from lacli.cohort.models.further import COMPARED, Doubt, Further, Kind, further, informed
from lacli.contracts.scene import build_scene, dump_scene
from lacli.contracts.targets import Targets
from lacli.freefem.program import FreeFem
from lacli.inference.box import make_box
from lacli.inference.runs import Outcome, RunLog, runs_identity

TRUTH = np.array([0.35, 2.4, 8.9])  # one stiffness for both is none of them
TARGETS = Targets(OUTPUTS, respond(TRUTH)[0], np.full(len(OUTPUTS), 0.15))


def of_membranes(folder: Path, simulator: Membranes, most: int = 16) -> Further:
    """Runs about the truth alone, as a calibration leaves them."""
    log = RunLog(folder / COMPARED, INPUTS, OUTPUTS, runs_identity(simulator, INPUTS, OUTPUTS))
    x = TRUTH * np.exp(0.05 * np.random.default_rng(0).standard_normal((10, 3)))
    log.run(simulator, x)
    return Further(Kind(simulator, log, x, len(x)), None, box(), TARGETS, most)


def models(features: Features | Mapping[str, Features]) -> list[Model]:
    learnt = features if isinstance(features, Mapping) else dict.fromkeys((REGIONAL, GLOBAL), features)
    ties = {GLOBAL: tied_regions(INPUTS)}
    return [Model(name, emulators, box(), ties.get(name, ())) for name, emulators in learnt.items()]


def exact(model: Model) -> float:
    """The log evidence by the membranes themselves."""
    space, lift = reduced(model)
    density = multivariate_normal(TARGETS.mean, np.diag(TARGETS.sd**2))
    return evidence(lambda x: density.logpdf([respond(point)[0] for point in lift(x)]), space, 300).log_z


def doubted(emulators: Mapping[str, Features]) -> dict[str, Doubt]:
    return doubts(models(emulators), TARGETS, 150, 0)


def learnt(runs: Further, heard: list[str] | None = None) -> Mapping[str, Features]:
    first = dict.fromkeys((REGIONAL, GLOBAL), runs.features(OUTPUTS))
    return informed(lambda: runs, first, doubted, 0, lambda stage, done, total: (heard or []).append(stage)).emulators


def test_the_evidence_of_a_model_far_from_the_runs_becomes_that_of_the_simulator(tmp_path: Path) -> None:
    simulator = Membranes()
    runs = of_membranes(tmp_path, simulator)
    before = compare(models(runs.features(OUTPUTS)), TARGETS, 200)
    heard = ["-"]
    features = learnt(runs, heard)
    after = compare(models(features), TARGETS, 200)
    assert 0 < runs.made <= 16 and simulator.calls == 10 + runs.made
    assert f"runs where {GLOBAL} is likely" in heard
    asked = [exact(model) for model in models(features)]
    for fit, log_z in zip(after.fits, asked, strict=True):
        assert fit.emulator_se < 0.5
        assert fit.log_evidence == pytest.approx(log_z, abs=3 * math.hypot(fit.log_evidence_se, fit.emulator_se, 0.1))
    # and it was needed: by the calibration's runs alone it was several nats off, and said so
    assert abs(before.fits[1].log_evidence - asked[1]) > 3.0
    assert before.fits[1].emulator_se > 1.0 > before.fits[0].emulator_se
    assert before.contrasts[0].se > 1.0 > after.contrasts[0].se


def test_called_again_it_makes_no_run_and_ends_the_same(tmp_path: Path) -> None:
    first = Membranes()
    features = learnt(of_membranes(tmp_path, first))
    again = Membranes()
    runs = of_membranes(tmp_path, again)
    assert again.calls == 0
    same = learnt(runs)
    assert again.calls == 0 and runs.made == first.calls - 10
    x = box().uniform(5, np.random.default_rng(1))
    assert all((same[name].predict(x)[0] == features[name].predict(x)[0]).all() for name in (REGIONAL, GLOBAL))


def test_no_more_runs_than_allowed_and_none_where_nothing_is_in_doubt(tmp_path: Path) -> None:
    runs = of_membranes(tmp_path, Membranes(), most=3)
    learnt(runs)
    assert (runs.made, runs.left) == (3, 0)
    none = of_membranes(tmp_path, Membranes())

    def nothing(emulators: Mapping[str, Features]) -> dict[str, Doubt]:
        return {GLOBAL: Doubt(0.1, 0.1, 0.0, False, np.empty((0, 3)))}

    def never() -> Further:
        raise AssertionError("nothing is in doubt")

    found = informed(never, {GLOBAL: none.features(OUTPUTS)}, nothing, 0, lambda *_: None)
    assert (found.runs, found.words) == (0, "")


def test_failed_runs_are_gone_around(tmp_path: Path) -> None:
    """Half of the box fails, the likely half of one stiffness among it: it ends, and what is not known stays said."""
    simulator = Membranes(fail=lambda x: abs(x[0] - x[1]) < 0.3)
    runs = of_membranes(tmp_path, simulator)
    features = learnt(runs)
    assert runs.left == 0
    assert compare(models(features), TARGETS, 150).fits[1].emulator_se > 0.5


def test_models_that_share_emulators_share_their_errors(tmp_path: Path) -> None:
    """The same model twice: each hangs on the emulator, their difference does not."""
    features = of_membranes(tmp_path, Membranes()).features(OUTPUTS)
    one = models(features)[1]
    found = compare([one, replace(one, name="again")], TARGETS, 200)
    assert found.fits[0].emulator_se > 1.0
    assert found.contrasts[0].se < 0.5 * found.fits[0].emulator_se
    # in emulators of their own they err apart
    own = replace(one, name="own", emulators=of_membranes(tmp_path, Membranes()).features(OUTPUTS))
    apart = compare([one, own], TARGETS, 200)
    assert apart.contrasts[0].se > found.fits[0].emulator_se


def test_without_its_scene_no_run_is_made_and_it_is_said(tmp_path: Path) -> None:
    of_membranes(tmp_path, Membranes())
    words = further(tmp_path, box(), TARGETS, 8, tmp_path / "runs")
    assert isinstance(words, str) and "holds no simulated.toml: calibrate again" in words
    told = informed(lambda: words, {GLOBAL: of_membranes(tmp_path, Membranes()).features(OUTPUTS)}, in_doubt, 0, lambda *_: None)
    assert told.words.startswith("the log evidence of global (± 2) hangs on the emulators, and no run is added: ")


def in_doubt(emulators: Mapping[str, Features]) -> dict[str, Doubt]:
    del emulators
    return {GLOBAL: Doubt(2.0, 2.0, 0.0, False, np.empty((0, 3))), REGIONAL: Doubt(0.1, 0.1, 0.0, False, np.empty((0, 3)))}


def test_runs_are_added_by_the_scene_that_was_calibrated_and_no_other(freefem: FreeFem, tmp_path: Path) -> None:
    lacli.synthesize(tmp_path / "la", cell_size_mm=14.0, order=1)
    document = {"anatomy": {"bundle": "la"}, "numerics": {"order": 1}, "loads": {"edp_mmhg": 3.0, "esp_mmhg": 8.0}}
    scene = asked(build_scene(document, [], folder=tmp_path, where="test"), ("esv_ml", "d_global_mm"))
    space = make_box(("alpha_roof", "alpha_septum"), [0.8, 0.8], [3.0, 3.0])
    goal = Targets(("esv_ml", "d_global_mm"), np.array([100.0, 3.0]), np.array([4.0, 0.5]))
    place = tmp_path / "patient"
    place.mkdir()
    simulator = SceneSimulator(scene, place / "runs", workers=1)
    log = RunLog(place / LOG, space.names, goal.names, runs_identity(simulator, space.names, goal.names))
    log.run(simulator, space.from_unit(np.array([[0.2, 0.3], [0.6, 0.4], [0.4, 0.8], [0.7, 0.7]])))
    (place / SIMULATED).write_text(dump_scene(scene))
    before = (place / LOG).read_bytes()
    runs = further(place, space, goal, 2, place / "runs", workers=1)
    assert isinstance(runs, Further) and runs.cheap is None and len(runs.own.x) == 4
    features = runs.features(goal.names)
    doubt = Doubt(1.0, 1.0, 0.0, False, space.from_unit(0.9 + 0.05 * np.random.default_rng(0).random((50, 2))))
    told: list[tuple[int, int]] = []
    runs.add(features, doubt, np.random.default_rng(0), lambda done, total: told.append((done, total)))
    assert (runs.made, runs.left, len(runs.own.x)) == (2, 0, 6) and told[-1] == (2, 2)
    assert (place / LOG).read_bytes() == before, "what was calibrated stays as it was"
    # the emulator knows the new runs
    x = runs.own.x[-1:]
    told_there = runs.own.log.frame(x)[list(goal.names)].to_numpy(float)
    assert runs.features(goal.names).predict(x)[0] == pytest.approx(told_there, rel=1e-3)
    # with other cells, or another scene, it would be another model
    (place / SIMULATED).write_text(dump_scene(scene).replace("edp_mmhg = 3.0", "edp_mmhg = 4.0"))
    words = further(place, space, goal, 2, place / "runs")
    assert isinstance(words, str) and "edp_mmhg" in words
    (place / SIMULATED).write_text("[anatomy]\nbundle = 3\n")
    words = further(place, space, goal, 2, place / "runs")
    assert isinstance(words, str) and SIMULATED in words


class Snapping(Membranes):
    """Features of an early frame and of end-systole; the early frame jumps by many standard deviations where all is soft, to
    one side or the other as the inputs' last digits say."""

    def __call__(self, inputs: pd.DataFrame) -> Iterator[tuple[int, Outcome]]:
        for index, outcome in super().__call__(inputs):
            row = inputs[list(INPUTS)].to_numpy(float)[index]
            jump = 4.0 * (math.sin(1e6 * row[0]) > 0) if abs(row[0] - row[1]) < 0.3 else 0.0
            told = {
                FRAMED[name]: value + (jump if FRAMED[name].endswith("@0.1") else 0.0) for name, value in outcome.outputs.items()
            }
            slopes = {(FRAMED[name], given): value for (name, given), value in outcome.gradients.items()}
            yield index, replace(outcome, outputs=told, gradients=slopes)


FRAMED = {name: f"n_roof_mm@0.{1 + j}" if j < 3 else f"f{j}" for j, name in enumerate(OUTPUTS)}


def test_an_early_frame_that_jumps_is_left_out_for_all_models_with_a_word(tmp_path: Path) -> None:
    names, simulator = tuple(FRAMED.values()), Snapping()
    goal = Targets(names, respond(TRUTH)[0], np.full(len(names), 0.15))
    log = RunLog(tmp_path / COMPARED, INPUTS, names, runs_identity(simulator, INPUTS, names))
    x = TRUTH * np.exp(0.05 * np.random.default_rng(0).standard_normal((10, 3)))
    log.run(simulator, x)
    runs = Further(Kind(simulator, log, x, len(x)), None, box(), goal, 16)
    first = runs.features(names)
    found = informed(
        lambda: runs, dict.fromkeys((REGIONAL, GLOBAL), first), lambda of: doubts(models(of), goal, 150, 0), 0, lambda *_: None
    )  # fmt: skip
    assert "targets of the frames at 0.1 are held against no model: where global is likely" in found.words
    kept = tuple(name for name in names if not name.endswith("@0.1"))
    assert all(features.outputs == kept for features in found.emulators.values())
    # the regional one is learnt from the calibration's runs alone, the global one from all
    of_regional, of_global = (len(found.emulators[name].training_inputs()) for name in (REGIONAL, GLOBAL))
    assert of_regional == 10 and of_global > 20
    told = compare(models(found.emulators), goal, 200)
    assert max(fit.emulator_se for fit in told.fits) < 1.0 and told.contrasts[0].difference > 10.0


def test_the_last_frame_stays(tmp_path: Path) -> None:
    runs = of_membranes(tmp_path, Membranes())
    assert runs.leave_out_a_frame() is None, "of targets without a time"
    for names, left in (
        (("d_roof_mm", "d_roof_mm@0.2", "d_roof_mm@0.1"), [0.1, 0.2, None]),
        (("esv_ml@0.3", "d_roof_mm@0.3"), [None]),
    ):
        runs.targets = Targets(names, np.ones(len(names)), np.ones(len(names)))
        assert [runs.leave_out_a_frame() for _ in left] == left
        assert runs.targets.names


def test_frames_are_not_left_out_in_vain(tmp_path: Path) -> None:
    """Where end-systole is as vague as the frames, all of them stay, and how vague it is is said."""
    names = ("d_roof_mm@0.1", "d_septum_mm@0.1", "d_roof_mm", "d_septum_mm")
    of = dict(zip(OUTPUTS, names, strict=False))

    class Two(Membranes):
        def __call__(self, inputs: pd.DataFrame) -> Iterator[tuple[int, Outcome]]:
            for index, one in super().__call__(inputs):
                slopes = {(of[name], given): value for (name, given), value in one.gradients.items() if name in of}
                yield index, replace(one, outputs={of[k]: one.outputs[k] for k in of}, gradients=slopes)

    log = RunLog(tmp_path / COMPARED, INPUTS, names, runs_identity(Two(), INPUTS, names))
    x = TRUTH * np.exp(0.05 * np.random.default_rng(0).standard_normal((10, 3)))
    log.run(Two(), x)
    goal = Targets(names, np.ones(4), np.ones(4))
    runs = Further(Kind(Two(), log, x, len(x)), None, box(), goal, 0)
    first = dict.fromkeys((REGIONAL, GLOBAL), runs.features(names))
    looked: list[int] = []

    def vague(emulators: Mapping[str, Features]) -> dict[str, Doubt]:
        looked.append(len(next(iter(emulators.values())).outputs))
        return {name: Doubt(9.0 if name == GLOBAL else 0.1, 9.0, 0.0, False, x) for name in emulators}

    assert informed(lambda: runs, first, vague, 0, lambda *_: None).words == "", "where no run was allowed nothing is left out"
    runs.made, looked[:] = 4, []
    found = informed(lambda: runs, first, vague, 0, lambda *_: None)
    assert looked == [4, 2], "without the early frame it was tried"
    assert found.emulators == first
    assert found.words == "the log evidence of global to ± 9 alone is known: no emulator follows the runs there."
