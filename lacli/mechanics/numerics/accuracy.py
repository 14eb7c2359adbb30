"""Discretisation errors that travel with a result: measured once for a scene and a choice of numerics, then looked up.

They are kept in the bundle's ``accuracy.json``, each entry with the identity of what was measured: the scene with its
numerics, the bundle's content, FreeFEM's scripts. Another scene, a bundle made anew, or other numerics find none.

What is kept is what was measured: one difference for each feature. As standard deviations they are ``floored``.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lacli.base.documents import read_json
from lacli.base.errors import InputError
from lacli.base.files import write_json
from lacli.contracts.features import KEYS
from lacli.contracts.identity import Identity, content_hash, determinants, flatten, identify
from lacli.contracts.scene import Scene

FILE = "accuracy.json"
_SEAL = "digest"
# keys of a scene that change what is written, how long it may take or by which engine, not the numbers; but for one that chooses
# between two states
_SAME_NUMBERS = ("outputs", "numerics.engine", "numerics.timeout_s")
_CHOOSES = "outputs.equilibria"


def numerics_name(scene: Scene) -> str:
    """The part of the numerics that discretises: element order and quadrature."""
    return f"p{scene.numerics.order}_q{scene.numerics.quadrature}"


def measured(scene: Scene) -> Identity:
    """What the errors of a scene depend on."""
    parts = flatten(determinants(scene))
    kept = {key: value for key, value in parts.items() if key not in _SAME_NUMBERS and key.split(".")[0] not in _SAME_NUMBERS}
    kept |= {_CHOOSES: True} if parts.get(_CHOOSES) else {}
    return identify("accuracy", **kept)


def floored(differences: Mapping[str, float]) -> dict[str, float]:
    """Standard deviations from one difference for each feature: at least the root mean square over those of its unit.

    A difference of two meshes passes through 0 where the meshes happen to agree, and one near it tells of no small error:
    that of a region's displacement is drawn from what those of all regions show. A feature alone in its unit keeps its own.
    """
    together: dict[str, list[float]] = {}
    for name, value in differences.items():
        together.setdefault(_unit(name), []).append(value)
    least = {unit: float(np.sqrt(np.mean(np.square(values)))) for unit, values in together.items()}
    return {name: max(value, least[_unit(name)]) for name, value in differences.items()}


def _unit(name: str) -> str:
    return KEYS[name].unit if name in KEYS else name


def known_errors(scene: Scene) -> dict[str, float]:
    """Feature -> standard deviation of its discretisation error in the feature's unit, ``floored`` from what ``accuracy.json`` of
    the bundle has; empty where unmeasured."""
    file = scene.anatomy.bundle / FILE
    if not file.is_file():
        return {}
    try:
        entry = _entries(file).get(measured(scene).digest)
        if entry is None:
            return {}
        if entry.get(_SEAL) != _seal(entry):
            raise ValueError("the errors of this scene were changed since they were measured")
        return floored({str(name): float(value) for name, value in entry["errors"].items()})
    except (InputError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise InputError(f"{file}: cannot be read ({error}). Remove it, or run `lacli tradeoff` again.") from error


def kept_errors(bundle: Path) -> list[tuple[str, dict[str, float]]]:
    """All that was measured on a bundle: numerics (``p1_q4``) and differences by feature. InputError where damaged."""
    file = bundle / FILE
    try:
        entries = _entries(file) if file.is_file() else {}
        return [(str(e["numerics"]), {str(k): float(v) for k, v in e["errors"].items()}) for e in entries.values()]
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise InputError(f"{file}: cannot be read ({error}). Remove it, or run `lacli tradeoff` again.") from error


def record(scene: Scene, errors: dict[str, float], reference: Scene) -> None:
    """Add the errors of a scene with its numerics, against the reference, to its bundle's ``accuracy.json``."""
    file = scene.anatomy.bundle / FILE
    try:
        entries = _entries(file) if file.is_file() else {}
    except (InputError, ValueError, TypeError, AttributeError):
        entries = {}  # damaged, or of an earlier version that did not say what it had measured
    identity = measured(scene)
    entries[identity.digest] = {
        "numerics": numerics_name(scene),
        "errors": errors,
        "measured": dict(identity.content),
        "against": dict(measured(reference).content),
    }
    entries[identity.digest][_SEAL] = _seal(entries[identity.digest])
    write_json(file, {"entries": entries})


def _seal(entry: Mapping[str, Any]) -> str:
    """Digest of an entry but for its seal."""
    return content_hash({key: value for key, value in entry.items() if key != _SEAL})


def _entries(file: Path) -> dict[str, Any]:
    """Entries by digest; none in a file of an earlier version, whose errors do not say what they were measured on."""
    document = read_json(file, error=InputError)
    return dict(document.get("entries", {}))
