"""The sections of a scene: anatomy, wall, loads, pericardium, motion, numerics, outputs. Units are converted here and nowhere
else (mm, kPa inside)."""

from __future__ import annotations

import itertools
import math
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationInfo, create_model, field_validator
from pydantic_core import PydanticCustomError

from lacli.contracts.labels import BODY_REGIONS
from lacli.contracts.laws import CONSTANTS, LAWS, MOST_CONSTANTS
from lacli.contracts.parameters import BY_KEY, judge

MMHG_KPA = 0.133322
KPA_PER_UM_KPA_PER_MM = 1000.0

# ways that the annulus as a whole can be wrong: farther along its way, aside (two), tilted (about two axes), wider
ANNULUS_MODES = 6

Number = Annotated[float, Field(allow_inf_nan=False)]


def _default(key: str) -> Any:
    """What the table of parameters says."""
    quantity = BY_KEY[key]
    return int(quantity.default) if quantity.whole else float(quantity.default)


class Section(BaseModel):
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


class PerRegion(Section):
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


class Anatomy(Section):
    """``bundle``: the anatomy's folder, relative to the scene file."""

    bundle: Path = Field(description="folder of the anatomy bundle, relative to the scene file")


class _Wall(Section):
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


class Loads(Section):
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


class Pericardium(Section):
    """Springs along the epicardium's unloaded normal, scaled by smoothstep((xi - (pth - ramp)) / ramp), in full over dents."""

    place = "pericardium"
    k_peri_kpa_per_um: Number = _default("pericardium.k_peri_kpa_per_um")
    pth: Number = _default("pericardium.pth")
    ramp: Number = _default("pericardium.ramp")
    outward_only: bool = Field(default=False, description="whether the springs resist outward motion only")
    dents: bool = Field(
        default=False,
        description="whether springs also hold the outer surface where it is concave in the image: something pressed it in",
    )

    @property
    def k_peri_kpa_per_mm(self) -> float:
        return self.k_peri_kpa_per_um * KPA_PER_UM_KPA_PER_MM


class MotionSettings(Section):
    """Where the mitral annulus goes: the bundle's own frames, a rigid shift along its axis, or nowhere."""

    place = "motion"
    annulus: Literal["bundle", "axial", "none"] = Field(
        default="bundle",
        description="motion of the mitral annulus: the frames of the bundle, a rigid descent along its axis, or none",
    )
    annulus_times: Number = _default("motion.annulus_times")
    annulus_off_mm: tuple[Number, ...] = Field(
        default=(),
        description="errors of the annulus's frames (annulus = bundle), six or none: root mean square lengths (mm) at "
        "end-systole along its way, aside (two), of a tilt (two), of a wider ring; they grow with its displacement",
    )
    amplitude_mm: Number = _default("motion.amplitude_mm")
    es_time: Number = _default("motion.es_time")
    frames: int = _default("motion.frames")

    @field_validator("annulus_off_mm")
    @classmethod
    def _six_or_none(cls, value: tuple[float, ...]) -> tuple[float, ...]:
        if len(value) not in (0, ANNULUS_MODES) or any(abs(one) > 20.0 for one in value):
            raise ValueError("needs six lengths from -20 to 20 mm, or none")
        return value


class Numerics(Section):
    """How it is solved; ``lacli tradeoff`` measures what other choices cost and gain.

    ``unloading``: "prestrain" gives the wall the strain that balances EDP in the image itself; "backward" looks for an unloaded
    shape by backward displacement. ``settle_ed``: where the image's shape is no stable equilibrium, let the wall settle into
    the nearest stable one before the reservoir phase (with "prestrain" and an EDP alone). ``rest_sweeps``: springs are at rest in
    the image less the prestrain's field, or, after as many sweeps of a fixed point, where the wall without pressure relaxes to;
    docs/methods.md tells what this changes. ``engine``: what assembles and solves: the compiled "plugin", the "script"
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
    rest_sweeps: int = _default("numerics.rest_sweeps")
    engine: Literal["auto", "plugin", "script"] = Field(
        default="auto",
        description="what assembles and solves: the compiled plugin, the script without compiler, or whichever can",
    )
    unloading_volume_tolerance: Number = _default("numerics.unloading_volume_tolerance")
    unloading_max_sweeps: int = _default("numerics.unloading_max_sweeps")
    tolerance_mm: Number = _default("numerics.tolerance_mm")
    max_newton: int = _default("numerics.max_newton")
    timeout_s: Number = _default("numerics.timeout_s")


class Outputs(Section):
    """What is written beside the features at end-systole. ``unloaded``: also the wall without pressure, and its volume.
    ``sensitivities``: also the features' derivatives by the study's inputs, at end-systole and in every frame. ``equilibria``:
    end-systole is sought along a second way too; of two the one with less energy is the result, and what differs is told."""

    place = "outputs"
    frames: int = _default("outputs.frames")
    times: tuple[float, ...] = Field(
        default=(), description="times of the frames, shares of the cycle, in place of `frames`; after end-systole, conduit"
    )
    conduit: bool = Field(
        default=False,
        description="whether the conduit phase after end-systole is simulated; not beside `times`, which name it",
    )
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
    equilibria: bool = Field(
        default=False, description="whether end-systole is sought along a second way too, and told what differs between both"
    )

    @field_validator("times")
    @classmethod
    def _rising(cls, value: tuple[float, ...]) -> tuple[float, ...]:
        if len(value) > 100 or any(not 0.0 < t <= 1.0 for t in value) or any(b <= a for a, b in itertools.pairwise(value)):
            raise ValueError("needs rising times above 0, up to 1 (one cycle from end-diastole), 100 at most")
        return value
