"""Cheap linear runs corrected by few quadratic ones: the posterior against quadratic runs alone, and the emulator's error.

    python benchmarks/fidelities.py [--truths 1] [--cell-size-mm 6] [--es-only] [--kinds quadratic linear both]
        [--reference-runs N] [--out DIR]
    python benchmarks/fidelities.py --emulator [--data DIR] [--cell-size-mm 5] [--half-width .15] [--held-out 10] [--out DIR]

The first: truths of `benchmarks/patient.py` (synthetic atrium, 90 targets with drawn, correlated errors, made by quadratic cells)
are calibrated by quadratic runs alone, by linear ones alone, and by both (--es-only: 27 targets, those at end-systole). Shifts of
the posterior's mean are in the quadratic one's standard deviations; CPU seconds are of the runs. The second: a real atrium
(Rodero et al. 2021, case 01); points of a part of the box, one half-width of each input's range to either side of its middle (of
stiffness: at 1.4), are run with linear cells, some with quadratic ones too; the corrected emulator is held against other
quadratic runs. Kept in DIR, and gone on with.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from patient import draw_truth, error_covariance, names_of
from real_atrium import DATA, made
from scipy.stats import qmc

from lacli.calibration.sequential.calibration import calibrate_sequentially
from lacli.calibration.sequential.evidence import gather
from lacli.calibration.sequential.fidelity.companion import companion
from lacli.calibration.sequential.fidelity.corrected import emulate
from lacli.calibration.sequential.fidelity.correction import corrected, fit_correction
from lacli.calibration.sequential.outputs import CHEAP, LOG, Features
from lacli.calibration.sequential.result import Sequential
from lacli.calibration.sequential.scale import Scale
from lacli.calibration.sequential.search import Reference, Settings, Status
from lacli.calibration.simulator import SceneSimulator, simulator
from lacli.cli.terminal.console import err, print_json, print_table
from lacli.contracts import bundle as bundles
from lacli.contracts.motion import save_motion
from lacli.contracts.scene import Scene, build_scene
from lacli.contracts.targets import Targets
from lacli.inference.box import OUTPUTS, Box, published_box
from lacli.inference.runs import STATUS, RunLog, runs_identity
from lacli.synthetic.atrium import synthesize

ASKED_SHIFT, ASKED_COST, ASKED_MM, ASKED_RUNS = 0.25, 0.2, 0.08, 10
KINDS = ("quadratic", "linear", "both")
_CHEAP_RUNS = 40  # of the emulator
_COUNTS = (2, 4, 6, 8, 10)  # quadratic runs that correct it
_STIFF = 0.7  # of the range's logarithm


def show(status: Status) -> None:
    """A line a run."""
    err.print(f"{status.runs:4d} runs  {status.stage} {status.done}/{status.total}", highlight=False)


def log_of(run: SceneSimulator, box: Box, names: tuple[str, ...], file: Path) -> RunLog:
    """The runs' table."""
    return RunLog(file, box.names, names, runs_identity(run, box.names, names))


def calibrations(
    runs: dict[str, SceneSimulator],
    box: Box,
    names: tuple[str, ...],
    number: int,
    folder: Path,
    kinds: list[str],
    most: int,
) -> dict[str, Any] | None:
    """Truth ``number`` calibrated by some of ``quadratic``, ``linear`` and ``both`` (at most ``most`` quadratic runs correct the
    others): each beside the quadratic one."""
    rng = np.random.default_rng(number)
    truth = draw_truth(box, rng)
    asked = (*names, "edv_ml")
    log = log_of(runs["quadratic"], box, asked, folder / "truth.csv")
    log.run(runs["quadratic"], truth[None])
    row = log.frame(truth[None]).iloc[0]
    covariance = error_covariance(names, float(row["edv_ml"]))
    y = row[list(names)].to_numpy(float) + np.linalg.cholesky(covariance) @ rng.standard_normal(len(names))
    targets = Targets(names, y, np.sqrt(np.diag(covariance)), covariance)
    settings = Settings(seed=number, reference_runs=most)
    found: dict[str, Sequential] = {}
    for kind in kinds:
        place = folder / {"quadratic": "calibration", "both": f"both_{most}"}.get(kind, kind)
        own = runs["quadratic" if kind == "quadratic" else "linear"]
        log = log_of(own, box, names, place / (CHEAP if kind == "both" else LOG))
        dear = Reference(runs["quadratic"], log_of(runs["quadratic"], box, names, place / LOG)) if kind == "both" else None
        found[kind] = calibrate_sequentially(own, box, targets, settings, place, log, show, reference=dear)
    others = [kind for kind in KINDS if kind in found and kind != "quadratic"]
    if "quadratic" not in found or not others:
        return None
    exact = found["quadratic"].chain.flat()
    alphas = [i for i, name in enumerate(box.names) if name.startswith("alpha_")]

    def off(of: Sequential) -> dict[str, float]:
        flat = of.chain.flat()
        shift = np.abs((flat.mean(0) - exact.mean(0)) / exact.std(0))
        ratio = flat.std(0) / exact.std(0)
        return {
            "alpha": float(shift[alphas].max()), "any": float(shift.max()), "sd_least": float(ratio.min()),
            "sd_most": float(ratio.max()), "cpu_s": of.cpu_s, "cost": of.cpu_s / found["quadratic"].cpu_s, "runs": of.runs,
        }  # fmt: skip

    row = {
        "truth": number, "quadratic_cpu_s": found["quadratic"].cpu_s, "quadratic_runs": found["quadratic"].runs,
        **{kind: off(found[kind]) for kind in others},
    }  # fmt: skip
    if (both := found.get("both")) is None:
        return row
    of_both = both.fidelity
    return {
        **row, "reference_runs": of_both.runs if of_both else 0, "rho": of_both.rho if of_both else None,
        "stages": both.stages, "stopped": both.stopped,
    }  # fmt: skip


def emulator(runs: dict[str, SceneSimulator], box: Box, half: float, held_out: int, folder: Path) -> list[dict[str, Any]]:
    """By number of quadratic runs: root mean square error of each feature against those held out, CPU seconds."""
    scale = Scale.of(box)
    middle = np.where([name.startswith("alpha_") for name in box.names], _STIFF, 0.5)
    sobol = qmc.Sobol(box.d, rng=np.random.default_rng(3)).random(64)
    z = np.clip(middle + half * (2.0 * sobol - 1.0), 0.0, 1.0)
    x = scale.to_x(z)
    tested = x[_CHEAP_RUNS : _CHEAP_RUNS + held_out]
    logs = {kind: log_of(run, box, OUTPUTS, folder / f"{kind}.csv") for kind, run in runs.items()}
    for kind, at in (("linear", np.vstack([x[:_CHEAP_RUNS], tested])), ("quadratic", np.vstack([x[: max(_COUNTS)], tested]))):
        logs[kind].run(runs[kind], at, lambda done, total: show(Status("runs", done, total, done)))
    sd = np.where([name.endswith("_mm") for name in OUTPUTS], 0.2, 5.0)
    targets = Targets(OUTPUTS, np.zeros(len(OUTPUTS)), sd)
    cheap = gather(logs["linear"], x[:_CHEAP_RUNS], targets, scale)
    frame = logs["quadratic"].frame(tested)
    done = (frame[STATUS] == "done").to_numpy()
    truth = frame.loc[done, list(OUTPUTS)].to_numpy(float)
    low = logs["linear"].frame(tested[done])[list(OUTPUTS)].to_numpy(float)
    rows = [{"runs": "linear run itself", "held_out": int(done.sum()), **_rms(low - truth)}]
    for count in (0, *_COUNTS):
        evidence = cheap
        rho = float("nan")
        if count:
            dear = gather(logs["quadratic"], x[:count], targets, scale)
            correction = fit_correction(cheap, dear)
            if correction is None:
                continue
            evidence, rho = corrected(cheap, dear, correction), correction.rho
        mean, variance = Features(emulate(evidence), scale, targets, OUTPUTS).predict(tested[done])
        inside = float((np.abs(mean - truth) < 1.96 * np.sqrt(variance)).mean())
        rows.append({"runs": count, "held_out": int(done.sum()), **_rms(mean - truth), "inside95": inside, "rho": rho})
    if (done_dear := logs["quadratic"].frame(x[: max(_COUNTS)]))[STATUS].eq("done").sum() > 3:
        alone = gather(logs["quadratic"], x[: max(_COUNTS)], targets, scale)
        mean, variance = Features(emulate(alone), scale, targets, OUTPUTS).predict(tested[done])
        inside = float((np.abs(mean - truth) < 1.96 * np.sqrt(variance)).mean())
        rows.append({"runs": f"{len(done_dear)} alone", "held_out": int(done.sum()), **_rms(mean - truth), "inside95": inside})
    cpu = {kind: float(log.frame(x[: max(_COUNTS)])["cpu_s"].mean()) for kind, log in logs.items()}
    return [{**row, "cpu_s_linear": cpu["linear"], "cpu_s_quadratic": cpu["quadratic"]} for row in rows]


def _rms(off: np.ndarray) -> dict[str, float]:
    return dict(zip(OUTPUTS, np.sqrt((off**2).mean(0)).tolist(), strict=True))


def simulators(scene: Scene, out: Path, workers: int, names: tuple[str, ...]) -> dict[str, SceneSimulator]:
    """Of both fidelities."""
    return {
        kind: simulator(one, out / "runs", workers, targets=names)
        for kind, one in (("quadratic", scene), ("linear", companion(scene, ["order=1"])))
    }


def print_calibrations(rows: list[dict[str, Any]]) -> None:
    """Asked beside measured."""
    table: list[list[Any]] = []
    for row in rows:
        for kind in (kind for kind in ("linear", "both") if kind in row):
            m, asked = row[kind], kind == "both"
            table += [
                [row["truth"], kind, "largest shift of an alpha, sd", f"<= {ASKED_SHIFT:g}" if asked else "", m["alpha"]],
                [row["truth"], kind, "largest shift of an input, sd", "", m["any"]],
                [row["truth"], kind, "sd, of the quadratic one's", "", f"{m['sd_least']:.2f} - {m['sd_most']:.2f}"],
                [row["truth"], kind, "CPU s, of the quadratic one's", f"<= {ASKED_COST:g}" if asked else "", m["cost"]],
            ]
        if "both" not in row:
            continue
        said = f"{row['both']['runs']}, {row['reference_runs']} of them quadratic; quadratic alone: {row['quadratic_runs']}"
        table.append([row["truth"], "both", "runs", f"about {ASKED_RUNS} quadratic", said])
    print_table("Two fidelities against quadratic cells alone", ["truth", "runs", "what", "asked", "measured"], table)


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--emulator", action="store_true", help="the emulator's error on a real atrium")
    parser.add_argument("--es-only", action="store_true", help="the targets at end-systole alone")
    parser.add_argument("--kinds", nargs="*", default=list(KINDS), choices=KINDS, help="only these calibrations (with --out)")
    parser.add_argument("--reference-runs", type=int, default=Settings.reference_runs, help="at most so many correct cheap ones")
    parser.add_argument("--truths", type=int, nargs="*", default=[1])
    parser.add_argument("--seed", type=int, default=1, help="of the synthetic atrium")
    parser.add_argument("--cell-size-mm", type=float)
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--half-width", type=float, default=0.15)
    parser.add_argument("--held-out", type=int, default=10)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--out", type=Path, help="where everything is kept (and found again); else it is thrown away")
    parser.add_argument("--json", action="store_true")
    choice = parser.parse_args()
    box = published_box()
    with tempfile.TemporaryDirectory(prefix="lacli-fidelities-") as temporary:
        out = (choice.out or Path(temporary)).resolve()
        size = choice.cell_size_mm or (5.0 if choice.emulator else 6.0)
        folder = out / f"bundle_{choice.seed}_{size:g}mm"
        if choice.emulator:
            folder = made(choice.data, size, out / f"real_{size:g}mm")
        elif not folder.is_dir():
            bundle, motion = synthesize(choice.seed, None, cell_size_mm=size)
            bundles.save(bundle, folder)
            save_motion(motion, folder)
        scene = build_scene({"anatomy": {"bundle": str(folder)}}, [], folder=folder, where="fidelities")
        names = OUTPUTS if choice.emulator else tuple(n for n in names_of(0.4) if not choice.es_only or "@" not in n)
        runs = simulators(scene, out, choice.workers, names)
        if choice.emulator:
            rows = emulator(runs, box, choice.half_width, choice.held_out, out / f"emulator_{size:g}mm_{choice.half_width:g}")
        else:
            what = "end_systole" if choice.es_only else "many"
            most = choice.reference_runs
            made_of = [calibrations(runs, box, names, n, out / f"{what}_{n}", choice.kinds, most) for n in choice.truths]
            rows = [row for row in made_of if row is not None]
    if choice.json:
        print_json({"asked": {"shift_sd": ASKED_SHIFT, "cost": ASKED_COST, "rms_mm": ASKED_MM}, "rows": rows})
    elif choice.emulator:
        columns = ["quadratic runs", "held out", *OUTPUTS, "inside 95 %", "rho"]
        table = [[r["runs"], r["held_out"], *(r[n] for n in OUTPUTS), r.get("inside95", ""), r.get("rho", "")] for r in rows]
        print_table(f"Error against quadratic runs, rms (asked with {ASKED_RUNS}: <= {ASKED_MM:g} mm)", columns, table)
        err.print(f"CPU s of a run: linear {rows[0]['cpu_s_linear']:.1f}, quadratic {rows[0]['cpu_s_quadratic']:.1f}")
    else:
        print_calibrations(rows)


if __name__ == "__main__":
    main()
