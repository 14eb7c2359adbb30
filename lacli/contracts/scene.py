"""The scene: which anatomy, which physics, which outputs. Units are converted here and nowhere else (mm, kPa inside)."""

from __future__ import annotations

import copy
import itertools
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import tomli_w
from pydantic import BaseModel, ConfigDict, Field, ValidationError, ValidationInfo, create_model, field_validator, model_validator
from pydantic_core import PydanticCustomError

from lacli.base.documents import brief, parse_toml, read_toml
from lacli.base.errors import SceneError
from lacli.contracts.labels import BODY_REGIONS
from lacli.contracts.laws import CONSTANTS, LAWS, MOST_CONSTANTS
from lacli.contracts.parameters import BY_KEY, QUANTITIES, judge, meant

MMHG_KPA = 0.133322
KPA_PER_UM_KPA_PER_MM = 1000.0
MOST_COMPLAINTS = 8  # of one scene, in one message

Number = Annotated[float, Field(allow_inf_nan=False)]


def _default(key: str) -> Any:
    """What the table of parameters says."""
    quantity = BY_KEY[key]
    return int(quantity.default) if quantity.whole else float(quantity.default)


class _Frozen(BaseModel):
    """A table of the scene; ``place`` is its key there. Its numbers keep to the possible ranges of contracts/parameters."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    place: ClassVar[str] = ""

    @field_validator("*", mode="before")
    @classmethod
    def _number(cls, value: Any, info: ValidationInfo) -> Any:
        if f"{cls.place}.{info.field_name}" in BY_KEY and isinstance(value, (bool, str)):
            raise PydanticCustomError("number", "input should be a valid number")
        return value

    @field_validator("*", mode="after")
    @classmethod
    def _possible(cls, value: Any, info: ValidationInfo) -> Any:
        quantity = BY_KEY.get(f"{cls.place}.{info.field_name}")
        if quantity is not None and isinstance(value, (int, float)):
            verdict, words = judge(quantity, value)
            if verdict == "impossible":
                raise PydanticCustomError("impossible", "{words}", {"words": words})
        return value


class PerRegion(_Frozen):
    """One positive number for each region of the atrial body."""

    anterior: Number
    posterior: Number
    septum: Number
    lateral: Number
    roof: Number

    def values(self) -> tuple[float, ...]:
        """In the order of BODY_REGIONS."""
        return tuple(getattr(self, name) for name in BODY_REGIONS)

    @property
    def uniform(self) -> bool:
        """Whether all five are equal."""
        return len(set(self.values())) == 1


class Stiffness(PerRegion):
    """C per region, kPa."""

    place = "materials.c_kpa"


class Exponent(PerRegion):
    """alpha per region."""

    place = "materials.alpha"


def _spread(value: Any) -> Any:
    """A single number stands for all five regions."""
    return dict.fromkeys(BODY_REGIONS, value) if isinstance(value, (int, float)) and not isinstance(value, bool) else value


class Anatomy(_Frozen):
    """``bundle``: the anatomy's folder, relative to the scene file."""

    bundle: Path = Field(description="folder of the anatomy bundle, relative to the scene file")


class _Wall(_Frozen):
    """The law of the wall and what all laws have by region."""

    place = "materials"
    law: Literal[tuple(LAWS)] = Field(default="guccione", description="law of the wall")  # type: ignore[valid-type]
    c_kpa: Stiffness = Stiffness(**{name: _default(f"materials.c_kpa.{name}") for name in BODY_REGIONS})
    alpha: Exponent = Exponent(**{name: _default(f"materials.alpha.{name}") for name in BODY_REGIONS})

    _spread_regions = field_validator("c_kpa", "alpha", mode="before")(_spread)


# a field for each constant of contracts/laws
_FIELDS: dict[str, Any] = {c.name: (Number, _default(f"materials.{c.name}")) for c in CONSTANTS}
_Constants: Any = create_model("_Constants", __base__=_Wall, **_FIELDS)


class Materials(_Constants):
    """The law of the wall (C, alpha per region, constants of its own) and neo-Hookean rings and planes."""

    kappa_kpa: Number = _default("materials.kappa_kpa")
    ring_c_kpa: Number = _default("materials.ring_c_kpa")
    plane_c_kpa: Number = _default("materials.plane_c_kpa")

    def constants(self) -> tuple[float, ...]:
        """Of the law, as many as the engine has places for; 0 where the law has fewer."""
        given = tuple(float(getattr(self, constant.name)) for constant in LAWS[self.law].constants)
        return given + (0.0,) * (MOST_CONSTANTS - len(given))


class Loads(_Frozen):
    """Cavity pressures at end-diastole and end-systole, and the right veins' springs."""

    place = "loads"
    edp_mmhg: Number = _default("loads.edp_mmhg")
    esp_mmhg: Number = _default("loads.esp_mmhg")
    vein_spring_kpa_per_um: Number = _default("loads.vein_spring_kpa_per_um")
    transient_mmhg: tuple[tuple[float, float], ...] | None = Field(
        default=None,
        description="cavity pressure over the cycle, pairs of share of the cycle and mmHg; without it, idealised",
    )

    @field_validator("transient_mmhg")
    @classmethod
    def _increasing(cls, value: tuple[tuple[float, float], ...] | None) -> Any:
        if value is not None:
            times = [t for t, _ in value]
            if len(value) < 2 or any(b <= a for a, b in itertools.pairwise(times)):
                raise ValueError("needs at least two [time, pressure] pairs with increasing times in [0, 1]")
            if not all(0 <= t <= 1 and math.isfinite(p) and p >= 0 for t, p in value):
                raise ValueError("times must lie in [0, 1] (one cycle), pressures be finite and not negative")
            verdict, words = judge(BY_KEY["loads.esp_mmhg"], max(p for _, p in value))
            if verdict == "impossible":
                raise ValueError(words)
        return value

    @property
    def edp_kpa(self) -> float:
        return self.edp_mmhg * MMHG_KPA

    @property
    def esp_kpa(self) -> float:
        return self.esp_mmhg * MMHG_KPA

    @property
    def vein_spring_kpa_per_mm(self) -> float:
        return self.vein_spring_kpa_per_um * KPA_PER_UM_KPA_PER_MM


class Pericardium(_Frozen):
    """Springs along the epicardium's unloaded normal, scaled by smoothstep((xi - (pth - ramp)) / ramp)."""

    place = "pericardium"
    k_peri_kpa_per_um: Number = _default("pericardium.k_peri_kpa_per_um")
    pth: Number = _default("pericardium.pth")
    ramp: Number = _default("pericardium.ramp")
    outward_only: bool = Field(default=False, description="whether the springs resist outward motion only")

    @property
    def k_peri_kpa_per_mm(self) -> float:
        return self.k_peri_kpa_per_um * KPA_PER_UM_KPA_PER_MM


class MotionSettings(_Frozen):
    """Where the mitral annulus goes: the bundle's own frames, a rigid shift along its axis, or nowhere."""

    place = "motion"
    annulus: Literal["bundle", "axial", "none"] = Field(
        default="bundle",
        description="motion of the mitral annulus: the frames of the bundle, a rigid descent along its axis, or none",
    )
    amplitude_mm: Number = _default("motion.amplitude_mm")
    es_time: Number = _default("motion.es_time")
    frames: int = _default("motion.frames")


class Numerics(_Frozen):
    """How it is solved; ``lacli tradeoff`` measures what other choices cost and gain.

    ``unloading``: "prestrain" gives the wall the strain that balances EDP in the image itself; "backward" looks for an unloaded
    shape by backward displacement. ``settle_ed``: where the image's shape is no stable equilibrium, let the wall settle into
    the nearest stable one before the reservoir phase. ``engine``: what assembles and solves: the compiled "plugin", the "script"
    that needs no C++ compiler and gives the same numbers, or "auto", the plugin where it can be built. ``max_newton``: steps
    at one load before it is shortened; generous, since a soft wall that snaps through gets past its fold by going on at the
    load it has, where shorter loads only come to the same fold again.
    """

    place = "numerics"
    order: Literal[1, 2] = Field(default=2, description="order of the cells: 1 straight with 4 nodes, 2 curved with 10 nodes")
    quadrature: Literal[4, 14] = Field(default=4, description="quadrature points of a cell")
    kappa_points_kpa: Number = _default("numerics.kappa_points_kpa")
    unloading: Literal["prestrain", "backward"] = Field(
        default="prestrain",
        description="how end-diastole is found: strain that balances EDP in the image, or backward displacement",
    )
    settle_ed: bool = Field(
        default=False, description="whether an unstable end-diastole settles into the nearest stable one before it fills"
    )
    engine: Literal["auto", "plugin", "script"] = Field(
        default="auto",
        description="what assembles and solves: the compiled plugin, the script without compiler, or whichever can",
    )
    unloading_volume_tolerance: Number = _default("numerics.unloading_volume_tolerance")
    unloading_max_sweeps: int = _default("numerics.unloading_max_sweeps")
    tolerance_mm: Number = _default("numerics.tolerance_mm")
    max_newton: int = _default("numerics.max_newton")
    timeout_s: Number = _default("numerics.timeout_s")


class Outputs(_Frozen):
    """What is written beside the features at end-systole. ``unloaded``: also the wall without pressure, and its volume.
    ``sensitivities``: also the features' derivatives by the study's inputs, at end-systole and in every frame."""

    place = "outputs"
    frames: int = _default("outputs.frames")
    times: tuple[float, ...] = Field(
        default=(), description="times of the frames, shares of the cycle, in place of `frames`; after end-systole, conduit"
    )
    conduit: bool = Field(default=False, description="whether the conduit phase after end-systole is simulated")
    fields: Literal["none", "es", "all"] = Field(
        default="es", description="states written as VTU files: none, end-diastole and end-systole, or every frame"
    )
    strain: bool = Field(
        default=False,
        description="whether features of the wall's cells are added: fibre stretch and change of thickness by region",
    )
    unloaded: bool = Field(default=True, description="whether the wall without pressure is sought too, and its volume")
    sensitivities: bool = Field(
        default=False, description="whether the derivatives of the features by the inputs of the study are written too"
    )

    @field_validator("times")
    @classmethod
    def _rising(cls, value: tuple[float, ...]) -> tuple[float, ...]:
        if len(value) > 100 or any(not 0.0 < t <= 1.0 for t in value) or any(b <= a for a, b in itertools.pairwise(value)):
            raise ValueError("needs rising times above 0, up to 1 (one cycle from end-diastole), 100 at most")
        return value


class Scene(_Frozen):
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
