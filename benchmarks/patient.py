"""One patient from end to end with the truth known: targets with drawn, correlated noise; runs, posterior. Synthetic atrium.

    python benchmarks/patient.py [--cell-size-mm 6] [--order 1] [--seed 1] [--truths 1 2 3] [--few] [--shared] [--reference 200]
                                 [--real] [--cheap order=1] [--warm] [--set pericardium.dents=true] [--out DIR] [--json]

Each truth is drawn from the inner part of the box and simulated; its 90 targets (magnitudes, components along normal and
universal coordinates, area strain and volume, at end-systole and in three frames) get errors of 0.2 mm, 5 % of the
end-diastolic volume and 0.02 of strain, correlated between frames (.5) and between features of a region's motion (.3), and are
calibrated against. With --shared a truth starts from the runs of those before it that lie nearest to its targets (those are not
counted; truth 3005 is a run of truth 3's calibration, the fifth from its end, and not among those). --real: the anatomy is a real
one (Rodero et al. 2021, case 01). --cheap, --warm, --set: as of `lacli calibrate`. Kept in DIR, and gone on with. Printed: asked
beside measured.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from real_atrium import DATA, made

from lacli.base.files import write_json
from lacli.calibration.sequential.calibration import calibrate_sequentially
from lacli.calibration.sequential.fidelity.companion import companion
from lacli.calibration.sequential.outputs import CHEAP, LOG
from lacli.calibration.sequential.result import Sequential
from lacli.calibration.sequential.search import Reference, Settings, Status
from lacli.calibration.simulator import SceneSimulator, simulator
from lacli.cli.terminal.console import err, print_json, print_table
from lacli.contracts import bundle as bundles
from lacli.contracts.features import at_time
from lacli.contracts.labels import BODY_REGIONS
from lacli.contracts.motion import save_motion
from lacli.contracts.scene import build_scene
from lacli.contracts.targets import Targets
from lacli.inference.box import OUTPUTS, Box, published_box
from lacli.inference.runs import RunLog, runs_identity
from lacli.synthetic.atrium import synthesize

BETWEEN_FRAMES, BETWEEN_FEATURES = 0.5, 0.3
SD_MM, SD_VOLUME, SD_STRAIN = 0.2, 0.05, 0.02
ASKED = {"runs to the MAP": 20, "runs in all": 60, "largest sd of alpha": 0.35, "wall minutes": 5.0}
_NEAR = 1000  # truth 3005 is a run of truth 3's calibration, the fifth from its end
_GIVEN = 16  # runs of other truths that one starts from
_INNER = 0.15  # truths keep so far from the ends of each range (of its logarithm)


def names_of(es: float) -> tuple[str, ...]:
    """The 90 targets: 21 features at end-systole and in three frames, volumes, and the published ones not among them."""
    keys = [f"{kind}_{region}_mm" for kind in "nab" for region in BODY_REGIONS] + [f"area_strain_{r}" for r in BODY_REGIONS]
    frames = [at_time(key, es * share) for share in (0.25, 0.5, 0.75) for key in (*keys, "volume_ml")]
    return (*OUTPUTS, *keys, *frames)


def error_covariance(names: tuple[str, ...], edv_ml: float) -> np.ndarray:
    """(p, p): sds as stated; correlation falls with the frames and where region or kind differ."""
    keys = [(n.partition("@")[0], n.partition("@")[2]) for n in names]
    sd = np.array([SD_MM if k.endswith("_mm") else SD_VOLUME * edv_ml if k.endswith("_ml") else SD_STRAIN for k, _ in keys])
    kinds = np.array([k.replace("esv_ml", "volume_ml") for k, _ in keys])
    times = np.array([t for _, t in keys])
    regions = np.array([next((r for r in BODY_REGIONS if r in k), "") for k in kinds])
    same_time, same_kind, same_region = (a[:, None] == a[None] for a in (times, kinds, regions))
    correlation = np.where(same_kind, 1.0, np.where(same_region, BETWEEN_FEATURES, 0.0))
    correlation = correlation * np.where(same_time, 1.0, BETWEEN_FRAMES)
    return np.asarray(correlation * np.outer(sd, sd))


def draw_truth(box: Box, rng: np.random.Generator) -> np.ndarray:
    """(d,) within the inner part of the ranges, wide ones by their logarithm."""
    share = _INNER + (1.0 - 2.0 * _INNER) * rng.random(box.d)
    wide = box.upper > 10.0 * box.lower
    return np.asarray(np.where(wide, box.lower * (box.upper / box.lower) ** share, box.from_unit(share)))


def calibrated(
    run: SceneSimulator,
    cheaper: SceneSimulator | None,
    box: Box,
    targets: Targets,
    settings: Settings,
    folder: Path,
    pool: list[RunLog],
) -> tuple[Sequential, int, float]:
    """The calibration, how many runs it was given, and its wall minutes. cheaper: runs that carry the search, corrected by few of
    the others; pool: logs of other truths, whose runs nearest to the targets it starts from."""

    def kept(of: SceneSimulator, name: str) -> RunLog:
        return RunLog(folder / name, box.names, targets.names, runs_identity(of, box.names, targets.names))

    log, reference = kept(run, LOG), None
    if cheaper is not None:
        run, log, reference = cheaper, kept(cheaper, CHEAP), Reference(run, log)
    begin, stage, first = time.monotonic(), "", None
    if pool:
        rows = {x: row for other in pool for x, row in other.rows.items() if row["status"] == "done"}
        precision = np.linalg.inv(error_of(targets))
        off = {x: np.array([float(row[n]) for n in targets.names]) - targets.mean for x, row in rows.items()}
        best = sorted(off, key=lambda x: float(off[x] @ precision @ off[x]))[:_GIVEN]
        log.rows = {x: rows[x] for x in best} | log.rows
        first = np.array(best)

    def show(status: Status) -> None:
        nonlocal stage
        if status.stage != stage:
            stage = status.stage
            err.print(f"{time.monotonic() - begin:6.0f} s  {status.runs:3d} runs  {stage}", highlight=False)

    found = calibrate_sequentially(run, box, targets, settings, folder, log, show, first=first, reference=reference)
    return found, len(first) if first is not None else 0, (time.monotonic() - begin) / 60.0


def error_of(targets: Targets) -> np.ndarray:
    """The covariance (p, p) of the targets' errors."""
    return np.diag(targets.sd**2) if targets.covariance is None else targets.covariance


def inside(found: Sequential, truth: np.ndarray) -> list[bool]:
    """By input: whether the truth is in the 95 % interval."""
    return [bool(float(r["low95"]) <= t <= float(r["high95"])) for r, t in zip(found.table, truth, strict=True)]


def reference(run: SceneSimulator, box: Box, targets: Targets, found: Sequential, count: int, folder: Path) -> dict[str, float]:
    """The posterior's mean without emulator: draws of the posterior are run, and weighed by the likelihood of the runs over
    that of the chain. Largest difference of the means in sds, its standard error, and how many draws count."""
    chain = found.chain
    flat, log_prob = chain.flat(), chain.flat_log_prob()
    rows = np.linspace(0, len(flat) - 1, count).astype(int)
    x, names = flat[rows], found.targets.names
    log = RunLog(folder / "reference.csv", box.names, targets.names, runs_identity(run, box.names, targets.names))
    log.run(run, x)
    frame = log.frame(x)
    done = (frame["status"] == "done").to_numpy()
    away = frame.loc[done, list(names)].to_numpy(float) - found.targets.mean
    true = -0.5 * np.einsum("mi,ij,mj->m", away, np.linalg.inv(error_of(found.targets)), away)
    log_weight = true - log_prob[rows][done]
    weight = np.exp(log_weight - log_weight.max())
    weight /= weight.sum()
    kept = x[done]
    mean, effective = weight @ kept, 1.0 / float((weight**2).sum())
    sd = flat.std(0)
    # of the weighted mean, against the plain mean of the same draws: what the weights alone change
    return {
        "mean off, sd": float((np.abs(kept.mean(0) - mean) / sd).max()), "its error, sd": float(1.0 / np.sqrt(effective)),
        "effective draws": effective, "failed": int((~done).sum()), "log likelihood off, sd": float(log_weight.std()),
    }  # fmt: skip


def one(
    run: SceneSimulator,
    cheaper: SceneSimulator | None,
    box: Box,
    names: tuple[str, ...],
    number: int,
    out: Path,
    choice: argparse.Namespace,
) -> dict[str, Any]:
    """Truth ``number``: simulated, blurred by its noise, calibrated against; kept, and not made again."""
    kind = "few" if choice.few else "many"
    folder = out / f"{kind}_{number}"
    kept = folder / "row.json"
    told = ("seed", "real", "cell_size_mm", "order", "cheap", "warm", "overrides", "shared", "reference")
    made_by = {name: getattr(choice, name) for name in told}
    if kept.is_file():
        row: dict[str, Any] = json.loads(kept.read_text())
        if row.get("made by") != made_by:
            raise SystemExit(f"{kept}: was made with other options ({row.get('made by')}); take another --out.")
        return row
    rng = np.random.default_rng(number)
    of_runs = runs_identity(run, box.names, names)
    base, at = divmod(number, _NEAR)
    first = base or number
    truth = draw_truth(box, np.random.default_rng(first) if base else rng)
    asked = (*names, "edv_ml")
    log = RunLog(out / f"{kind}_{first}" / "truth.csv", box.names, asked, runs_identity(run, box.names, asked))
    log.run(run, truth[None])
    made = log.frame(truth[None]).iloc[0]
    if made["status"] != "done":
        return {"truth": number, "failed": str(made["kind"])}
    y = made[list(names)].to_numpy(float)
    covariance = error_covariance(names, float(made["edv_ml"]))
    if base:  # a run that an earlier calibration made is the truth
        around = RunLog(out / f"{kind}_{base}" / "calibration" / "runs.csv", box.names, names, of_runs)
        told = [x for x, row in around.rows.items() if row["status"] == "done"]
        truth = np.array(told[-1 - at])
        y = np.array([float(str(around.rows[told[-1 - at]][name])) for name in names])
    noise = np.linalg.cholesky(covariance) @ rng.standard_normal(len(names))
    targets = Targets(names, y + noise, np.sqrt(np.diag(covariance)), covariance)
    pool = []
    if choice.shared:
        files = [out / f"{kind}_{k}" / "calibration" / "runs.csv" for k in choice.truths[: choice.truths.index(number)]]
        pool = [RunLog(file, box.names, names, of_runs) for file in files if file.is_file()]
        for other in pool:
            other.rows.pop(tuple(truth.tolist()), None)
    settings = Settings(seed=number, max_runs=60 + _GIVEN * bool(pool))
    chosen = replace(run, warm=choice.warm)
    found, given, minutes = calibrated(chosen, cheaper, box, targets, settings, folder / "calibration", pool)
    alpha = {str(r["input"]): float(r["sd"]) for r in found.table if str(r["input"]).startswith("alpha_")}
    within = inside(found, truth)
    row = {
        "made by": made_by,
        "truth": number, "runs to the MAP": found.map_runs - given, "runs in all": found.runs - given, "runs given": given,
        "failed runs": found.failed, "chi2": found.misfit, "targets": len(names), "left out": len(found.left_out),
        "largest sd of alpha": max(alpha.values()), "sd of alpha": alpha, "inside": sum(within), "of": box.d,
        "outside": [name for name, good in zip(box.names, within, strict=True) if not good], "wall minutes": minutes,
        "cpu minutes": found.cpu_s / 60.0, "change": float(found.change.max()), "held out": found.held_out,
        "modes": len(found.minima), "elsewhere": found.sweep.elsewhere, "box open": found.sweep.open_,
        "stages": found.stages, "refused": found.refused, "converged": found.chain.converged,
    }  # fmt: skip
    if found.fidelity is not None:
        row["corrected by"] = found.fidelity.words()
    if choice.reference:
        row["reference"] = reference(run, box, targets, found, choice.reference, folder)
    write_json(kept, row)
    return row


def summary(rows: list[dict[str, Any]]) -> list[list[Any]]:
    """What was asked beside what all truths say: [what, asked, measured]."""
    done = [row for row in rows if "failed" not in row]
    inside_, of = sum(row["inside"] for row in done), sum(row["of"] for row in done)
    spread = np.array([list(row["sd of alpha"].values()) for row in done])
    to_map, in_all = (np.array([row[key] for row in done]) for key in ("runs to the MAP", "runs in all"))
    return [
        ["truths", 40, f"{len(done)} ({len(rows) - len(done)} failed, {sum(bool(row['refused']) for row in done)} refused)"],
        ["inside their 95 % intervals", "93 - 97 %", f"{inside_} of {of}: {inside_ / of:.1%}"],
        ["runs to the MAP: median, largest", 20, f"{np.median(to_map):g}, {to_map.max()}"],
        ["runs in all: median, largest", 60, f"{np.median(in_all):g}, {in_all.max()}"],
        ["emulator's part settled (< .1 sd)", "all", f"{sum(row['change'] < 0.1 for row in done)}"],
        ["sd of alpha: mean by region", 0.35, ", ".join(f"{v:.2f}" for v in spread.mean(0))],
        ["sd of alpha: largest by region", 0.35, ", ".join(f"{v:.2f}" for v in spread.max(0))],
        ["truths with targets left out", "", str(sum(row["left out"] > 0 for row in done))],
    ]  # fmt: skip


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cell-size-mm", type=float, default=6.0)
    parser.add_argument("--order", type=int, default=1, choices=(1, 2))
    parser.add_argument("--seed", type=int, default=1, help="of the atrium")
    parser.add_argument("--truths", type=int, nargs="*", default=[1], help="numbers of the truths")
    parser.add_argument("--real", action="store_true", help="a real atrium instead of a seed's")
    parser.add_argument("--few", action="store_true", help="against the seven published targets alone")
    parser.add_argument("--shared", action="store_true", help="truths start from the runs of those before")
    parser.add_argument("--reference", type=int, default=0, help="so many draws of the posterior are run, to weigh them anew")
    parser.add_argument("--cheap", nargs="+", default=[], help="key=value of the cheap runs that few of the others correct")
    parser.add_argument("--warm", action="store_true", help="runs start from the nearest that has ended")
    parser.add_argument(
        "--set", action="append", default=[], dest="overrides", help="key=value of the scene (pericardium.dents=true)"
    )
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--out", type=Path, help="where everything is kept (and found again); else it is thrown away")
    parser.add_argument("--json", action="store_true")
    choice = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="lacli-patient-") as temporary:
        out = (choice.out or Path(temporary)).resolve()
        folder = out / f"bundle_{'real' if choice.real else choice.seed}_{choice.cell_size_mm:g}mm"
        if choice.real:
            made(DATA, choice.cell_size_mm, folder)
        elif not folder.is_dir():
            bundle, motion = synthesize(choice.seed, None, cell_size_mm=choice.cell_size_mm)
            bundles.save(bundle, folder)
            save_motion(motion, folder)
        box = published_box()
        scene = build_scene(
            {"anatomy": {"bundle": str(folder)}},
            [f"numerics.order={choice.order}", *choice.overrides],
            folder=folder,
            where="patient",
        )
        es = 0.4
        names = OUTPUTS if choice.few else names_of(es)
        run = simulator(scene, out / "runs", choice.workers, targets=names)
        cheaper = None
        if choice.cheap:
            cheaper = simulator(companion(scene, choice.cheap), out / "runs", choice.workers, targets=names, warm=choice.warm)
        rows = [one(run, cheaper, box, names, number, out, choice) for number in choice.truths]
    if choice.json:
        print_json({"asked": ASKED, "summary": summary(rows), "rows": rows})
        return
    for row in rows:
        table = [[key, ASKED.get(key, ""), str(value)] for key, value in row.items()]
        print_table(f"truth {row['truth']}", ["what", "asked", "measured"], table)
    print_table(f"{len(rows)} truths", ["what", "asked", "measured"], summary(rows))


if __name__ == "__main__":
    main()
