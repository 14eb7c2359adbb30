"""Every quantity that a scene holds, once: name, symbol, unit, place, default, and what is possible, plausible, studied.

Scene, box, tables, figures and documentation read from here. A value outside the *possible* range is refused; one outside the
*plausible* range is taken, and said. Both messages name the unit that was likely meant, where the value becomes a usual one
when it is read in that unit.

``QUANTITIES[name]`` is a quantity by its name in tables (``c_roof_kpa``), ``BY_KEY[key]`` by its place in a scene
(``materials.c_kpa.roof``); ``axis_label(name)`` stands on the axes of figures.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Literal

from lacli.base.errors import SceneError
from lacli.contracts.labels import BODY_REGIONS
from lacli.contracts.laws import CONSTANTS

Range = tuple[float, float]


@dataclass(frozen=True)
class Slip:
    """Another unit a number may have been given in; ``factor`` takes a number in it to the quantity's own unit."""

    unit: str
    factor: float


# the units that are taken for each other, by the right one; the commonest first
_SLIPS: dict[str, tuple[Slip, ...]] = {
    "mmHg": (Slip("kPa", 7.50062), Slip("Pa", 0.00750062), Slip("dyn/cm²", 0.000750062), Slip("bar", 750.062)),
    "kPa": (Slip("Pa", 1e-3), Slip("MPa", 1e3), Slip("dyn/cm²", 1e-4)),
    "kPa/µm": (Slip("kPa/mm", 1e-3), Slip("Pa/mm", 1e-6), Slip("Pa/m", 1e-9)),
    "mm": (Slip("µm", 1e-3), Slip("m", 1e3), Slip("cm", 10.0)),
    "s": (Slip("ms", 1e-3), Slip("min", 60.0), Slip("h", 3600.0)),
    "share": (Slip("%", 0.01),),
    "": (),
}


@dataclass(frozen=True)
class Quantity:
    """A number of a scene.

    name: in tables, with its unit; key: its place in the scene; symbol: TeX without dollars; unit: "" for a pure number,
    "share" for one between 0 and 1; possible, plausible, study: closed ranges (``study``: only of the study's inputs); off:
    whether 0 is a choice of its own (the term is left out); log: whether it is best varied by factors; whole: a count.
    """

    name: str
    key: str
    symbol: str
    unit: str
    text: str
    default: float
    possible: Range
    plausible: Range
    study: Range | None = None
    off: bool = False
    log: bool = False
    whole: bool = False

    @property
    def slips(self) -> tuple[Slip, ...]:
        """The units it may have been given in by mistake."""
        return () if self.whole else _SLIPS[self.unit]

    @property
    def shown_unit(self) -> str:
        """The unit as it is written after a value; "" for a pure number or a share."""
        return "" if self.unit == "share" else self.unit

    @property
    def axis_label(self) -> str:
        """Symbol and unit for the axis of a figure: "$C_\\mathrm{roof}$ (kPa)"; "(-)" for a pure number."""
        return f"${self.symbol}$ ({self.shown_unit or '-'})"


def _per_region(
    stem: str, unit: str, key: str, symbol: str, text: str, default: float, *, possible: Range, plausible: Range, study: Range
) -> list[Quantity]:
    ending = f"_{unit.lower()}" if unit else ""
    return [
        Quantity(
            f"{stem}_{region}{ending}", f"{key}.{region}", rf"{symbol}_\mathrm{{{region}}}", unit, f"{text}, {region}", default,
            possible, plausible, study, log=True,
        )
        for region in BODY_REGIONS
    ]  # fmt: skip


_TABLE: tuple[Quantity, ...] = (
    *_per_region(
        "c", "kPa", "materials.c_kpa", "C", "stiffness C of the wall", 1.7,
        possible=(1e-3, 1e3), plausible=(0.02, 60.0), study=(0.2, 6.8),
    ),
    *_per_region(
        "alpha", "", "materials.alpha", r"\alpha", "factor alpha of the exponent of Guccione's law", 1.0,
        possible=(1e-3, 100.0), plausible=(0.05, 10.0), study=(0.125, 4.0),
    ),
    Quantity(
        "edp_mmhg", "loads.edp_mmhg", r"p_\mathrm{ED}", "mmHg",
        "cavity pressure at end-diastole, when the image was taken", 8.0,
        possible=(0.0, 100.0), plausible=(0.5, 35.0), study=(1.0, 12.0), off=True,
    ),
    Quantity(
        "esp_mmhg", "loads.esp_mmhg", r"p_\mathrm{ES}", "mmHg",
        "cavity pressure at end-systole", 20.0,
        possible=(0.0, 200.0), plausible=(5.0, 70.0), study=(13.0, 37.0), off=True,
    ),
    Quantity(
        "k_peri_kpa_per_um", "pericardium.k_peri_kpa_per_um", r"k_\mathrm{peri}", "kPa/µm",
        "stiffness of the pericardium's springs", 0.001,
        possible=(0.0, 10.0), plausible=(1e-6, 0.05), study=(0.0001, 0.005), off=True, log=True,
    ),
    Quantity(
        "pth", "pericardium.pth", r"P_\mathrm{TH}", "share",
        "end of the pericardium on the way from mitral valve (0) to roof (1)", 0.75,
        possible=(0.0, 1.0), plausible=(0.2, 1.0), study=(0.5, 0.95),
    ),
    *(
        Quantity(
            c.name, f"materials.{c.name}", c.symbol, c.unit, c.text, c.default,
            possible=c.possible, plausible=c.plausible, log=c.log,
        )
        for c in CONSTANTS
    ),
    Quantity(
        "kappa_kpa", "materials.kappa_kpa", r"\kappa", "kPa",
        "bulk modulus", 1000.0,
        possible=(0.1, 5e5), plausible=(20.0, 2e5), log=True,
    ),
    Quantity(
        "ring_c_kpa", "materials.ring_c_kpa", r"c_\mathrm{ring}", "kPa",
        "stiffness of the rings of veins and appendage", 7.45,
        possible=(1e-3, 1e5), plausible=(0.1, 500.0), log=True,
    ),
    Quantity(
        "plane_c_kpa", "materials.plane_c_kpa", r"c_\mathrm{plane}", "kPa",
        "stiffness of the mitral annulus and the valve planes", 1000.0,
        possible=(1e-3, 5e5), plausible=(1.0, 1e5), log=True,
    ),
    Quantity(
        "vein_spring_kpa_per_um", "loads.vein_spring_kpa_per_um", r"k_\mathrm{vein}", "kPa/µm",
        "stiffness of the right veins' springs", 0.001,
        possible=(0.0, 10.0), plausible=(1e-6, 0.05), off=True, log=True,
    ),
    Quantity(
        "ramp", "pericardium.ramp", "r", "share",
        "length over which the pericardium sets in, on the way from mitral valve to roof", 0.2,
        possible=(1e-6, 10.0), plausible=(0.01, 1.0),
    ),
    Quantity(
        "amplitude_mm", "motion.amplitude_mm", r"a_\mathrm{MV}", "mm",
        "descent of the mitral annulus (annulus = axial)", 8.0,
        possible=(0.0, 60.0), plausible=(1.0, 25.0), off=True,
    ),
    Quantity(
        "annulus_times", "motion.annulus_times", r"s_\mathrm{MV}", "share",
        "what the displacement of the annulus is multiplied by (annulus = bundle)", 1.0,
        possible=(0.5, 2.0), plausible=(0.7, 1.5),
    ),
    Quantity(
        "es_time", "motion.es_time", r"t_\mathrm{ES}", "share",
        "time of end-systole as a share of the cycle (annulus = bundle: its own counts; axial: the nearest frame)", 0.4,
        possible=(1e-3, 0.999), plausible=(0.15, 0.75),
    ),
    Quantity(
        "kappa_points_kpa", "numerics.kappa_points_kpa", r"\kappa_\mathrm{p}", "kPa",
        "part of the bulk modulus at the quadrature points", 100.0,
        possible=(0.0, 1e5), plausible=(1.0, 1e4), off=True, log=True,
    ),
    Quantity(
        "unloading_volume_tolerance", "numerics.unloading_volume_tolerance", r"\varepsilon_V", "share",
        "volume error at which backward displacement ends", 0.01,
        possible=(1e-8, 0.2), plausible=(1e-5, 0.05), log=True,
    ),
    Quantity(
        "tolerance_mm", "numerics.tolerance_mm", r"\varepsilon_u", "mm",
        "displacement error at which Newton's method ends", 1e-4,
        possible=(1e-12, 0.1), plausible=(1e-7, 0.01), log=True,
    ),
    Quantity(
        "timeout_s", "numerics.timeout_s", r"t_\mathrm{max}", "s",
        "time after which a simulation is given up", 3600.0,
        possible=(1e-3, 1e8), plausible=(20.0, 1e6), log=True,
    ),
    Quantity(
        "max_newton", "numerics.max_newton", r"n_\mathrm{Newton}", "",
        "Newton steps at one load at most", 600,
        possible=(5, 5000), plausible=(15, 5000), whole=True,
    ),
    Quantity(
        "unloading_max_sweeps", "numerics.unloading_max_sweeps", r"n_\mathrm{sweep}", "",
        "sweeps of backward displacement at most", 15,
        possible=(1, 100), plausible=(3, 100), whole=True,
    ),
    Quantity(
        "rest_sweeps", "numerics.rest_sweeps", r"n_\mathrm{rest}", "",
        "sweeps that put springs at rest where the wall relaxes to without pressure", 0,
        possible=(0, 20), plausible=(0, 5), whole=True,
    ),
    Quantity(
        "annulus_frames", "motion.frames", r"n_\mathrm{frame}", "",
        "frames of the annulus' axial motion", 10,
        possible=(4, 200), plausible=(4, 200), whole=True,
    ),
    Quantity(
        "output_frames", "outputs.frames", r"n_\mathrm{out}", "",
        "frames written", 0,
        possible=(0, 100), plausible=(0, 100), whole=True,
    ),
)  # fmt: skip

QUANTITIES: dict[str, Quantity] = {q.name: q for q in _TABLE}
BY_KEY: dict[str, Quantity] = {q.key: q for q in _TABLE}
STUDY: tuple[str, ...] = tuple(q.name for q in _TABLE if q.study)


def parameter_box(names: list[str] | None = None) -> dict[str, Range]:
    """Ranges of the study's inputs, all 14 or those in ``names``. Raises SceneError on an unknown one."""
    study = {name: study for name in STUDY if (study := QUANTITIES[name].study)}
    if names is None:
        return study
    unknown = [name for name in names if name not in study]
    if unknown:
        raise SceneError(f"unknown parameter {unknown[0]!r}; known: {', '.join(study)}.")
    return {name: study[name] for name in names}


def axis_label(name: str) -> str:
    """Symbol and unit of a quantity for the axis of a figure; the name itself where the table does not know it."""
    return QUANTITIES[name].axis_label if name in QUANTITIES else name


def judge(quantity: Quantity, value: float) -> tuple[Literal["fine", "odd", "impossible"], str]:
    """Whether a finite value is within the plausible and the possible range, and what is to be said where it is not.

    The words follow the value's name: "800 mmHg is not possible (allowed: 0 to 200 mmHg); Pa for mmHg? 800 Pa are 6 mmHg".
    """
    unit = f" {quantity.shown_unit}" if quantity.shown_unit else ""
    low, high = quantity.possible
    if not low <= value <= high:
        return (
            "impossible",
            f"{_number(value)}{unit} is not possible (allowed: {low:g} to {high:g}{unit}){meant(quantity, value)}",
        )
    low, high = quantity.plausible
    if low <= value <= high or (quantity.off and value == 0):
        return "fine", ""
    return "odd", f"{_number(value)}{unit} is unusual (plausible: {low:g} to {high:g}{unit}){meant(quantity, value)}"


def meant(quantity: Quantity, value: float) -> str:
    """The units in which this number would be a plausible value, as the end of a sentence; empty where there is none."""
    low, high = quantity.plausible
    fitting = [slip for slip in quantity.slips if low <= value * slip.factor <= high]
    if not fitting:
        return ""
    own = f" {quantity.shown_unit}" if quantity.shown_unit else ""
    units = " or ".join(slip.unit for slip in fitting)
    verb = "is" if value == 1 else "are"
    read = ", ".join(f"{_number(value)} {slip.unit} {verb} {value * slip.factor:.3g}{own}" for slip in fitting)
    return f"; {f'{units} for{own}' if own else f'given in {units}'}? {read}"


def _number(value: float) -> str:
    """Four digits, more where these would be another value (a bound, say)."""
    return next(text for digits in itertools.count(4) if abs(float(text := f"{value:.{digits}g}") - value) <= 1e-5 * abs(value))
