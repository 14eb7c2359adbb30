"""Speed against accuracy: the same scene with several choices of numerics, against the most careful one."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lacli.base.errors import InputError
from lacli.contracts.scene import Scene
from lacli.contracts.sections import Anatomy
from lacli.mechanics.numerics.accuracy import numerics_name, record
from lacli.mechanics.simulation import OnProgress, run_scene

FEATURES = ("esv_ml", "d_global_mm", "d_anterior_mm", "d_posterior_mm", "d_septum_mm", "d_lateral_mm", "d_roof_mm")
CHOICES: tuple[tuple[int, int], ...] = ((1, 4), (2, 4), (2, 14))


@dataclass(frozen=True)
class Variant:
    """One simulation: mesh (``own`` or ``finer``), order, quadrature; features, cost, and failure if there was one."""

    mesh: str
    numerics: str
    scene: Scene
    status: str
    kind: str | None
    features: dict[str, Any]
    cpu_s: float
    peak_memory_mb: float


def run_variants(scene: Scene, finer: Path | None, root: Path, on_progress: OnProgress | None = None) -> Iterator[Variant]:
    """Simulate the choices on the scene's mesh, and the default choice on a finer mesh of the same atrium if one is given."""
    plans = [("own", scene.anatomy.bundle, order, points) for order, points in CHOICES]
    if finer is not None:
        plans.append(("finer", finer, 2, 4))
    for mesh, bundle, order, points in plans:
        numerics = scene.numerics.model_copy(update={"order": order, "quadrature": points})
        variant = scene.model_copy(update={"numerics": numerics, "anatomy": Anatomy(bundle=bundle)})
        result = run_scene(variant, root, on_progress)
        cost = result.manifest
        yield Variant(
            mesh,
            numerics_name(variant),
            variant,
            result.status,
            result.kind,
            result.features,
            float(cost.get("cpu_s", float("nan"))),
            float(cost.get("peak_memory_mb", float("nan"))),
        )


def reference(variants: Sequence[Variant]) -> Variant:
    """The most careful variant that ended: the finer mesh, else the highest order and quadrature. InputError if none did."""
    done = [variant for variant in variants if variant.status == "done"]
    if not done:
        raise InputError("no choice of numerics ended with a result; see the failures above.")
    return done[-1]


def errors(variant: Variant, against: Variant) -> dict[str, float]:
    """Absolute difference of every feature, in the feature's unit; ``accuracy.floored`` makes standard deviations of them."""
    return {
        name: abs(float(variant.features[name]) - float(against.features[name]))
        for name in FEATURES
        if name in variant.features and name in against.features
    }


def recommend(differences: Mapping[str, dict[str, float]], cpu_s: Mapping[str, float], tolerance_mm: float) -> str | None:
    """The cheapest choice whose displacements all lie within the tolerance; None if there is none."""
    good = [
        name
        for name, difference in differences.items()
        if all(value <= tolerance_mm for feature, value in difference.items() if feature.endswith("_mm"))
    ]
    return min(good, key=lambda name: cpu_s[name]) if good else None


def keep(variants: Sequence[Variant], against: Variant) -> None:
    """Write the errors of each choice on the scene's own mesh into its bundle, so that later results carry them.

    Not of a choice that the reference shares mesh and order with: their difference is the quadrature's, and says nothing of the
    cells; the model's estimate goes on standing for them.
    """
    for variant in variants:
        if variant.mesh == "own" and variant.status == "done" and measures(variant, against):
            record(variant.scene, errors(variant, against), against.scene)


def measures(variant: Variant, against: Variant) -> bool:
    """Whether the reference tells the discretisation error of a choice: by finer cells or by a higher order."""
    return variant.mesh != against.mesh or variant.scene.numerics.order < against.scene.numerics.order
