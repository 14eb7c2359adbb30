"""What identity costs: what `simulate` and a resumed table of 1,000 runs spend on telling whether what is kept is the same.

python benchmarks/identity.py [--json]      (seconds of wall time; no simulation is run)

Asked: at most 0.1 s of `simulate`, at most 2 s of resuming 1,000 rows.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from lacli.calibration.simulator import SceneSimulator
from lacli.cli.terminal.console import print_json, print_table
from lacli.contracts import identity
from lacli.contracts.bundle import save
from lacli.contracts.scene import Scene, build_scene
from lacli.inference.box import CALIBRATION_INPUTS, OUTPUTS, published_box
from lacli.inference.design import design
from lacli.inference.runs import Outcome, RunLog, runs_identity
from lacli.mechanics.numerics.accuracy import known_errors, record
from lacli.mechanics.store import check_products, find_run, open_run
from lacli.synthetic.atrium import synthesize

SIMULATE_S, RESUME_S, ROWS = 0.1, 2.0, 1000
FIELD_BYTES = 1_500_000  # of a field of a 4 mm atrium with 10-node cells, compressed


class Known(SceneSimulator):
    """The scene's simulator, without simulations."""

    def __call__(self, inputs: pd.DataFrame) -> Iterator[tuple[int, Outcome]]:
        for index in range(len(inputs)):
            yield index, Outcome(dict.fromkeys((*OUTPUTS, "edv_ml"), 80.0))

    def determined_by(self, inputs: Sequence[str]) -> Mapping[str, Any]:
        return super().determined_by(inputs)


def timed(work: Callable[[], object]) -> float:
    begin = time.perf_counter()
    work()
    return time.perf_counter() - begin


def forget() -> None:
    """Digests as a new process finds them: of nothing yet."""
    identity._digest.cache_clear()
    identity.solver_digest.cache_clear()


def stored(scene: Scene, root: Path, fields: bool) -> None:
    with open_run(root, identity.run_key(scene)) as run:
        (run.folder / "features.json").write_text('{"edv_ml": 80.5}' + " " * 1000)
        (run.folder / "transients.csv").write_text("time,volume_ml\n" * 100)
        if fields:
            (run.folder / "fields").mkdir()
            for name in ("ed", "es", "unloaded"):
                (run.folder / "fields" / f"{name}.vtu").write_bytes(np.random.default_rng(0).bytes(FIELD_BYTES))
        run.finish()


def of_simulate(scene: Scene, root: Path) -> dict[str, float]:
    """What one call spends: the key, the digests of its products, finding it, its errors, what its pictures are drawn from."""
    forget()
    record(scene, dict.fromkeys(OUTPUTS, 0.1), scene)
    forget()
    parts = {"key of the scene": timed(lambda: identity.run_key(scene))}
    stored(scene, root, fields=True)
    run = find_run(root, identity.run_key(scene))
    assert run is not None
    products = list(run.manifest["products"])
    parts["digests of the products"] = timed(lambda: [identity.file_digest(run.folder / name) for name in products])
    parts["finding the run"] = timed(lambda: find_run(root, run.key))
    parts["discretisation errors"] = timed(lambda: known_errors(scene))
    parts["products before they are drawn"] = timed(lambda: check_products(run, products))
    return parts


def of_resuming(scene: Scene, folder: Path) -> dict[str, float]:
    """A table whose 1,000 rows are finished, and 1,000 stored runs found by their keys."""
    box = published_box(CALIBRATION_INPUTS)
    outputs = (*OUTPUTS, "edv_ml")
    x = design(box, ROWS, "sobol", 0)
    simulator = Known(scene, folder / "runs")
    log = RunLog(folder / "runs.csv", box.names, outputs, runs_identity(simulator, box.names, outputs))
    frame = pd.DataFrame(x, columns=list(box.names))
    for index, outcome in simulator(frame):
        log._note(tuple(x[index].tolist()), outcome)
    log.save()
    forget()

    def resume() -> None:
        again = RunLog(folder / "runs.csv", box.names, outputs, runs_identity(simulator, box.names, outputs))
        again.run(simulator, x)

    parts = {f"{ROWS} rows of a table": timed(resume)}
    scenes = [scene.model_copy(update={"loads": scene.loads.model_copy(update={"esp_mmhg": 20 + i / ROWS})}) for i in range(ROWS)]
    for one in scenes:
        stored(one, folder / "runs", fields=False)
    parts[f"{ROWS} stored runs"] = timed(lambda: [find_run(folder / "runs", identity.run_key(one)) for one in scenes])
    return parts


def main() -> int:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        bundle, _ = synthesize(1, cell_size_mm=4.0)
        save(bundle, folder / "la")
        scene = build_scene({"anatomy": {"bundle": "la"}}, [], folder=folder, where="benchmark")
        measured = [
            ("simulate", SIMULATE_S, of_simulate(scene, folder / "one")),
            ("resume", RESUME_S, of_resuming(scene, folder)),
        ]
    if "--json" in sys.argv:
        print_json(
            {what: {"asked_s": asked, "measured_s": sum(parts.values()), "parts": parts} for what, asked, parts in measured}
        )
    else:
        rows: list[list[Any]] = []
        for what, asked, parts in measured:
            rows += [[f"  {part}", "", seconds, ""] for part, seconds in parts.items()]
            total = sum(parts.values())
            rows.append([what, asked, total, "yes" if total <= asked else "NO"])
        print_table("What identity costs", ["", "asked (s)", "measured (s)", "held"], rows)
    return int(any(sum(parts.values()) > asked for _, asked, parts in measured))


if __name__ == "__main__":
    sys.exit(main())
