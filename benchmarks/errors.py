"""Discretisation errors over anatomies: what a choice of numerics changes, and whether the built-in model of it holds.

    python benchmarks/errors.py FOLDER [--anatomies 12] [--from-seed 0] [--inner .6] [--alpha-times 1] [--finest-mm 2.7] [--times]
        [--over-the-box] [--images] [--write] [--bundle DIR ...]

For each seed an atrium (its own shape and volume, wall of 1 - 4 mm) and a point of the inner 60 % of the 14-input box are drawn
(near its corners quadratic cells of the finest size take up to an hour, and which of several equilibria is found differs), and
simulated with linear and quadratic cells of several sizes; differences to quadratic cells of --finest-mm are the true errors.
Runs are kept in FOLDER/runs.jsonl; another call goes on. The model (``lacli/mechanics/numerics/error_model.py``) is fitted to
all anatomies of FOLDER (other seeds may be of another --inner or --alpha-times), and its coverage measured on each by a fit to
the others. --times: coverage by time, and how the errors of features, regions and times go together. --over-the-box: what the
built-in model is worth on all runs that --times made, also nearer to the box's ends (--inner .9) and on softer walls
(--alpha-times .55), and the factor that holds its share there.
--images: atria as patients have them, meshed from label maps of 1 mm voxels by `lacli mesh`, at each size anew; of quadratic
cells alone, and of the image's own volume with linear ones. --images --times: of both orders and at all times; to these the
model of quadratic cells is fitted, and how their errors go together; of linear ones how they fall with the motion alone: all else
of theirs is of smooth atria, and --images --times tells what it is worth here.
--write: what was found becomes the built-in. --bundle: bundles of one more anatomy (coarse ones, the finest last), held against
the built-in model.

Asked: at least 93 % of the true errors within twice the stated, on anatomies the model has not seen.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from error_fit import Difference, constant, coverage, factor, factor_of, fit
from scipy.stats import qmc

import lacli
from lacli.base.documents import read_json
from lacli.base.errors import LacliError
from lacli.base.files import write_json
from lacli.cli.terminal.console import print_table
from lacli.contracts import bundle as bundles
from lacli.contracts.features import KEYS, at_time, parse
from lacli.contracts.motion import save_motion
from lacli.contracts.parameters import parameter_box
from lacli.contracts.scene import build_scene, with_parameters
from lacli.mechanics.numerics import error_correlation, error_model
from lacli.mechanics.numerics.cost import laplace, slenderness
from lacli.mechanics.numerics.error_correlation import measured
from lacli.mechanics.numerics.error_model import FILE, earliness, model_errors, moved_mm, resolution, scale
from lacli.mechanics.simulation import run_scene
from lacli.motion.annulus import descend
from lacli.synthetic.atrium import synthesize

CHOICES = ((1, 6.0), (1, 4.0), (1, 3.0), (2, 6.0), (2, 4.0))
OF_IMAGES = ((2, 8.0), (2, 6.0), (2, 4.0))
AT_TIMES = ((1, 8.0), (1, 6.0), (1, 4.0), (2, 6.0))
VOXEL_MM, DESCENT_MM = 1.0, 8.0
WALLS_MM = (1.0, 1.5, 2.0, 3.0, 4.0)
TIMES = "outputs.times=[0.1, 0.2, 0.3, 0.6]"


@dataclass(frozen=True)
class Spread:
    """What is drawn: points in the inner share of each input's range; what the stiffness of every region is multiplied with;
    whether atria come from label maps."""

    inner: float = 0.6
    alpha_times: float = 1.0
    images: bool = False


def drawn(seed: int, spread: Spread = Spread()) -> tuple[float, dict[str, float]]:
    """Wall thickness (mm) and inputs of a seed."""
    box = parameter_box()
    low, high = np.array(list(box.values())).T
    point = 0.5 + spread.inner * (qmc.Sobol(len(box), seed=7).random(128)[seed % 128] - 0.5)
    inputs = dict(zip(box, map(float, low + point * (high - low)), strict=True))
    softer = {name: value * spread.alpha_times for name, value in inputs.items() if name.startswith("alpha_")}
    return WALLS_MM[seed % len(WALLS_MM)], inputs | softer


def simulate(folder: Path, bundle: Path, inputs: dict[str, float], order: int, *more: str) -> dict[str, Any]:
    """One run as a row: status, cost, features, those at times among them."""
    settings = [f"numerics.order={order}", "outputs.fields=none", "outputs.unloaded=false", "numerics.timeout_s=900", *more]
    try:
        base = build_scene({"anatomy": {"bundle": str(bundle.resolve())}}, settings, folder=folder, where="errors")
        result = run_scene(with_parameters(base, inputs), folder / "runs")
    except LacliError as error:
        return {"status": "failed", "message": str(error)}
    features = {name: value for name, value in result.features.items() if isinstance(value, (int, float))}
    if more and result.status == "done":
        import pandas as pd

        for row in pd.read_csv(result.folder / "transients.csv").to_dict("records"):
            features |= {at_time(key, float(row["time"])): float(row[key]) for key in KEYS if key in row}
    return {"status": result.status, "kind": result.kind, "cpu_s": result.manifest.get("cpu_s"), "features": features}


def made(folder: Path, seed: int, cell_mm: float, thickness_mm: float, images: bool) -> Path:
    """The seed's bundle of that cell size, made once: of its formula, or of its label map."""
    where = folder / f"atrium_{seed:03d}_{cell_mm:g}mm"
    if where.is_dir():
        return where
    if images:
        still = folder / f"still_{seed:03d}"
        if not still.is_dir():
            lacli.synthesize(still, seed=seed, image=True, voxel_mm=VOXEL_MM)
        lacli.mesh(still / "labels.nrrd", where, la=2, lv=3, thickness_mm=thickness_mm, cell_size_mm=cell_mm)
        motion = descend(bundles.load(where), descent_mm=DESCENT_MM)
    else:
        bundle, motion = synthesize(seed, None, thickness_mm=thickness_mm, cell_size_mm=cell_mm, descent_mm=DESCENT_MM)
        bundles.save(bundle, where)
    save_motion(motion, where)
    return where


def of_seed(folder: Path, seed: int, order: int, cell_mm: float, spread: Spread, *more: str) -> dict[str, Any]:
    """The run of a seed with cells of that order and size."""
    thickness, inputs = drawn(seed, spread)
    where = made(folder, seed, cell_mm, thickness, spread.images)
    row = {"seed": seed, "thickness_mm": thickness, "order": order, "cell_size_mm": cell_mm, "inputs": inputs}
    row["images"] = spread.images
    return {**row, **simulate(folder, where, inputs, order, *more)}


def collect(
    folder: Path, seeds: range, choices: tuple[tuple[int, float], ...], name: str, spread: Spread, *more: str
) -> list[dict[str, Any]]:
    """All rows of the folder: those that were kept, of other seeds too, and those that are simulated now."""
    file = folder / name
    rows = [json.loads(line) for line in file.read_text(encoding="utf-8").splitlines()] if file.is_file() else []
    known = {(row["seed"], row["order"], row["cell_size_mm"]) for row in rows}
    for seed in seeds:
        if any(row["seed"] == seed and row["inputs"] != drawn(seed, spread)[1] for row in rows):
            raise SystemExit(f"{file}: seed {seed} has runs of another --inner or --alpha-times; take another folder or seeds.")
        if any(row["seed"] == seed and row.get("images", spread.images) != spread.images for row in rows):
            raise SystemExit(f"{file}: seed {seed} has atria with and without --images; take another folder or seeds.")
        for order, cell_mm in choices:
            if (seed, order, cell_mm) in known:
                continue
            rows.append(of_seed(folder, seed, order, cell_mm, spread, *more))
            with file.open("a", encoding="utf-8") as stream:
                stream.write(json.dumps(rows[-1]) + "\n")
            print(
                f"seed {seed}, order {order}, {cell_mm:g} mm: {rows[-1]['status']}, {rows[-1].get('cpu_s') or 0:.0f} CPU s",
                flush=True,
            )
    last = {(row["seed"], row["order"], row["cell_size_mm"]): row for row in rows}
    return list(last.values())


def differences(folder: Path, rows: list[dict[str, Any]], finest_mm: float) -> list[Difference]:
    """True errors of every feature of the rows that ended, where the reference ended too."""
    done = [row for row in rows if row["status"] == "done"]
    best = {row["seed"]: row["features"] for row in done if (row["order"], row["cell_size_mm"]) == (2, finest_mm)}
    found = []
    for row in done:
        if row["seed"] not in best or (row["order"], row["cell_size_mm"]) == (2, finest_mm):
            continue
        where, reference = (
            resolution(bundles.load(folder / f"atrium_{row['seed']:03d}_{cell_mm:g}mm"), row["order"])
            for cell_mm in (row["cell_size_mm"], finest_mm)
        )
        moved = moved_mm(row["features"])
        for name, value in row["features"].items():
            try:
                parse(name)
            except ValueError:
                continue
            time = name.partition("@")[2]
            size = scale(name, moved[time], where)
            if size > 0.0:
                error, early = value - best[row["seed"]][name], earliness(moved, time)
                found.append(Difference(row["seed"], name, where, error, size, row["cell_size_mm"], reference, early))
    return found


def imaged(folder: Path, rows: list[dict[str, Any]], finest_mm: float) -> list[Difference]:
    """Errors of the image's own volume with linear cells, whose edges are chords: no run is needed for them."""
    found = []
    for seed, cell_mm in sorted({(row["seed"], row["cell_size_mm"]) for row in rows if row["cell_size_mm"] != finest_mm}):
        mesh, finest = (bundles.load(folder / f"atrium_{seed:03d}_{size:g}mm") for size in (cell_mm, finest_mm))
        linear = bundles.as_order(mesh, 1)
        off = linear.cavity_volume_ml() - finest.cavity_volume_ml()
        where, best = resolution(linear, 1), resolution(finest, 2)
        found.append(Difference(seed, "edv_ml", where, off, scale("edv_ml", 0.0, where), cell_mm, best))
    return found


def over_the_box(folder: Path, rows: list[dict[str, Any]], finest_mm: float, write: bool) -> None:
    """What the built-in model is worth on anatomies it was not fitted to, each with the same weight, and the factor that would
    hold its share; written for linear cells, whose errors differences to quadratic ones tell."""
    run = {(row["seed"], row["order"], row["cell_size_mm"]): row for row in rows}
    document, data = read_json(FILE), differences(folder, rows, finest_mm)
    table, apart = [], []
    for order in (1, 2):
        stated: dict[tuple[int, float], dict[str, float]] = {}
        ratios: dict[int, list[float]] = {}
        for d in (d for d in data if d.where.order == order):
            if (key := (d.seed, d.cell_mm)) not in stated:
                stated[key] = model_errors(run[d.seed, order, d.cell_mm]["features"], d.where)
            if stated[key].get(d.name, 0.0) > 0.0:
                ratios.setdefault(d.seed, []).append(abs(d.error) / stated[key][d.name])
        for seed, own in ratios.items():
            asked = laplace_of(folder, run[seed, order, 6.0])
            apart.append([order, seed, asked, float(np.sqrt(np.mean(np.square(own)))), 100.0 * float(np.mean(np.less(own, 2.0)))])
        by, covered = factor_of(ratios), []
        for seed, own in ratios.items():
            covered.append(float(np.mean(np.less(own, 2.0 * factor_of({k: v for k, v in ratios.items() if k != seed})))))
        before = float(np.mean([np.mean(np.less(own, 2.0)) for own in ratios.values()]))
        table.append([order, len(ratios), 100.0 * before, by, 100.0 * float(np.mean(covered)), 100.0 * min(covered), ">= 93"])
        if order == 1:
            known = document["orders"]["1"]
            known |= {"factor": known["factor"] * by, "anatomies": len(ratios), "coverage": float(np.mean(covered))}
    head = ["order", "anatomies", "within twice (%)", "factor", "unseen, with it (%)", "worst anatomy (%)", "asked (%)"]
    print_table("The built-in model over the box", head, table)
    print_table("Anatomies", ["order", "seed", "Laplace's measure", "true over stated", "within twice (%)"], apart)
    if write:
        write_json(FILE, document)
        print(f"written: {FILE}")


def laplace_of(folder: Path, row: dict[str, Any]) -> float:
    """Laplace's measure of a run's softest region."""
    bundle = (folder / f"atrium_{row['seed']:03d}_{row['cell_size_mm']:g}mm").resolve()
    scene = build_scene({"anatomy": {"bundle": str(bundle)}}, [], folder=folder, where="errors")
    return laplace(with_parameters(scene, row["inputs"]), slenderness(bundles.load(bundle)))


# names, values, errors over the stated ones of one anatomy at one resolution
Sample = tuple[list[str], np.ndarray, np.ndarray]


def over_stated(folder: Path, rows: list[dict[str, Any]], finest_mm: float, order: int) -> dict[int, list[Sample]]:
    """Errors over the stated ones by anatomy, for cells of that order."""
    run = {(row["seed"], row["order"], row["cell_size_mm"]): row for row in rows}
    by: dict[tuple[int, float], list[Difference]] = {}
    for d in differences(folder, rows, finest_mm):
        if d.where.order == order:
            by.setdefault((d.seed, d.cell_mm), []).append(d)
    samples: dict[int, list[Sample]] = {}
    for (seed, cell_mm), data in by.items():
        features = run[seed, order, cell_mm]["features"]
        stated = model_errors(features, data[0].where)
        told = [d for d in data if stated.get(d.name, 0.0) > 0.0]
        values = np.array([features[d.name] for d in told])
        samples.setdefault(seed, []).append(([d.name for d in told], values, np.array([d.error / stated[d.name] for d in told])))
    return samples


def jointly(samples: dict[int, list[Sample]], order: int, apart: float) -> tuple[float, float]:
    """chi^2 of errors over their number, mean and largest, each anatomy's by the correlations of the others; ``apart``: share of
    an error that goes with no other."""
    found = []
    for seed, own in samples.items():
        groups = measured(sample for other, theirs in samples.items() if other != seed for sample in theirs)
        for names, values, errors in own:
            matrix = error_correlation.of_groups(names, values, groups, apart)
            found.append(float(errors @ np.linalg.solve(matrix, errors)) / len(errors))
    return float(np.mean(found)), float(np.max(found))


def by_time(folder: Path, rows: list[dict[str, Any]], finest_mm: float) -> list[list[Any]]:
    """Rows of a table: share of the errors at each time within twice the stated, by the cells' order and size."""
    run = {(row["seed"], row["order"], row["cell_size_mm"]): row for row in rows}
    stated: dict[tuple[int, int, float], dict[str, float]] = {}
    inside: dict[tuple[int, float, str], list[bool]] = {}
    for d in differences(folder, rows, finest_mm):
        key = (d.seed, d.where.order, d.cell_mm)
        if key not in stated:
            stated[key] = model_errors(run[key]["features"], d.where)
        if d.name in stated[key]:
            good = abs(d.error) <= 2.0 * stated[key][d.name]
            inside.setdefault((d.where.order, d.cell_mm, d.name.partition("@")[2] or "ES"), []).append(good)
    return [[*key, len(values), 100.0 * float(np.mean(values))] for key, values in sorted(inside.items())]


def held_against(folder: Path, names: list[Path], seed: int) -> list[list[Any]]:
    """Rows of a table: true and stated errors of one more anatomy, whose last bundle is the reference."""
    _, inputs = drawn(seed)
    best = simulate(folder, names[-1], inputs, 2)
    rows = []
    for name in names[:-1]:
        for order in (1, 2):
            run = simulate(folder, name, inputs, order)
            if run["status"] != "done" or best["status"] != "done":
                rows.append([name.name, order, run["status"], best["status"], "", "", ""])
                continue
            stated = model_errors(run["features"], resolution(bundles.load(name), order))
            true = {key: abs(run["features"][key] - best["features"][key]) for key in stated}
            inside = np.mean([true[key] <= 2.0 * stated[key] for key in stated])
            lengths = [key for key in stated if key.startswith("d_")]
            worst = max(lengths, key=lambda key: true[key])
            rows.append([name.name, order, len(stated), 100.0 * inside, worst, true[worst], stated[worst]])
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--anatomies", type=int, default=12)
    parser.add_argument("--from-seed", type=int, default=0)
    parser.add_argument("--finest-mm", type=float, default=2.7)
    parser.add_argument("--inner", type=float, default=0.6, help="share of each input's range that points are drawn from")
    parser.add_argument("--alpha-times", type=float, default=1.0, help="softer walls than drawn: .5")
    parser.add_argument("--times", action="store_true")
    parser.add_argument("--over-the-box", action="store_true", help="the built-in model on all runs that --times made")
    parser.add_argument("--images", action="store_true", help="atria meshed from label maps; quadratic cells alone")
    parser.add_argument("--write", action="store_true")
    parser.add_argument("--bundle", type=Path, nargs="+", default=[])
    choice = parser.parse_args()
    spread = Spread(choice.inner, choice.alpha_times, choice.images)
    choice.folder.mkdir(parents=True, exist_ok=True)
    seeds = range(choice.from_seed, choice.from_seed + choice.anatomies)
    if choice.bundle:
        head = ["bundle", "order", "features", "within twice the stated (%)", "worst displacement", "true (mm)", "stated (mm)"]
        print_table("Another anatomy", head, held_against(choice.folder, choice.bundle, choice.from_seed))
        return
    if choice.over_the_box:
        lines = (choice.folder / "times.jsonl").read_text(encoding="utf-8").splitlines()
        over_the_box(choice.folder, [json.loads(line) for line in lines], 4.0, choice.write)
        return
    choices = OF_IMAGES if choice.images else CHOICES
    name, more = "runs.jsonl", []
    if choice.times:
        choices, name, more = (*AT_TIMES, (2, 8.0), (2, 4.0)) if choice.images else AT_TIMES, "times.jsonl", [TIMES]
    finest_mm = 4.0 if choice.times and not choice.images else choice.finest_mm
    rows = collect(choice.folder, seeds, (*choices, (2, finest_mm)), name, spread, *more)
    if choice.images or not choice.times:
        fitted(choice.folder, rows, finest_mm, choice)
    if choice.times:
        together(choice.folder, rows, finest_mm, choice)


def fitted(folder: Path, rows: list[dict[str, Any]], finest_mm: float, choice: argparse.Namespace) -> None:
    """The model of the rows' errors: its coverage of anatomies left out, printed; written where that is asked."""
    data, document = differences(folder, rows, finest_mm), read_json(FILE) | {"finest_mm": finest_mm}
    table = []
    for order in sorted({d.where.order for d in data}):
        own = [d for d in data if d.where.order == order]
        model, by, covered = fit(own), factor(own), coverage(own)
        anatomies, share = len(covered), float(np.mean(list(covered.values())))
        known = document["orders"][str(order)]
        early = model.early if choice.times else known["early"]
        worst = 100.0 * min(covered.values())
        table.append([order, anatomies, len(own), model.size, model.t, early, by, 100.0 * share, worst, ">= 93"])
        known["early"] = early
        if order == 2 or not choice.images:
            known |= {
                "size": model.size, "t": model.t, "features": model.features, "factor": by, "anatomies": anatomies,
                "coverage": share,
            }  # fmt: skip
    if choice.images:
        known = document["orders"]["1"]
        known["features"]["edv_ml"] = constant(imaged(folder, rows, finest_mm), known["size"], known["t"])
    head = ["order", "anatomies", "errors", "power of h / L, turn", "power of t / h", "power of d_ES / d", "factor"]
    print_table("Model of the errors", [*head, "unseen within twice the stated (%)", "worst anatomy (%)", "asked (%)"], table)
    if choice.write:
        write_json(FILE, document)
        error_model._model.cache_clear()
        print(f"written: {FILE}")


def together(folder: Path, rows: list[dict[str, Any]], finest_mm: float, choice: argparse.Namespace) -> None:
    """The built-in model by time, and how errors go together; written where that is asked."""
    print_table("By time", ["order", "cells (mm)", "time", "errors", "within twice (%)"], by_time(folder, rows, finest_mm))
    found = {}
    for order in (1, 2):
        samples = over_stated(folder, rows, finest_mm, order)
        groups = found[str(order)] = measured(sample for own in samples.values() for sample in own)
        for apart in (0.0, error_correlation.APART):
            mean, most = jointly(samples, order, apart)
            print(f"order {order}, {apart:g} of an error apart: unseen chi^2 over p: mean {mean:.2f}, most {most:.1f}")
        largest = sorted(groups.items(), key=lambda item: -abs(item[1]))[:12]
        print(f"order {order}: " + "; ".join(f"{name} {value:.2f}" for name, value in largest))
    if choice.write:
        anatomies = len({row["seed"] for row in rows})
        document = read_json(error_correlation.FILE)
        for order in ("2",) if choice.images else ("1", "2"):
            document[order] = {"finest_mm": finest_mm, "anatomies": anatomies, "groups": found[order]}
        write_json(error_correlation.FILE, document)
        print(f"written: {error_correlation.FILE}")


if __name__ == "__main__":
    main()
