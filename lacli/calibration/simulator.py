"""A scene as a simulator of tables: a row of inputs, a FreeFEM run, its features."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pandas as pd

    from lacli.inference.runs import Outcome, Simulator


def simulator(
    scene_file: Path, root: Path, workers: int | None = None, scheduler: str | None = None, overrides: list[str] | None = None
) -> Simulator:
    """A simulator that runs the scene at each row of inputs, side by side; stored runs are found again by content.

    Neither fields nor the unloaded state are computed (a calibration makes hundreds of runs and reads their features).
    """
    from lacli.contracts.scene import load_scene, with_parameters
    from lacli.inference.runs import Outcome
    from lacli.mechanics.execute import run_scenes

    scene = load_scene(scene_file, [*(overrides or []), "outputs.fields=none", "outputs.unloaded=false"])

    def run(inputs: pd.DataFrame) -> Iterator[tuple[int, Outcome]]:
        scenes = [with_parameters(scene, {str(k): float(v) for k, v in row.items()}) for row in inputs.to_dict("records")]
        for index, result in run_scenes(scenes, root, workers=workers, scheduler=scheduler):
            yield index, _outcome(result)

    def _outcome(result) -> Outcome:  # type: ignore[no-untyped-def]
        errors = result.features.get("discretisation_error")
        outputs = {k: float(v) for k, v in result.features.items() if isinstance(v, (int, float)) and not isinstance(v, bool)}
        if result.status != "done":
            outputs = {}
        return Outcome(
            outputs,
            "done" if result.status == "done" else "failed",
            result.kind or "",
            {k: float(v) for k, v in errors.items()} if isinstance(errors, dict) else {},
            float(outputs.get("cpu_s", float("nan"))),
        )

    return run
