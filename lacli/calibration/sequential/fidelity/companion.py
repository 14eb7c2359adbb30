"""The cheap companion of a scene: the same patient and physics with cheaper numerics."""

from __future__ import annotations

from collections.abc import Sequence

from lacli.base.errors import AnatomyError, UsageError
from lacli.contracts.scene import Scene, build_scene

_ALLOWED = "keys of numerics (order=1) and anatomy.bundle, a bundle of the same atrium with coarser cells"


def usual(scene: Scene) -> tuple[str, ...]:
    """What carries a calibration where nothing is said: of a scene of quadratic cells linear ones, of others nothing."""
    return ("order=1",) if scene.numerics.order == 2 else ()


def companion(scene: Scene, overrides: Sequence[str]) -> Scene:
    """The scene with some ``key=value``: keys of numerics, bare or whole, or ``anatomy.bundle``.

    Raises UsageError for keys that are no choice of numerics, and where nothing differs; SceneError, AnatomyError.
    """
    whole = []
    for text in overrides:
        key = text.partition("=")[0].strip()
        if key != "anatomy.bundle" and not key.startswith("numerics.") and "." in key:
            raise UsageError(f"--cheap {text}: {key} changes what is simulated; allowed are {_ALLOWED}.")
        whole.append(text.strip() if "." in key else f"numerics.{text.strip()}")
    document = scene.model_dump(mode="json", exclude_none=True)
    made = build_scene(document, whole, folder=scene.anatomy.bundle.parent, where="--cheap")
    if made == scene:
        raise UsageError(f"--cheap {' '.join(overrides)}: the scene is so itself; a cheap companion differs, by {_ALLOWED}.")
    if not (made.anatomy.bundle / "wall.vtu").is_file():
        raise AnatomyError(f"{made.anatomy.bundle}: not an anatomy bundle. Mesh the same atrium with another --cell-size-mm.")
    if (made.motion.es_time, made.numerics.unloading) != (scene.motion.es_time, scene.numerics.unloading):
        raise UsageError("--cheap: unloading and the time of end-systole must be the scene's own.")
    return made
