"""One scene from start to end: load, plan, write, run, read, keep. The run's folder is complete or is not there."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lacli.base.files import write_json
from lacli.contracts.case import Case
from lacli.contracts.scene import Scene
from lacli.freefem import program as freefem
from lacli.mechanics import deck, results, sensitivities
from lacli.mechanics.accuracy import known_errors
from lacli.mechanics.deck import Deck, OnProgress
from lacli.mechanics.plan import prepare
from lacli.mechanics.store import OpenRun, StoredRun, open_run

_PRODUCTS = ("scene.toml", deck.SCRIPT, "features.json", "transients.csv")


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


def run_scene(scene: Scene, root: Path, on_progress: OnProgress | None = None) -> RunResult:
    """Simulate, or return what is stored for the same content. A simulation that fails is a result, not an exception.

    Raises AnatomyError, SceneError, SolverMissingError, StorageError.
    """
    case = prepare(scene)
    with open_run(root, scene) as run:
        if run.stored is None:
            written = deck.write(case, run.folder)
            _keep(run, case, written, deck.run(written, scene.numerics.timeout_s, on_progress))
        assert run.stored is not None
        return _result(run.stored)


def _result(stored: StoredRun) -> RunResult:
    features = stored.features() if stored.status == "done" else {}
    return RunResult(stored.key, stored.folder, stored.status, stored.kind, stored.message, features, stored.manifest)


def _keep(run: OpenRun, case: Case, written: Deck, outcome: freefem.Outcome) -> None:
    """Read what the deck left, write the products beside it, and give the run its name."""
    usage: dict[str, Any] = {
        "cpu_s": outcome.cpu_s,
        "peak_memory_mb": outcome.peak_memory_mb,
        "engine": written.engine,
        "versions": {"freefem": freefem.find().version},
    }
    if outcome.kind is not None and not (outcome.kind == "timeout" and results.stand(run.folder)):
        results.keep_last_state(case, run.folder)
        results.tidy(run.folder)
        run.finish("failed", kind=outcome.kind, message=outcome.message, **usage)
        return
    features, products = collect(case, run.folder, cpu_s=outcome.cpu_s, peak_memory_mb=outcome.peak_memory_mb)
    if "sensitivities" in features:
        usage["sensitivities"] = features["sensitivities"]
    results.tidy(run.folder)
    run.finish("done", products=products, newton_iterations=features["newton_iterations"], **usage)


def collect(case: Case, folder: Path, **cost: float) -> tuple[dict[str, Any], list[str]]:
    """Turn the raw results of a deck that has run in ``folder`` into ``features.json``, tables and fields.

    cost: cpu_s and peak_memory_mb, where they are known. Gives the features and the products' names.
    Raises SimulationError where FreeFEM's results cannot be read.
    """
    found = results.read(case, folder)
    features = results.features(case, found) | cost
    if errors := known_errors(case.scene):
        features["discretisation_error"] = errors
    products = [*_PRODUCTS, *sensitivities.write(case, found, folder)]
    if said := sensitivities.statement(case, found):
        features["sensitivities"] = said
    write_json(folder / "features.json", features)
    results.transients(case, found).to_csv(folder / "transients.csv", index=False)
    return features, [*products, *results.write_fields(case, found, folder)]
