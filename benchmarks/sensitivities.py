"""A run's sensitivities against central differences of whole runs, and what they cost of a run. Synthetic atrium.

    python benchmarks/sensitivities.py [--cell-size-mm 6] [--order 1] [--seed 1] [--frames 0] [--points soft medium stiff]
        [--out DIR] [--json]

All inputs of the study at each point, all features. Runs that are differenced converge to 1e-9 mm; the step is .2 % of the
input's value, .02 % of PTH's (its smoothstep is only once differentiable, and the second derivative's jumps are seen). The
error is the largest of a column over the column's largest entry. Cost: FreeFEM's CPU seconds and Python's for the chain rule,
of runs with and without, one after the other, as shares of the run without.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from prepared import prepared

from lacli.cli.terminal.console import print_json, print_table
from lacli.contracts.case import Case
from lacli.contracts.parameters import parameter_box
from lacli.contracts.scene import Scene, build_scene, with_parameters
from lacli.mechanics import deck, plan, results, sensitivities
from lacli.mechanics.execute import run_scenes
from lacli.mechanics.simulation import RunResult

ASKED_ERROR = 1e-4
ASKED_COST, ASKED_COST_FRAMES = 0.08, 0.25  # of a run: at end-systole alone, in frames too
TOLERANCE_MM = 1e-9
STEP, STEP_PTH = 2e-3, 2e-4

_REGIONAL = ("anterior", "posterior", "septum", "lateral", "roof")
POINTS: dict[str, dict[str, float]] = {
    "soft": {
        **{f"c_{name}_kpa": value for name, value in zip(_REGIONAL, (1.5, 1.2, 1.8, 1.3, 1.6), strict=True)},
        **{f"alpha_{name}": value for name, value in zip(_REGIONAL, (0.7, 0.5, 0.6, 0.8, 0.6), strict=True)},
        **{"edp_mmhg": 5.0, "esp_mmhg": 16.0, "k_peri_kpa_per_um": 0.0008, "pth": 0.7},
    },
    "medium": {
        **{f"c_{name}_kpa": value for name, value in zip(_REGIONAL, (1.7, 2.0, 1.5, 1.9, 1.6), strict=True)},
        **{f"alpha_{name}": value for name, value in zip(_REGIONAL, (1.5, 1.2, 1.8, 2.0, 1.4), strict=True)},
        **{"edp_mmhg": 7.0, "esp_mmhg": 20.0, "k_peri_kpa_per_um": 0.001, "pth": 0.75},
    },
    "stiff": {
        **{f"c_{name}_kpa": value for name, value in zip(_REGIONAL, (4.0, 3.0, 5.0, 3.5, 4.5), strict=True)},
        **{f"alpha_{name}": value for name, value in zip(_REGIONAL, (3.0, 3.6, 2.8, 3.2, 3.4), strict=True)},
        **{"edp_mmhg": 8.0, "esp_mmhg": 26.0, "k_peri_kpa_per_um": 0.002, "pth": 0.65},
    },
}


def measured(result: RunResult, names: list[str]) -> np.ndarray:
    """Features of a run by the names of its sensitivities' rows."""
    if result.status != "done":
        raise SystemExit(f"a run that is to be differenced ended badly: {result.kind}, {result.message}")
    frames = pd.read_csv(result.folder / "transients.csv").set_index("time")
    values = []
    for name in names:
        key, at, when = name.partition("@")
        if at:
            here = int(np.argmin(np.abs(frames.index.to_numpy() - float(when))))
            values.append(float(frames.iloc[here][key]))
        else:
            values.append(float(result.features[key]))
    return np.array(values)


def _asking(scene: Scene, asked: bool) -> Scene:
    return scene.model_copy(update={"outputs": scene.outputs.model_copy(update={"sensitivities": asked})})


def accuracy(scene: Scene, root: Path, name: str) -> list[dict[str, Any]]:
    """One row for each input at a point: the largest error over the column's largest entry."""
    inputs = list(parameter_box())
    steps = {key: POINTS[name][key] * (STEP_PTH if key == "pth" else STEP) for key in inputs}
    scenes = [with_parameters(scene, POINTS[name])]
    plain = _asking(scene, False)
    for key in inputs:
        for sign in (1, -1):
            moved = POINTS[name] | {key: POINTS[name][key] + sign * steps[key]}
            scenes.append(with_parameters(plain, moved))
    found = dict(run_scenes(scenes, root))
    table = sensitivities.load_sensitivities(found[0].folder)
    if table is None:
        raise SystemExit(f"the run at {name} has no sensitivities: {found[0].features.get('sensitivities')}, {found[0].message}")
    rows = []
    for i, key in enumerate(inputs):
        ahead, behind = (measured(found[1 + 2 * i + k], list(table.index)) for k in (0, 1))
        difference = (ahead - behind) / (2 * steps[key])
        error = np.abs(table[key].to_numpy() - difference)
        worst = int(np.argmax(error))
        rows.append(
            {
                "point": name,
                "input": key,
                "error": float(error.max() / np.abs(difference).max()),
                "at": table.index[worst],
                "asked": ASKED_ERROR,
                "largest": float(np.abs(difference).max()),
            }
        )
    return rows


def cost(scene: Scene, folder: Path, repeats: int = 5) -> dict[str, Any]:
    """CPU seconds of a run without and with sensitivities and of Python's part; medians over interleaved repeats."""
    spent: dict[bool, list[float]] = {False: [], True: []}
    chain = []
    for repeat in range(repeats):
        for asked in (False, True):
            case = plan.prepare(_asking(scene, asked))
            place = folder / f"{repeat}_{asked}"
            place.mkdir()
            outcome = deck.run(deck.write(case, place))
            spent[asked].append(outcome.cpu_s)
            if asked:
                chain.append(_chain(case, place))
    without, with_ = (statistics.median(spent[asked]) for asked in (False, True))
    python = statistics.median(chain)
    asked_share = ASKED_COST if scene.outputs.frames < 2 else ASKED_COST_FRAMES
    extra = statistics.median(b - a for a, b in zip(spent[False], spent[True], strict=True)) + python
    return {"without_s": without, "with_s": with_, "python_s": python, "share": extra / without, "asked": asked_share}


def _chain(case: Case, place: Path) -> float:
    found = results.read(case, place)
    start = time.process_time()
    sensitivities.write(case, found, place)
    return time.process_time() - start


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cell-size-mm", type=float, default=6.0)
    parser.add_argument("--order", type=int, default=1, choices=(1, 2))
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--frames", type=int, default=0)
    parser.add_argument("--points", nargs="*", default=list(POINTS), choices=list(POINTS), help="none: the cost alone")
    parser.add_argument("--repeats", type=int, default=5, help="of the cost's runs; 0: no cost")
    parser.add_argument("--out", type=Path, help="where runs are kept (and found again); else they are thrown away")
    parser.add_argument("--json", action="store_true")
    choice = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="lacli-sensitivities-") as temporary:
        out = (choice.out or Path(temporary)).resolve()
        folder = prepared(out, choice.seed, choice.cell_size_mm)
        settings = [
            f"numerics.order={choice.order}",
            f"outputs.frames={choice.frames}",
            *("outputs.fields=none", "outputs.unloaded=false", "outputs.sensitivities=true", "numerics.engine=plugin"),
        ]
        scene = build_scene({"anatomy": {"bundle": str(folder)}}, settings, folder=folder, where="sensitivities")
        tight = scene.model_copy(update={"numerics": scene.numerics.model_copy(update={"tolerance_mm": TOLERANCE_MM})})
        rows = [row for name in choice.points for row in accuracy(tight, out / "runs", name)]
        price = {}
        if choice.repeats:
            timed = Path(temporary) / "timed"
            timed.mkdir()
            price = cost(with_parameters(scene, POINTS["medium"]), timed, choice.repeats)
    if choice.json:
        print_json({"rows": rows, "cost": price})
    else:
        columns = list(rows[0]) if rows else []
        print_table(f"asked: errors within {ASKED_ERROR:g}", columns, [[row[name] for name in columns] for row in rows])
        print_table("cost of a run", list(price), [list(price.values())])
    if any(row["error"] > ASKED_ERROR for row in rows) or price.get("share", 0.0) > price.get("asked", 1.0):
        raise SystemExit(1)


if __name__ == "__main__":
    main()
