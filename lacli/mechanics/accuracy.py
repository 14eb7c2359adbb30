"""Discretisation errors that travel with a result: measured once for an anatomy and a choice of numerics, then looked up."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from lacli.base.errors import InputError
from lacli.base.files import write_json
from lacli.contracts.scene import Scene

FILE = "accuracy.json"


def numerics_name(scene: Scene) -> str:
    """The part of the numerics that discretises: element order and quadrature."""
    return f"p{scene.numerics.order}_q{scene.numerics.quadrature}"


def known_errors(scene: Scene) -> dict[str, float]:
    """Feature -> discretisation error in the feature's unit, from ``accuracy.json`` of the bundle; empty where unmeasured."""
    file = scene.anatomy.bundle / FILE
    if not file.is_file():
        return {}
    try:
        document: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
        entry = document.get(numerics_name(scene), {})
        return {str(name): float(value) for name, value in entry.items()}
    except (ValueError, TypeError, AttributeError) as error:
        raise InputError(f"{file}: cannot be read ({error}). Remove it, or run `lacli tradeoff` again.") from error


def record(bundle: Path, name: str, errors: dict[str, float]) -> None:
    """Add the errors of one choice of numerics to the bundle's ``accuracy.json``."""
    file = bundle / FILE
    document = json.loads(file.read_text(encoding="utf-8")) if file.is_file() else {}
    document[name] = errors
    write_json(file, document)
