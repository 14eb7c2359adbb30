"""A scene as a simulator of tables: a row of inputs, a FreeFEM run, its features."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lacli.base.errors import UsageError
from lacli.base.notes import note
from lacli.contracts.features import KEYS, at_time, parse
from lacli.contracts.motion import FILE as MOTION
from lacli.contracts.parameters import QUANTITIES
from lacli.contracts.scene import Scene, with_parameters
from lacli.contracts.targets import SAME_ES, Targets
from lacli.motion.annulus import end_systole

if TYPE_CHECKING:
    import pandas as pd

    from lacli.inference.runs import Outcome
    from lacli.mechanics.simulation import RunResult


PRESSURES = ("edp_mmhg", "esp_mmhg")


@dataclass(frozen=True)
class SceneSimulator:
    """Runs the scene at each row of inputs, side by side; stored runs are found again by content.

    Its discretisation errors are those measured for the scene itself: they stand for the box around it. warm: runs start from
    the nearest that has ended; they are the same runs to the solver's tolerance. discretisation: whether runs tell those errors.
    """

    scene: Scene
    root: Path
    workers: int | None = None
    scheduler: str | None = None
    warm: bool = False
    discretisation: bool = True

    def __call__(self, inputs: pd.DataFrame) -> Iterator[tuple[int, Outcome]]:
        from lacli.mechanics.execute import run_scenes
        from lacli.mechanics.simulation import run_scene

        task = functools.partial(run_scene, warm=True) if self.warm else None
        errors = self._errors()
        scenes = [with_parameters(self.scene, {str(k): float(v) for k, v in row.items()}) for row in inputs.to_dict("records")]
        for index, result in run_scenes(scenes, self.root, workers=self.workers, scheduler=self.scheduler, task=task):
            yield index, _outcome(result, errors, framed=bool(self.scene.outputs.times))

    def determined_by(self, inputs: Sequence[str]) -> Mapping[str, Any]:
        """The scene but for what the inputs set, the bundle's content, FreeFEM's scripts and version, the errors of a run.

        The engine does not count: both give the same numbers (``benchmarks/engines.py``). Raises UsageError for an input that
        counts nothing in this scene.
        """
        from lacli.contracts.identity import determinants, flatten

        if self.scene.loads.transient_mmhg is not None and (idle := [name for name in PRESSURES if name in inputs]):
            raise UsageError(
                f"{', '.join(idle)} can be no input: loads.transient_mmhg is the pressure at all times. Leave it out of the box, "
                "or loads.transient_mmhg out of the scene."
            )
        given = [QUANTITIES[name].key for name in inputs if name in QUANTITIES]
        kept = {key: value for key, value in flatten(determinants(self.scene)).items() if key not in given}
        return {**kept, "freefem": _solver(), "discretisation_error": self._errors()}

    def _errors(self) -> dict[str, float]:
        from lacli.mechanics.numerics.accuracy import known_errors

        return known_errors(self.scene) if self.discretisation else {}


def _solver() -> str:
    from lacli.base.errors import SolverMissingError
    from lacli.freefem.program import find

    try:
        return find().version
    except SolverMissingError:
        return "not installed"


def simulator(
    scene: Scene,
    root: Path,
    workers: int | None = None,
    scheduler: str | None = None,
    *,
    targets: Sequence[str] = (),
    sensitivities: bool = True,
    warm: bool = False,
    discretisation: bool = True,
) -> SceneSimulator:
    """The simulator of a scene. Raises StorageError where nothing can be written to ``root``.

    targets: names of outputs that will be held against it; those at times of the cycle (``n_septum_mm@0.2``) make its frames.
    sensitivities: whether runs tell their derivatives (where the scene can: the compiled engine, prestrain). Neither fields nor
    the unloaded state are computed (a calibration makes hundreds of runs and reads their features). warm: whether runs start
    from those that have ended; a note says where none can. discretisation: whether they tell the errors that were measured for
    the scene (no, where what they are held against has the same).
    """
    from lacli.base.files import check_folder
    from lacli.mechanics.warm import lacking

    check_folder(root, "--store")
    chosen = asked(scene, targets, sensitivities)
    if warm and (words := lacking(chosen)):
        note(f"all runs start cold: {words}.")
    return SceneSimulator(chosen, root, workers, scheduler, warm, discretisation)


def asked(scene: Scene, targets: Sequence[str], sensitivities: bool = True) -> Scene:
    """The scene with the outputs that a calibration to these targets reads, and no others."""
    chosen: dict[str, Any] = {"fields": "none", "unloaded": False, "sensitivities": sensitivities}
    if times := times_of(targets):
        chosen |= {"times": times, "conduit": False}  # times name all frames
    return scene.model_copy(update={"outputs": scene.outputs.model_copy(update=chosen)})


def times_of(names: Sequence[str]) -> tuple[float, ...]:
    """The times of the cycle that the names of features bear, rising."""
    found = set()
    for name in names:
        try:
            _, time = parse(name)
        except ValueError:  # of no feature: the run has it or lacks it
            continue
        if time:
            found.add(time)
    return tuple(sorted(found))


def check_end_systole(scene: Scene, targets: Targets) -> None:
    """UsageError where targets at times of the cycle are of another end-systole than the scene's: a frame's load hangs on it.

    Targets at end-systole alone have the load of end-systole, whenever it is.
    """
    if targets.es_time is None or not times_of(targets.names):
        return
    own = end_systole(scene.motion, scene.anatomy.bundle)
    if abs(own - targets.es_time) <= SAME_ES:
        return
    of_scene, remedy = f"the scene's (motion.es_time) at {own:.3g}", f"Set motion.es_time={targets.es_time:.3g}"
    if scene.motion.annulus == "bundle":
        of_scene = f"that of {scene.anatomy.bundle}/{MOTION}, which the scene takes, at {own:.3g}"
        remedy = f"Track again with --update-bundle, or set motion.annulus=none and motion.es_time={targets.es_time:.3g}"
    elif scene.motion.annulus == "axial":
        remedy += ", and motion.frames so that it is one of them"
    raise UsageError(
        f"the targets' end-systole (es_time in their file) is at {targets.es_time:.3g} of the cycle, {of_scene}: frames would be "
        f"simulated at other pressures than they were imaged at. {remedy}."
    )


def of_known_loads(scene: Scene, targets: Targets) -> tuple[Targets, list[str]]:
    """The targets whose load the scene knows, and what is to be told of the others.

    Up to end-systole the pressure rises between the two that are inputs; how it falls after it no input says, and the motion
    follows it: an idealised fall would be taken for stiffness. A scene with its own transient knows it. Raises UsageError where
    nothing is left.
    """
    if scene.loads.transient_mmhg is not None or not times_of(targets.names):
        return targets, []
    own = end_systole(scene.motion, scene.anatomy.bundle)
    late = [name for name in targets.names if any(time > own + SAME_ES for time in times_of([name]))]
    if not late:
        return targets, []
    if len(late) == len(targets.names):
        raise UsageError(
            f"all targets are of frames after end-systole ({own:.3g} of the cycle), where the pressure is not known. Give some "
            "up to it, or the pressure over the cycle as loads.transient_mmhg."
        )
    times = times_of(late)
    return targets.select([name for name in targets.names if name not in late]), [
        f"{len(late)} targets of {len(times)} frames after end-systole are not calibrated to: how the pressure falls there is "
        "not known, and would be taken for stiffness. They are there to be foretold; with loads.transient_mmhg they count."
    ]


def _outcome(result: RunResult, errors: dict[str, float], framed: bool) -> Outcome:
    from lacli.inference.runs import Outcome
    from lacli.mechanics.numerics.equilibria import SPREAD
    from lacli.mechanics.results import features_at_times
    from lacli.mechanics.sensitivities import load_sensitivities

    features = result.features if result.status == "done" else {}
    outputs = {k: float(v) for k, v in features.items() if isinstance(v, (int, float)) and not isinstance(v, bool)}
    gradients: dict[tuple[str, str], float] = {}
    es, spread = None, dict(features.get(SPREAD) or {})
    if features:
        if framed:
            of_frames, es = features_at_times(result.folder)
            outputs |= of_frames
        if (table := load_sensitivities(result.folder)) is not None:
            gradients = {
                (name, str(given)): float(value)
                for row, cells in zip(table.index.astype(str), table.to_dict("records"), strict=True)
                for name in (row, *_also(row, es))
                for given, value in cells.items()
            }
    spread |= {also: value for name, value in spread.items() for also in _also(name, es)}
    if outputs:
        # either of two states, one as likely as the other: half their distance is the standard deviation
        errors = errors | {name: math.hypot(errors.get(name, 0.0), 0.5 * value) for name, value in spread.items()}
    return Outcome(
        outputs,
        "done" if result.status == "done" else "failed",
        result.kind or "",
        errors if outputs else {},
        float(outputs.get("cpu_s", float("nan"))),
        result.message if result.status != "done" else "",
        float(result.manifest.get("peak_memory_mb") or float("nan")),
        int(result.manifest.get("attempts") or 1),
        gradients,
        spread,
    )


def _also(name: str, es: float | None) -> list[str]:
    """The name at its time, of a feature at end-systole, where that is known."""
    key = {"esv_ml": "volume_ml"}.get(name, name)
    return [at_time(key, es)] if es is not None and "@" not in name and key in KEYS and key != "edv_ml" else []
