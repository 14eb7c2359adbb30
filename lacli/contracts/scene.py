"""The scene: which anatomy, which physics, which outputs; read, overridden, validated, and told what is wrong with it."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import tomli_w
from pydantic import BaseModel, ValidationError, model_validator

from lacli.base.documents import brief, parse_toml, read_toml
from lacli.base.errors import SceneError
from lacli.contracts.labels import BODY_REGIONS
from lacli.contracts.parameters import BY_KEY, QUANTITIES, judge, meant
from lacli.contracts.sections import Anatomy, Loads, Materials, MotionSettings, Numerics, Outputs, Pericardium, Section

MOST_COMPLAINTS = 8  # of one scene, in one message


class Scene(Section):
    """A resolved scene. ``folder`` is where relative paths start; it is not part of the content."""

    anatomy: Anatomy
    materials: Materials = Materials()
    loads: Loads = Loads()
    pericardium: Pericardium = Pericardium()
    motion: MotionSettings = MotionSettings()
    numerics: Numerics = Numerics()
    outputs: Outputs = Outputs()

    @model_validator(mode="after")
    def _bulk(self) -> Scene:
        if self.numerics.kappa_points_kpa >= self.materials.kappa_kpa:
            raise ValueError(
                f"numerics.kappa_points_kpa ({self.numerics.kappa_points_kpa:g}) must be below materials.kappa_kpa "
                f"({self.materials.kappa_kpa:g}); the rest is carried by the pressure field"
            )
        return self

    @model_validator(mode="after")
    def _pressures(self) -> Scene:
        given = self.loads.transient_mmhg
        if given is not None and given[0][1] != self.loads.edp_mmhg:
            raise ValueError(
                f"loads.transient_mmhg begins with {given[0][1]:g} mmHg, loads.edp_mmhg is {self.loads.edp_mmhg:g}; "
                "the cycle starts at end-diastole, with the pressure under which the image was taken"
            )
        if self.loads.transient_mmhg is None and self.loads.esp_mmhg < self.loads.edp_mmhg:
            raise ValueError(
                f"loads.esp_mmhg ({self.loads.esp_mmhg:g}) is below loads.edp_mmhg ({self.loads.edp_mmhg:g}); "
                f"the pressure rises through the reservoir phase{meant(BY_KEY['loads.esp_mmhg'], self.loads.esp_mmhg)}"
            )
        return self

    @model_validator(mode="after")
    def _no_idle_switch(self) -> Scene:
        if self.numerics.settle_ed and (self.numerics.unloading != "prestrain" or self.loads.edp_mmhg == 0):
            why = "loads.edp_mmhg is 0" if self.loads.edp_mmhg == 0 else 'numerics.unloading is "backward"'
            raise ValueError(
                f"numerics.settle_ed would do nothing where {why}: what settles is a wall that holds EDP by its prestrain; "
                "leave numerics.settle_ed out"
            )
        idle = {"annulus_times": self.motion.annulus_times != 1.0, "annulus_off_mm": bool(self.motion.annulus_off_mm)}
        for name in (name for name, given in idle.items() if given and self.motion.annulus != "bundle"):
            raise ValueError(
                f'motion.{name} would do nothing where motion.annulus is "{self.motion.annulus}": it is of the frames '
                f"of the bundle; leave motion.{name} out"
            )
        if self.outputs.conduit and self.outputs.times:
            raise ValueError(
                "outputs.conduit would do nothing beside outputs.times, which name all frames: those after end-systole are its "
                "conduit; leave outputs.conduit out, or outputs.times"
            )
        return self

    def content(self) -> dict[str, Any]:
        """Plain values, without the anatomy's path (a path is no content)."""
        document = self.model_dump(mode="json")
        document.pop("anatomy")
        return document


def load_scene(file: Path, overrides: list[str] | None = None) -> Scene:
    """Read ``scene.toml``; ``overrides`` are ``a.b=value`` strings. The bundle's path becomes absolute.

    Raises SceneError with the key, what is wrong there and what is allowed.
    """
    document = read_toml(file, error=SceneError, missing="no such scene file")
    return build_scene(document, overrides or [], folder=file.resolve().parent, where=str(file))


def build_scene(document: Mapping[str, Any], overrides: list[str], *, folder: Path, where: str) -> Scene:
    """Validate a scene given as nested dictionaries; see ``load_scene``."""
    merged = copy.deepcopy(dict(document))
    for text in overrides:
        _override(merged, text)
    try:
        scene = Scene.model_validate(merged)
    except ValidationError as error:
        raise SceneError(_explain(error, where)) from error
    try:
        bundle = (folder / scene.anatomy.bundle).resolve()
    except (OSError, RuntimeError, ValueError) as error:  # links in a circle, characters no path has
        raise SceneError(f"{where}: anatomy.bundle: no path ({error}; given: {str(scene.anatomy.bundle)!r}).") from error
    return scene.model_copy(update={"anatomy": Anatomy(bundle=bundle)})


def _override(document: dict[str, Any], text: str) -> None:
    key, equals, value = text.partition("=")
    path = [part.strip() for part in key.split(".")]
    if not equals or not all(path) or len(path) > 10:
        raise SceneError(f"--set {brief(text)}: write it as key.key=value, for example loads.edp_mmhg=8.")
    try:
        parsed = parse_toml(f"value = {value}", f"--set {brief(text)}", error=SceneError)["value"]
    except SceneError:  # a bare word, or no value of any kind: the models tell
        parsed = value.strip()
    place = document
    for index, part in enumerate(path[:-1]):
        inner = place.setdefault(part, {})
        if isinstance(inner, (int, float)) and part in ("c_kpa", "alpha"):
            inner = place[part] = dict.fromkeys(BODY_REGIONS, inner)
        if not isinstance(inner, dict):
            raise SceneError(f"--set {text}: {'.'.join(path[: index + 1])} is a value, not a table.")
        if part in ("c_kpa", "alpha") and not inner:
            inner.update(getattr(Materials(), part).model_dump())
        place = inner
    place[path[-1]] = parsed


def _explain(error: ValidationError, where: str) -> str:
    found: dict[str, list[str]] = {}  # words -> keys; five regions with one value are said once
    for item in error.errors()[:MOST_COMPLAINTS]:
        key = brief(".".join(str(part) for part in item["loc"])).strip("'\"") or "scene"
        if item["type"] == "extra_forbidden":
            words = f"unknown key; known here: {', '.join(_known_keys(item['loc'][:-1]))}"
        elif item["type"] == "missing":
            words = "missing"
        else:
            message = item["msg"].removeprefix("Value error, ")
            told = item["type"] == "impossible" or (item["type"] == "value_error" and not item["loc"])
            given = "" if told else f" (given: {brief(item.get('input'))})"
            words = f"{message[:1].lower()}{message[1:]}{given}"
        found.setdefault(words, []).append(key)
    lines = [f"{_common(keys)}: {words}" for words, keys in found.items()]
    if error.error_count() > MOST_COMPLAINTS:
        lines.append(f"and {error.error_count() - MOST_COMPLAINTS} more")
    return f"{where}: " + "; ".join(lines) + "."


def _known_keys(path: tuple[Any, ...]) -> list[str]:
    model: type[BaseModel] = Scene
    for part in path:
        annotation = model.model_fields[str(part)].annotation
        if isinstance(annotation, type) and issubclass(annotation, BaseModel):
            model = annotation
    return sorted(model.model_fields)


def dump_scene(scene: Scene) -> str:
    """The resolved scene as TOML text."""
    return tomli_w.dumps(scene.model_dump(mode="json", exclude_none=True))


def with_parameters(scene: Scene, values: Mapping[str, float]) -> Scene:
    """The scene with some quantities of contracts/parameters set by their names, validated again."""
    document = scene.model_dump(mode="json", exclude_none=True)
    for name, value in values.items():
        if name not in QUANTITIES:
            raise SceneError(f"unknown parameter {brief(name)}; known: {', '.join(QUANTITIES)}.")
        *path, last = QUANTITIES[name].key.split(".")
        place = document
        for part in path:
            place = place[part]
        place[last] = int(value) if QUANTITIES[name].whole else float(value)
    return build_scene(document, [], folder=Path("/"), where="parameters")


def parameters_of(scene: Scene, names: Sequence[str]) -> list[float]:
    """The values of quantities of contracts/parameters in a scene, by their names: the inverse of ``with_parameters``."""
    found = []
    for name in names:
        if name not in QUANTITIES:
            raise SceneError(f"unknown parameter {brief(name)}; known: {', '.join(QUANTITIES)}.")
        value: Any = scene
        for part in QUANTITIES[name].key.split("."):
            value = getattr(value, part)
        found.append(float(value))
    return found


def notes(scene: Scene) -> list[str]:
    """What is possible in a scene but not plausible, a sentence each, with the unit that was likely meant."""
    found: dict[str, list[str]] = {}  # words -> keys; five regions with one value are said once
    document = scene.model_dump(mode="json")
    for key, quantity in BY_KEY.items():
        value: Any = document
        for part in key.split("."):
            value = value[part]
        found.setdefault(judge(quantity, value)[1], []).append(key)
    if scene.loads.transient_mmhg is not None:
        highest = max(p for _, p in scene.loads.transient_mmhg)
        found.setdefault(judge(BY_KEY["loads.esp_mmhg"], highest)[1], []).append("loads.transient_mmhg")
    found.pop("", None)
    return [f"{_common(keys)}: {words}." for words, keys in found.items()]


def _common(keys: list[str]) -> str:
    stems = {key.rpartition(".")[0] for key in keys}
    return stems.pop() if len(keys) == len(BODY_REGIONS) and len(stems) == 1 else ", ".join(keys)
