"""The scene: which anatomy, which physics, which outputs. Units are converted here and nowhere else (mm, kPa inside)."""

from __future__ import annotations

import copy
import itertools
import math
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import tomli_w
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from lacli.base.errors import SceneError
from lacli.contracts.labels import BODY_REGIONS

MMHG_KPA = 0.133322
KPA_PER_UM_KPA_PER_MM = 1000.0

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]


class _Frozen(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class PerRegion(_Frozen):
    """One positive number for each region of the atrial body."""

    anterior: Positive
    posterior: Positive
    septum: Positive
    lateral: Positive
    roof: Positive

    def values(self) -> tuple[float, ...]:
        """In the order of BODY_REGIONS."""
        return tuple(getattr(self, name) for name in BODY_REGIONS)

    @property
    def uniform(self) -> bool:
        """Whether all five are equal."""
        return len(set(self.values())) == 1


def _spread(value: Any) -> Any:
    """A single number stands for all five regions."""
    return dict.fromkeys(BODY_REGIONS, value) if isinstance(value, (int, float)) and not isinstance(value, bool) else value


class Anatomy(_Frozen):
    """``bundle``: the anatomy's folder, relative to the scene file."""

    bundle: Path


class Materials(_Frozen):
    """Guccione's law of the wall (C, alpha per region) and neo-Hookean rings and planes."""

    law: Literal["guccione", "neo_hookean"] = "guccione"
    c_kpa: PerRegion = PerRegion(**dict.fromkeys(BODY_REGIONS, 1.7))
    alpha: PerRegion = PerRegion(**dict.fromkeys(BODY_REGIONS, 1.0))
    bf: Positive = 8.0
    bft: Positive = 4.0
    bt: Positive = 3.0
    kappa_kpa: Positive = 1000.0
    ring_c_kpa: Positive = 7.45
    plane_c_kpa: Positive = 1000.0

    _spread_regions = field_validator("c_kpa", "alpha", mode="before")(_spread)


class Loads(_Frozen):
    """Cavity pressures at end-diastole and end-systole, and the right veins' springs."""

    edp_mmhg: NonNegative = 8.0
    esp_mmhg: NonNegative = 20.0
    vein_spring_kpa_per_um: NonNegative = 0.001
    transient_mmhg: tuple[tuple[float, float], ...] | None = None

    @field_validator("transient_mmhg")
    @classmethod
    def _increasing(cls, value: tuple[tuple[float, float], ...] | None) -> Any:
        if value is not None:
            times = [t for t, _ in value]
            if len(value) < 2 or any(b <= a for a, b in itertools.pairwise(times)):
                raise ValueError("needs at least two [time, pressure] pairs with increasing times in [0, 1]")
            if not all(0 <= t <= 1 and math.isfinite(p) and p >= 0 for t, p in value):
                raise ValueError("times must lie in [0, 1] (one cycle), pressures be finite and not negative")
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

    k_peri_kpa_per_um: NonNegative = 0.001
    pth: Annotated[float, Field(ge=0, le=1)] = 0.75
    ramp: Positive = 0.2
    outward_only: bool = False

    @property
    def k_peri_kpa_per_mm(self) -> float:
        return self.k_peri_kpa_per_um * KPA_PER_UM_KPA_PER_MM


class MotionSettings(_Frozen):
    """Where the mitral annulus goes: the bundle's own frames, a rigid shift along its axis, or nowhere."""

    annulus: Literal["bundle", "axial", "none"] = "bundle"
    amplitude_mm: NonNegative = 8.0
    es_time: Annotated[float, Field(gt=0, lt=1)] = 0.4
    frames: Annotated[int, Field(ge=4, le=200)] = 10


class Numerics(_Frozen):
    """How it is solved; ``lacli tradeoff`` measures what other choices cost and gain.

    ``unloading``: "prestrain" gives the wall the strain that balances EDP in the image itself; "backward" looks for an unloaded
    shape by backward displacement. ``settle_ed``: where the image's shape is no stable equilibrium, let the wall settle into
    the nearest stable one before the reservoir phase. ``engine``: what assembles and solves: the compiled "plugin", the "script"
    that needs no C++ compiler and gives the same numbers, or "auto", the plugin where it can be built. ``max_newton``: steps
    at one load before it is shortened; generous, since a soft wall that snaps through gets past its fold by going on at the
    load it has, where shorter loads only come to the same fold again.
    """

    order: Literal[1, 2] = 2
    quadrature: Literal[4, 14] = 4
    kappa_points_kpa: NonNegative = 100.0
    unloading: Literal["prestrain", "backward"] = "prestrain"
    settle_ed: bool = False
    engine: Literal["auto", "plugin", "script"] = "auto"
    unloading_volume_tolerance: Annotated[float, Field(gt=0, lt=0.2)] = 0.01
    unloading_max_sweeps: Annotated[int, Field(ge=1, le=100)] = 15
    tolerance_mm: Annotated[float, Field(gt=0, lt=0.1)] = 1e-4
    max_newton: Annotated[int, Field(ge=5, le=5000)] = 600
    timeout_s: Positive = 3600.0


class Outputs(_Frozen):
    """What is written beside the features at end-systole. ``unloaded``: also the wall without pressure, and its volume.
    ``sensitivities``: also the features' derivatives by the study's inputs, at end-systole and in every frame."""

    frames: Annotated[int, Field(ge=0, le=100)] = 0
    conduit: bool = False
    fields: Literal["none", "es", "all"] = "es"
    strain: bool = False
    unloaded: bool = True
    sensitivities: bool = False


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
                "the pressure rises through the reservoir phase"
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
    if not file.is_file():
        raise SceneError(f"{file}: no such scene file.")
    try:
        document = tomllib.loads(file.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise SceneError(f"{file}: not valid TOML: {error}.") from error
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
    if not equals or not all(path):
        raise SceneError(f"--set {text}: write it as key.key=value, for example loads.edp_mmhg=8.")
    try:
        parsed = tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError:
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
    lines = []
    for item in error.errors():
        key = ".".join(str(part) for part in item["loc"]) or "scene"
        if item["type"] == "extra_forbidden":
            known = ", ".join(_known_keys(item["loc"][:-1]))
            lines.append(f"{key}: unknown key; known here: {known}")
        elif item["type"] == "missing":
            lines.append(f"{key}: missing")
        else:
            message = item["msg"].removeprefix("Value error, ")
            given = "" if item["type"] == "value_error" and not item["loc"] else f" (given: {item.get('input')!r})"
            lines.append(f"{key}: {message[:1].lower()}{message[1:]}{given}")
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


# The parameter table: name with unit -> where it lives in a scene, and its range
_LIMITS: dict[str, tuple[float, float]] = {
    **{f"c_{name}_kpa": (0.2, 6.8) for name in BODY_REGIONS},
    **{f"alpha_{name}": (0.125, 4.0) for name in BODY_REGIONS},
    "edp_mmhg": (1.0, 12.0),
    "esp_mmhg": (13.0, 37.0),
    "k_peri_kpa_per_um": (0.0001, 0.005),
    "pth": (0.5, 0.95),
}


def parameter_box(names: list[str] | None = None) -> dict[str, tuple[float, float]]:
    """Ranges of the study's inputs, all 14 or those in ``names`` (UsageError on an unknown one)."""
    if names is None:
        return dict(_LIMITS)
    unknown = [name for name in names if name not in _LIMITS]
    if unknown:
        raise SceneError(f"unknown parameter {unknown[0]!r}; known: {', '.join(_LIMITS)}.")
    return {name: _LIMITS[name] for name in names}


def _address(name: str) -> list[str]:
    if name in ("edp_mmhg", "esp_mmhg"):
        return ["loads", name]
    if name in ("k_peri_kpa_per_um", "pth"):
        return ["pericardium", name]
    if name.startswith("c_") and name.endswith("_kpa"):
        return ["materials", "c_kpa", name[2:-4]]
    return ["materials", "alpha", name.removeprefix("alpha_")]


def with_parameters(scene: Scene, values: Mapping[str, float]) -> Scene:
    """The scene with some of the parameter table's inputs set, validated again."""
    parameter_box(list(values))
    document = scene.model_dump(mode="json", exclude_none=True)
    for name, value in values.items():
        *path, last = _address(name)
        place = document
        for part in path:
            place = place[part]
        place[last] = float(value)
    return build_scene(document, [], folder=Path("/"), where="parameters")
