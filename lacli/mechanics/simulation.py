"""One scene from start to end: load, plan, write, run, read, keep. The run's folder is complete or is not there."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lacli.base.documents import read_json
from lacli.base.errors import InputError, SimulationError, SolverMissingError, StorageError, UsageError
from lacli.base.files import check_folder, write_json, write_text
from lacli.base.notes import note
from lacli.contracts.case import Case
from lacli.contracts.identity import run_key
from lacli.contracts.scene import Scene, load_scene
from lacli.freefem.program import find
from lacli.freefem.run import Outcome
from lacli.mechanics import deck, results, sensitivities
from lacli.mechanics import warm as starts
from lacli.mechanics.deck import Deck, OnProgress
from lacli.mechanics.numerics import equilibria, stability
from lacli.mechanics.numerics.stated import with_errors
from lacli.mechanics.plan import prepare
from lacli.mechanics.store import OpenRun, StoredRun, check_products, open_run

_WRITTEN = "deck.json"  # the key of a deck that is run by hand
_PRODUCTS = (deck.SCENE, deck.SCRIPT, "features.json", results.TRANSIENTS)


@dataclass(frozen=True)
class RunResult:
    """An ended run; ``features`` as in features.json (empty for a failed one), ``kind`` and ``message`` of a failure."""

    key: str
    folder: Path
    status: str
    kind: str | None
    message: str
    features: dict[str, Any]
    manifest: dict[str, Any]


def run_scene(scene: Scene, root: Path, on_progress: OnProgress | None = None, *, warm: bool = False) -> RunResult:
    """Simulate, or return what is stored for the same content. A simulation that fails is a result, not an exception.

    warm: start from the nearest run below ``root`` where there is one, and leave where others may (``lacli.mechanics.warm``;
    the compiled engine with sensitivities and prestrain alone).
    Raises AnatomyError, SceneError, SolverMissingError, StorageError.
    """
    case = prepare(scene)
    with open_run(root, case.key, solver=_solver()) as run:
        if run.stored is not None and (words := of_another_engine(run.stored, scene)):
            note(words)
        if run.stored is None:
            start = starts.nearest(case, root) if warm else None
            written = deck.write(case, run.folder, start)
            outcome = deck.run(written, on_progress)
            _keep(run, case, written, outcome, start)
    assert run.stored is not None
    return _result(run.stored, case)


def _solver() -> str | None:
    """FreeFEM's version; None where there is none: stored runs can be looked at all the same."""
    try:
        return find().version
    except SolverMissingError:
        return None


def of_another_engine(stored: StoredRun, scene: Scene) -> str:
    """What to say of a stored run that the script made where the compiled engine may be expected; '' where there is nothing.

    Both are one result: their features agree to 13 digits (``benchmarks/engines.py``), less than what makes a run another, but
    the script tells no sensitivities, and whoever compares two tables digit by digit should know.
    """
    if stored.manifest.get("engine") != "script" or scene.numerics.engine != "auto":
        return ""
    return (
        f"run {stored.key} was made by the script engine, and is shown as it was: the compiled one gives the same to 13 digits."
        " Set numerics.engine = 'plugin' to have it made by that."
    )


def _result(stored: StoredRun, case: Case) -> RunResult:
    features: dict[str, Any] = dict(stored.features()) if stored.status == "done" else {}
    if features:
        features = with_errors(case.scene, case.bundle, features)
    return RunResult(stored.key, stored.folder, stored.status, stored.kind, stored.message, features, stored.manifest)


def _keep(run: OpenRun, case: Case, written: Deck, outcome: Outcome, start: starts.Start | None) -> None:
    """Read what the deck left, write the products beside it, and give the run its name."""
    usage: dict[str, Any] = {
        "cpu_s": outcome.cpu_s,
        "peak_memory_mb": outcome.peak_memory_mb,
        "engine": written.engine,
        "versions": {"freefem": find().version},
    }
    if outcome.kind is not None and not (outcome.kind in ("timeout", "starved") and results.stand(run.folder)):
        results.keep_last_state(case, run.folder)
        results.tidy(run.folder)
        run.finish("failed", kind=outcome.kind, message=outcome.message, **usage)
        return
    try:
        features, products = collect(case, run.folder, cpu_s=outcome.cpu_s, peak_memory_mb=outcome.peak_memory_mb)
    except SimulationError as error:
        results.tidy(run.folder)
        run.finish("failed", kind=error.kind, message=str(error).removeprefix(f"{run.folder}: "), **usage)
        return
    if "sensitivities" in features:
        usage["sensitivities"] = features["sensitivities"]
    if equilibria.FOUND in features:
        usage[equilibria.FOUND] = features[equilibria.FOUND]
    if start is not None:
        found = results.read(case, run.folder)
        usage["start"] = starts.statement(start, found)
        starts.keep(case, found, run.folder, run.root)
    results.tidy(run.folder)
    run.finish("done", products=products, newton_iterations=features["newton_iterations"], **usage)


def collect(case: Case, folder: Path, **cost: float) -> tuple[dict[str, Any], list[str]]:
    """Turn the raw results of a deck that has run in ``folder`` into ``features.json``, tables and fields.

    cost: cpu_s and peak_memory_mb, where they are known. Gives the features and the products' names.
    Raises SimulationError where FreeFEM's results cannot be read.
    """
    found = results.read(case, folder)
    features = results.features(case, found) | equilibria.told(case, found) | stability.told(case, found) | cost
    products = [*_PRODUCTS, *sensitivities.write(case, found, folder)]
    if said := sensitivities.statement(case, found):
        features["sensitivities"] = said
    write_json(folder / "features.json", features)
    results.transients(case, found).to_csv(folder / results.TRANSIENTS, index=False)
    return features, [*products, *results.write_fields(case, found, folder)]


def write_by_hand(scene: Scene, folder: Path) -> Path:
    """Write the deck of a scene, all that it reads, and a shell script that runs FreeFEM on it; gives that script.

    ``read_by_hand`` reads what the run leaves. The folder must be absent or empty. Raises StorageError, AnatomyError,
    SolverMissingError.
    """
    check_folder(folder)
    if folder.is_dir() and any(folder.iterdir()):
        raise StorageError(f"{folder}: is not empty; choose a new folder for the deck.")
    case = prepare(scene)
    folder.mkdir(parents=True, exist_ok=True)
    write_json(folder / _WRITTEN, {"key": case.key})
    deck.write(case, folder)
    script = folder / "run.sh"
    write_text(script, deck.shell_script())
    script.chmod(script.stat().st_mode | 0o111)
    return script


def read_by_hand(folder: Path) -> dict[str, Any]:
    """Features of a deck of ``write_by_hand`` that has run; ``features.json``, transients and fields are written beside it.

    Raises InputError where the folder holds no such deck, UsageError where bundle, solver or version are no longer those that it
    was written for, SimulationError where FreeFEM's results are missing or incomplete.
    """
    scene = _scene_of(folder, _WRITTEN)
    case = prepare(scene)
    features, _ = collect(case, folder)
    return with_errors(scene, case.bundle, features)


def rerun(folder: Path, on_progress: OnProgress | None = None) -> tuple[dict[str, Any], dict[str, Any]]:
    """Run a stored run once more, its deck and inputs written anew from its scene: features as stored, and as found now.

    Nothing is kept of the second run. Raises as ``read_by_hand`` does, and SimulationError where the second run fails.
    """
    scene, stored = finished(folder)
    before = stored.features()
    case = prepare(scene)
    with tempfile.TemporaryDirectory(prefix=".rerun-", dir=folder.parent) as name:
        place = Path(name)
        outcome = deck.run(deck.write(case, place), on_progress)
        if outcome.kind is not None and not results.stand(place):
            raise SimulationError(outcome.kind, f"{folder}: the second run failed ({outcome.kind}): {outcome.message}")
        after, _ = collect(case, place, cpu_s=outcome.cpu_s, peak_memory_mb=outcome.peak_memory_mb)
    return with_errors(case.scene, case.bundle, before), with_errors(case.scene, case.bundle, after)


def finished(folder: Path) -> tuple[Scene, StoredRun]:
    """A stored run by its folder, and its scene: scene, bundle and solver are what it was made of, its products as it wrote them.

    Raises InputError where there is no run, UsageError and StorageError where something has changed since.
    """
    scene = _scene_of(folder, "manifest.json")
    manifest = read_json(folder / "manifest.json")
    stored = StoredRun(manifest["key"], folder, manifest)
    check_products(stored, manifest.get("products", {}))
    return scene, stored


def _scene_of(folder: Path, record: str) -> Scene:
    """The scene of a run's folder, which ``record`` gives a key, checked to be the same content still."""
    try:
        key = read_json(folder / record)["key"]
    except (InputError, KeyError, TypeError) as error:
        raise InputError(f"{folder}: no run of lacli, {record} is missing or damaged ({error}).") from error
    scene = load_scene(folder / deck.SCENE)
    if run_key(scene) != key:
        raise UsageError(
            f"{folder}: scene.toml, the bundle {scene.anatomy.bundle} or lacli's solver are no longer what this run was made of "
            f"(key {key}, now {run_key(scene)}). Simulate the scene anew."
        )
    return scene
