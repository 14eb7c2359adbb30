"""The discretisation errors that stand beside a result: what a trade-off measured on the very scene, else the model's."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lacli.base.documents import read_json
from lacli.base.errors import InputError
from lacli.contracts import bundle as bundles
from lacli.contracts.bundle import Bundle
from lacli.contracts.scene import Scene
from lacli.contracts.targets import Targets
from lacli.mechanics.numerics import error_correlation, error_model
from lacli.mechanics.numerics.accuracy import known_errors
from lacli.mechanics.numerics.error_correlation import correlation
from lacli.mechanics.numerics.error_model import model_errors, resolution

MEASURED, MODEL = "measured", "model"


@dataclass(frozen=True)
class Stated:
    """Errors by feature (one standard deviation, in the feature's unit), and where each comes from: ``measured`` or ``model``."""

    errors: dict[str, float]
    source: dict[str, str]


def coefficients() -> dict[str, Any]:
    """All that the model of errors and of how they go together was fitted to be: what targets are widened by hangs on it."""
    return {file.stem: read_json(file, error=InputError) for file in (error_model.FILE, error_correlation.FILE)}


def stated_errors(scene: Scene, bundle: Bundle, features: Mapping[str, Any]) -> Stated:
    """The errors of a scene's features. ``bundle`` is the scene's, ``features`` are by name with units, others beside them.

    Raises InputError where the bundle's ``accuracy.json`` is damaged.
    """
    measured = known_errors(scene)
    modelled = model_errors(features, resolution(bundle, scene.numerics.order))
    errors = {name: measured.get(name, modelled.get(name)) for name in features}
    known = {name: value for name, value in errors.items() if value is not None}
    return Stated(known, {name: MEASURED if name in measured else MODEL for name in known})


def with_errors(scene: Scene, bundle: Bundle, features: Mapping[str, Any]) -> dict[str, Any]:
    """The features, and their errors beside them: ``discretisation_error`` and ``discretisation_error_source``, both by feature.

    They are looked up when a result is shown and not kept with it: they may have been measured since.
    """
    stated = stated_errors(scene, bundle, features)
    if not stated.errors:
        return dict(features)
    return {**features, "discretisation_error": stated.errors, "discretisation_error_source": stated.source}


def with_discretisation(targets: Targets, scene: Scene, *, but: str = "") -> tuple[Targets, Stated]:
    """Targets widened by the errors of the scene that is held against them, and those errors.

    The motion that scales the model's is the targets' own. Errors go together as ``error_correlation`` has it. ``but``: a
    source whose errors are not added, since they are elsewhere.
    """
    told = dict(zip(targets.names, map(float, targets.mean), strict=True))
    stated = stated_errors(scene, bundles.load(scene.anatomy.bundle), told)
    added = {name: value for name, value in stated.errors.items() if stated.source[name] != but}
    return targets.widened(added, correlation(targets.names, targets.mean, scene.numerics.order)), stated


def said_of(names: Sequence[str], stated: Stated) -> list[str]:
    """What a user is told of the discretisation errors that stand for targets: those estimated, and those unknown."""
    modelled = [name for name in names if stated.source.get(name) == MODEL]
    unknown = [name for name in names if name not in stated.errors]
    said = []
    if modelled:
        lengths = [stated.errors[name] for name in modelled if "_mm" in name]
        about = f" (displacements: {np.median(lengths):.2g} mm in the middle)" if lengths else ""
        said.append(
            f"the discretisation error of {_some(modelled, names)} is a model's estimate{about} and part of the targets' errors. "
            "`lacli tradeoff` measures it for volume and displacements at end-systole."
        )
    if unknown:
        said.append(
            f"the discretisation error of {_some(unknown, names)} is not known and not in the posterior, which may be too narrow."
        )
    return said


def _some(chosen: Sequence[str], names: Sequence[str]) -> str:
    more = ", ..." if len(chosen) > 3 else ""
    return f"{len(chosen)} of {len(names)} targets ({', '.join(chosen[:3])}{more})"
