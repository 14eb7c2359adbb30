"""A scene as a simulator of tables: a row of inputs, a FreeFEM run, its features."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lacli.contracts.parameters import QUANTITIES
from lacli.contracts.scene import Scene, with_parameters

if TYPE_CHECKING:
    import pandas as pd

    from lacli.inference.runs import Outcome
    from lacli.mechanics.simulation import RunResult


@dataclass(frozen=True)
class SceneSimulator:
    """Runs the scene at each row of inputs, side by side; stored runs are found again by content.

    Its discretisation errors are those measured for the scene itself: they stand for the box around it.
    """

    scene: Scene
    root: Path
    workers: int | None = None
    scheduler: str | None = None

    def __call__(self, inputs: pd.DataFrame) -> Iterator[tuple[int, Outcome]]:
        from lacli.mechanics.execute import run_scenes

        errors = self._errors()
        scenes = [with_parameters(self.scene, {str(k): float(v) for k, v in row.items()}) for row in inputs.to_dict("records")]
        for index, result in run_scenes(scenes, self.root, workers=self.workers, scheduler=self.scheduler):
            yield index, _outcome(result, errors)

    def determined_by(self, inputs: Sequence[str]) -> Mapping[str, Any]:
        """The scene but for what the inputs set, the bundle's content, FreeFEM's scripts and version, the errors of a run.

        The engine does not count: both give the same numbers (``benchmarks/engines.py``).
        """
        from lacli.contracts.identity import determinants, flatten

        given = [QUANTITIES[name].key for name in inputs if name in QUANTITIES]
        kept = {key: value for key, value in flatten(determinants(self.scene)).items() if key not in given}
        return {**kept, "freefem": _solver(), "discretisation_error": self._errors()}

    def _errors(self) -> dict[str, float]:
        from lacli.mechanics.accuracy import known_errors

        return known_errors(self.scene)


def _solver() -> str:
    from lacli.base.errors import SolverMissingError
    from lacli.freefem.program import find

    try:
        return find().version
    except SolverMissingError:
        return "not installed"


def simulator(scene: Scene, root: Path, workers: int | None = None, scheduler: str | None = None) -> SceneSimulator:
    """The simulator of a scene. Raises StorageError where nothing can be written to ``root``.

    Neither fields nor the unloaded state are computed (a calibration makes hundreds of runs and reads their features).
    """
    from lacli.base.files import check_folder

    check_folder(root, "--store")
    outputs = scene.outputs.model_copy(update={"fields": "none", "unloaded": False})
    return SceneSimulator(scene.model_copy(update={"outputs": outputs}), root, workers, scheduler)


def _outcome(result: RunResult, errors: dict[str, float]) -> Outcome:
    from lacli.inference.runs import Outcome

    features = result.features if result.status == "done" else {}
    outputs = {k: float(v) for k, v in features.items() if isinstance(v, (int, float)) and not isinstance(v, bool)}
    return Outcome(
        outputs,
        "done" if result.status == "done" else "failed",
        result.kind or "",
        errors if outputs else {},
        float(outputs.get("cpu_s", float("nan"))),
        result.message if result.status != "done" else "",
        float(result.manifest.get("peak_memory_mb") or float("nan")),
        int(result.manifest.get("attempts") or 1),
    )
