"""Emulators that learn from gradients: on real runs of the whole box, against plain ones; their cost at the largest scale.

    python benchmarks/emulation_gradients.py [--cell-size-mm 6] [--train 60] [--test 60] [--out DIR] [--scale] [--json]

Runs: nine inputs of the published box, synthetic atrium, linear cells, a Sobol' sequence to learn from and independent uniform
points to test on; the seven published outputs. Calm runs, whose walls have not snapped on the way (at most 34 Newton iterations,
no unstable mode at end-diastole), are scored apart; "within": share of the runs within two standard deviations. --scale: a
function of 15 inputs and 150 outputs on 300 runs: time, memory.
With --out, tables of runs that are there are used again.
"""

from __future__ import annotations

import argparse
import resource
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import qmc

from lacli.base.arrays import FloatArray
from lacli.cli.terminal.console import print_json, print_table
from lacli.contracts import bundle as bundles
from lacli.contracts.motion import save_motion
from lacli.contracts.scene import build_scene, with_parameters
from lacli.contracts.tables.gradients import name_of
from lacli.contracts.tables.table import RunTable, combine
from lacli.inference.box import OUTPUTS, published_box
from lacli.inference.emulation.emulator import fit_emulators
from lacli.inference.emulation.emulator_set import EmulatorSet
from lacli.inference.emulation.gradient_gp import fit_gradient_emulators
from lacli.mechanics import sensitivities
from lacli.mechanics.execute import run_scenes
from lacli.synthetic.atrium import synthesize

ASKED_R2, ASKED_S, ASKED_MB = 0.985, 60.0, 2000.0
_CALM = 34


def simulate(points: FloatArray, cell_size_mm: float, out: Path) -> pd.DataFrame:
    """A table of runs at the points, their derivatives beside their outputs."""
    names = published_box().names
    folder = out / f"bundle_{cell_size_mm:g}"
    if not folder.is_dir():
        bundle, motion = synthesize(1, None, cell_size_mm=cell_size_mm)
        bundles.save(bundle, folder)
        save_motion(motion, folder)
    settings = ["numerics.order=1", "outputs.frames=0", "outputs.fields=none", "outputs.unloaded=false"]
    settings += ["outputs.sensitivities=true", "numerics.engine=plugin"]
    scene = build_scene({"anatomy": {"bundle": str(folder)}}, settings, folder=folder, where="emulation")
    inputs = [dict(zip(names, row.tolist(), strict=True)) for row in points]
    rows: dict[int, dict[str, Any]] = {}
    for i, result in run_scenes([with_parameters(scene, row) for row in inputs], out / "runs", workers=2):
        rows[i] = inputs[i] | {"status": result.status}
        if result.status != "done":
            continue
        rows[i] |= {name: result.features[name] for name in OUTPUTS} | {"newton": result.features["newton_iterations"]}
        said = result.features.get("sensitivities") or {}
        rows[i]["ed_modes"] = said.get("ed_unstable_modes", 0)
        rates = sensitivities.load_sensitivities(result.folder)
        if rates is not None and OUTPUTS[0] in rates.index:
            rows[i] |= {name_of(output, key): float(rates.loc[output, key]) for output in OUTPUTS for key in names}
    return pd.DataFrame([rows[i] for i in sorted(rows)])


def tables(choice: argparse.Namespace, out: Path) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Runs to learn from and to test on, read where they are."""
    box = published_box()
    points = {
        "train": box.from_unit(qmc.Sobol(box.d, rng=np.random.default_rng(1)).random(1 << (choice.train - 1).bit_length())),
        "test": box.from_unit(np.random.default_rng(99).random((choice.test, box.d))),
    }
    found = []
    for name, count in (("train", choice.train), ("test", choice.test)):
        file = out / f"{name}.csv"
        if not file.is_file():
            simulate(points[name][:count], choice.cell_size_mm, out).to_csv(file, index=False)
        found.append(pd.read_csv(file).iloc[:count])
    return found[0], found[1]


def real_runs(train: pd.DataFrame, test: pd.DataFrame) -> list[dict[str, Any]]:
    """R2 and share within two standard deviations of each output, of plain emulators and of those with gradients, in all rows, in
    calm ones and in those that snapped."""
    names = published_box().names
    learnt = combine(train, train, input_names=names, output_names=OUTPUTS)
    test = test[test["status"] == "done"]
    x, y = test[list(names)].to_numpy(), test[list(OUTPUTS)].to_numpy()
    calm = ((test["newton"] <= _CALM) & (test["ed_modes"] == 0)).to_numpy()
    found = {
        "plain": EmulatorSet(learnt.inputs, tuple(fit_emulators(learnt))).predict(x),
        "gradients": fit_gradient_emulators(learnt).predict(x),
    }

    def r2(mean: FloatArray, rows: FloatArray) -> FloatArray:
        return 1.0 - ((mean - y)[rows] ** 2).sum(0) / ((y[rows] - y[rows].mean(0)) ** 2).sum(0)

    everywhere = np.ones(len(y), bool)
    scores = {f"{name} {where}": r2(mean, rows) for name, (mean, _) in found.items() for where, rows in
              (("all", everywhere), ("calm", calm))}  # fmt: skip
    within = {
        f"within, {name} {where} ({int(rows.sum())})": (np.abs(mean - y) < 2.0 * np.sqrt(variance))[rows].mean(0)
        for name, (mean, variance) in found.items()
        for where, rows in (("calm", calm), ("snapped", ~calm))
    }
    return [
        {"output": output, "asked": ASKED_R2, **{key: float(value[j]) for key, value in (scores | within).items()}}
        for j, output in enumerate(OUTPUTS)
    ]


def largest(runs: int = 300, d: int = 15, p: int = 150) -> dict[str, float]:
    """CPU seconds and memory of a fit at the largest scale: outputs mix 12 waves, each of some inputs."""
    rng = np.random.default_rng(0)
    x = qmc.Sobol(d, rng=rng).random(512)[:runs]
    direction = rng.normal(size=(12, d)) * (rng.random((12, d)) < 0.4)
    mix = rng.normal(size=(12, p))
    angle = 2.0 * x @ direction.T
    y = np.sin(angle) @ mix
    gradients = np.einsum("nk,kd,kp->ndp", 2.0 * np.cos(angle), direction, mix)
    inputs, outputs = (tuple(f"{letter}{i}" for i in range(size)) for letter, size in (("x", d), ("y", p)))
    table = RunTable(inputs, outputs, x, y, np.zeros((runs, p)), np.empty((0, d)), (), gradients)
    begin, memory = time.process_time(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    made = fit_gradient_emulators(table)
    spent = time.process_time() - begin
    more = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - memory) / 1024
    at = rng.random((500, d))
    exact = np.sin(2.0 * at @ direction.T) @ mix
    r2 = 1.0 - ((made.predict_mean(at) - exact) ** 2).sum(0) / ((exact - exact.mean(0)) ** 2).sum(0)
    begin = time.process_time()
    made.predict(at)
    return {
        "processes": made.weights.shape[1], "fit_s": spent, "asked_s": ASKED_S, "memory_mb": more, "asked_mb": ASKED_MB,
        "least_r2": float(r2.min()), "predict_ms_a_point": 2.0 * (time.process_time() - begin),
    }  # fmt: skip


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cell-size-mm", type=float, default=6.0)
    parser.add_argument("--train", type=int, default=60)
    parser.add_argument("--test", type=int, default=60)
    parser.add_argument("--out", type=Path, help="where tables and runs are kept (and found again)")
    parser.add_argument("--scale", action="store_true", help="only the cost at the largest scale")
    parser.add_argument("--json", action="store_true")
    choice = parser.parse_args()
    if choice.scale:
        rows = [largest()]
        failed = rows[0]["fit_s"] > ASKED_S or rows[0]["memory_mb"] > ASKED_MB
    else:
        with tempfile.TemporaryDirectory(prefix="lacli-emulation-") as temporary:
            out = (choice.out or Path(temporary)).resolve()
            out.mkdir(parents=True, exist_ok=True)
            rows = real_runs(*tables(choice, out))
        failed = any(row["gradients all"] < ASKED_R2 for row in rows)
    if choice.json:
        print_json({"rows": rows})
    else:
        print_table(
            f"asked: R2 {ASKED_R2:g} each" if not choice.scale else "largest scale",
            list(rows[0]),
            [list(r.values()) for r in rows],
        )
    if failed:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
