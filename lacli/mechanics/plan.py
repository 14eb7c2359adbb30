"""What of a scene is modelled: only the terms it asks for, and why."""

from __future__ import annotations

import itertools

import numpy as np

from lacli.base.errors import AnatomyError
from lacli.contracts import bundle as bundles
from lacli.contracts.bundle import Bundle
from lacli.contracts.case import Case, Phase, Plan
from lacli.contracts.features import SAME_TIME
from lacli.contracts.identity import run_key
from lacli.contracts.labels import EPI, REGIONS, RINGS, is_body
from lacli.contracts.laws import LAWS
from lacli.contracts.motion import Motion
from lacli.contracts.scene import Scene
from lacli.contracts.sections import MMHG_KPA, Outputs
from lacli.mechanics.pressure import Pressure, pressure_of
from lacli.motion.annulus import asked_motion

_PARTS = 4  # of the second way to end-systole: that many find what two, three, eight or a way back do not (docs/methods.md)


def prepare(scene: Scene) -> Case:
    """The scene with its bundle, motion and plan, read and checked. Raises AnatomyError, InputError."""
    whole = bundles.load(scene.anatomy.bundle)
    bundle = bundles.as_order(whole, scene.numerics.order)
    motion = asked_motion(scene.motion, whole, scene.anatomy.bundle)
    if motion is not None and bundle.order != whole.order:
        motion = motion.of_points(np.unique(whole.tets[:, :4]))
    return Case(scene, bundle, motion, make_plan(scene, bundle, motion), run_key(scene))


def make_plan(scene: Scene, bundle: Bundle, motion: Motion | None) -> Plan:
    """Decide what is modelled. Raises AnatomyError where the bundle lacks what the scene asks for."""
    where = scene.anatomy.bundle
    if not (bundle.tags == RINGS["mv"]).any():
        raise AnatomyError(
            f"{where}: no boundary triangle has tag {RINGS['mv']}, the mitral ring; nothing would hold the atrium."
        )
    if not is_body(bundle.region).any():
        raise AnatomyError(f"{where}: no cell has a region of the body ({', '.join(REGIONS)}).")
    veins = scene.loads.vein_spring_kpa_per_um > 0
    if veins and not np.isin(bundle.tags, [RINGS["rspv"], RINGS["ripv"]]).any():
        raise AnatomyError(
            f"{where}: the scene has springs on the right veins, but no boundary triangle has tag {RINGS['rspv']} or "
            f"{RINGS['ripv']}. Set loads.vein_spring_kpa_per_um to 0, or tag them."
        )
    pericardium = scene.pericardium.k_peri_kpa_per_um > 0
    if pericardium and (bundle.pericardium_coordinate is None or not (bundle.tags == EPI).any()):
        raise AnatomyError(
            f"{where}: the scene has a pericardium, but the bundle has no 'pericardium_coordinate' or no epicardium (tag {EPI}). "
            "Set pericardium.k_peri_kpa_per_um to 0, or mesh again."
        )
    moving = motion is not None
    backward = scene.loads.edp_mmhg > 0 and scene.numerics.unloading == "backward"
    strained = scene.loads.edp_mmhg > 0 and not backward
    rest_sweeps = scene.numerics.rest_sweeps if strained and (veins or pericardium) else 0
    pressure = pressure_of(scene.loads, scene.motion.es_time, motion)
    title = [f"pressure {scene.loads.edp_mmhg:g} to {pressure.at_es_kpa / MMHG_KPA:g} mmHg", LAWS[scene.materials.law].title]
    title += ["annulus moves"] if moving else ["ring held"]
    title += ["vein springs"] if veins else []
    title += ["pericardium"] if pericardium else []
    return Plan(
        title=", ".join(title),
        unloading=scene.loads.edp_mmhg > 0,
        prestrain=strained,
        unloaded=strained and scene.outputs.unloaded,
        moving=moving,
        vein_springs=veins,
        pericardium=pericardium,
        outward_only=scene.pericardium.outward_only,
        dents=scene.pericardium.dents,
        sensitivities=scene.outputs.sensitivities and not backward and not rest_sweeps,
        rest_sweeps=rest_sweeps,
        phases=_phases(pressure, scene.outputs),
        second=_second(pressure) if scene.outputs.equilibria else (),
    )


def _phases(pressure: Pressure, outputs: Outputs) -> tuple[Phase, ...]:
    """The load, end-systole from end-diastole at once, the states between them from end-systole backward, later ones forward.

    So end-systole is the same whatever frames are asked for, and they are of its branch: a wall that is soft in bending gives way
    in places on its way up, one after the other, and may end elsewhere.
    """
    es, loads = pressure.es, pressure.loads
    count = max(1, outputs.frames)
    times = list(np.linspace(0.0, es, count + 1))
    if outputs.times:
        # a time as near to end-systole as names can tell is end-systole
        given = [t for t in outputs.times if abs(t - es) > SAME_TIME]
        times = sorted([0.0, es, *given])
    elif outputs.conduit:
        times += list(np.linspace(es, 1.0, max(4, count) + 1)[1:])
    file = {float(t): "es" if abs(t - es) < 1e-12 else f"frame{index:03d}" for index, t in enumerate(times)} | {0.0: "ed"}
    at_es = next(t for t, name in file.items() if name == "es")
    before = [t for t in file if 0.0 < t < at_es]
    after = [t for t in file if t > at_es]
    ways = [(0.0, at_es), *itertools.pairwise([at_es, *reversed(before)]), *itertools.pairwise([at_es, *after])]
    phases = [Phase("load", "", "ed", 0.0, loads.edp_kpa, 0.0, 0.0, 1.0, 0.0)] if loads.edp_mmhg > 0 else []
    for start, end in ways:
        by_edp, by_esp = pressure.shares(end)
        phases.append(
            Phase(
                name="reservoir" if end <= at_es else "conduit",
                start=file[start],
                file=file[end],
                pressure_from=pressure.kpa(start),
                pressure_to=pressure.kpa(end),
                time_from=start,
                time_to=end,
                by_edp=by_edp,
                by_esp=by_esp,
            )
        )
    return tuple(phases)


def _second(pressure: Pressure) -> tuple[Phase, ...]:
    """From end-diastole up to end-systole in equal parts, each from an equilibrium of its own.

    Where a wall gives way in places, one after the other, parts of the load find another order than all of it at once.
    """
    way = itertools.pairwise(np.linspace(0.0, pressure.es, _PARTS + 1).tolist())
    return tuple(Phase("second", "", "", pressure.kpa(a), pressure.kpa(b), a, b, *pressure.shares(b)) for a, b in way)


def _lacking(scene: Scene) -> str:
    """What keeps a scene's run from telling sensitivities."""
    if scene.numerics.unloading == "prestrain":
        return "springs at rest where the wall relaxes; set numerics.rest_sweeps to 0"
    return "backward displacement; set numerics.unloading to prestrain"


_METHODS = {"prestrain": "the wall's strain in the image", "backward": "backward displacement"}


def describe(scene: Scene, bundle: Bundle) -> list[tuple[str, bool, str]]:
    """(term, included, why) of every term that a scene can have."""
    motion = asked_motion(scene.motion, bundle, scene.anatomy.bundle)
    plan = make_plan(scene, bundle, motion)
    materials, loads = scene.materials, scene.loads
    regional = not (materials.c_kpa.uniform and materials.alpha.uniform)
    return [
        ("wall", True, f"{LAWS[materials.law].title}, P{scene.numerics.order} displacements, P1 pressure"),
        ("regional stiffness", regional, "the regions differ" if regional else "one stiffness everywhere"),
        (
            "unloading",
            plan.unloading,
            f"EDP is {loads.edp_mmhg:g} mmHg, by {_METHODS[scene.numerics.unloading]}"
            if plan.unloading
            else "EDP is 0: the image is unloaded",
        ),
        ("unloaded state", plan.unloaded or (plan.unloading and not plan.prestrain), "outputs.unloaded"),
        ("settled end-diastole", plan.prestrain and scene.numerics.settle_ed, "numerics.settle_ed"),
        ("springs where the wall relaxes", plan.rest_sweeps > 0, f"numerics.rest_sweeps is {scene.numerics.rest_sweeps}"),
        ("mitral motion", plan.moving, f"motion.annulus is {scene.motion.annulus!r}"),
        ("vein springs", plan.vein_springs, f"{loads.vein_spring_kpa_per_um:g} kPa/um on the right veins"),
        (
            "pericardium",
            plan.pericardium,
            f"{scene.pericardium.k_peri_kpa_per_um:g} kPa/um, PTH {scene.pericardium.pth:g}",
        ),
        ("outward only", plan.pericardium and plan.outward_only, "pericardium.outward_only"),
        ("dents held", plan.pericardium and plan.dents, "pericardium.dents"),
        (
            "transient",
            scene.outputs.frames > 1 or bool(scene.outputs.times),
            f"outputs.times has {len(scene.outputs.times)}"
            if scene.outputs.times
            else f"outputs.frames is {scene.outputs.frames}",
        ),
        (
            "conduit",
            any(phase.name == "conduit" for phase in plan.phases),
            "outputs.times" if scene.outputs.times else "outputs.conduit",
        ),
        ("second way to end-systole", bool(plan.second), "outputs.equilibria"),
        (
            "sensitivities",
            plan.sensitivities,
            "outputs.sensitivities" if plan.sensitivities or not scene.outputs.sensitivities else f"none with {_lacking(scene)}",
        ),
    ]
