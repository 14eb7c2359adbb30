"""The page of one simulation, from its folder."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lacli.base.documents import read_json
from lacli.base.errors import AnatomyError, InputError
from lacli.contracts import bundle as bundles
from lacli.contracts.features import KEYS, PUBLISHED
from lacli.contracts.identity import run_key
from lacli.contracts.labels import BODY_REGIONS
from lacli.contracts.scene import Scene, load_scene
from lacli.mechanics.numerics import equilibria, stability
from lacli.mechanics.numerics.equilibria import SPREAD
from lacli.mechanics.numerics.stated import with_errors
from lacli.report.page import methods
from lacli.report.page.document import Figure, Page, Section, Table, number, picture
from lacli.report.page.references import bibtex
from lacli.report.page.shape import OtherAnatomyError, atrium

if TYPE_CHECKING:
    from lacli.base.arrays import FloatArray

Thickness = tuple["FloatArray", "FloatArray"]
_COSTS = {
    "wall_s": "wall time, s", "cpu_s": "CPU time, s", "peak_memory_mb": "peak memory, MB", "newton_iterations": "Newton steps",
}  # fmt: skip
_ERRORS = {
    "ed_volume_error": "ED volume against the image, share",
    "ed_shape_error_mean_mm": "ED shape against the image, mean, mm",
    "ed_shape_error_p95_mm": "ED shape against the image, 95th percentile, mm",
    "ed_unstable_modes": "unstable modes at ED",
    "es_unstable_modes": "unstable modes at ES",
    "min_jacobian": "smallest volume ratio",
}


@dataclass(frozen=True)
class Run:
    """A finished run's folder as it was read; ``changed``: in words, that its bundle is no longer what it was made of."""

    folder: Path
    scene: Scene
    features: Mapping[str, Any]
    manifest: Mapping[str, Any]
    changed: str = ""


def read_run(folder: Path) -> Run:
    """The run. Raises InputError where the folder is none, or its run did not finish."""
    if not (folder / "manifest.json").is_file():
        raise InputError(f"{folder}: no run: there is no manifest.json. Give the folder of one run, RUNS/<key>.")
    manifest = read_json(folder / "manifest.json")
    if not isinstance(manifest, dict) or manifest.get("status") != "done":
        why = manifest.get("message") or manifest.get("kind") if isinstance(manifest, dict) else "its manifest is damaged"
        raise InputError(f"{folder}: this run has no result ({why}).")
    features = read_json(folder / "features.json")
    if not isinstance(features, dict):
        raise InputError(f"{folder / 'features.json'}: not a table of features.")
    scene = load_scene(folder / "scene.toml")
    if changed := changed_since(scene, manifest):
        return Run(folder, scene, features, manifest, changed)
    with contextlib.suppress(AnatomyError):  # the bundle is gone: the page says that no error is known
        features = with_errors(scene, bundles.load(scene.anatomy.bundle), features)
    return Run(folder, scene, features, manifest)


def changed_since(scene: Scene, manifest: object) -> str:
    """In words, that a run's key is not that of its scene and bundle as they are now; '' where it is, or the bundle is gone.

    What is read from the bundle would be another one's beside the run's features.
    """
    try:
        same = isinstance(manifest, dict) and run_key(scene) == manifest.get("key")
    except AnatomyError:
        return ""
    where = scene.anatomy.bundle
    return "" if same else f"scene.toml, the bundle {where} or lacli's solver are no longer what this run was made of."


def run_page(folder: Path, pictures: Path, thickness: Thickness | None, note: str = "") -> Page:
    """The page. pictures: a folder where PDF and SVG of the figures are put too. thickness: of the end-diastolic endocardium
    (points, mm); ``note`` says why there is none. Raises InputError."""
    run = read_run(folder)
    text, keys = methods.of_run(run.scene, run.manifest.get("versions") or {})
    sections = [
        shape_section(run, thickness, note, {}),
        transients_section(run, pictures),
        Section("features", "Features at end-systole", tables=(_features(run),)),
        Section(
            "errors", "Errors and costs", warnings=_doubts(run), tables=(_rows("Errors", _ERRORS, run.features), _costs(run))
        ),
        closing(text, keys, run.manifest),
    ]
    lead = f"Run {run.manifest.get('key', folder.name)}, finished {run.manifest.get('finished', '')}."
    return Page("Simulation of a left atrium", lead, tuple(sections))


def shape_section(
    run: Run, thickness: Thickness | None, note: str, more: Mapping[str, tuple[str, Mapping[str, float]]]
) -> Section:
    """The anatomy in 3D: region, displacement, thickness, stiffness, and further values by region (title -> unit, values)."""
    materials = run.scene.materials
    regional: dict[str, tuple[str, Mapping[str, float]]] = {}
    laws: dict[str, tuple[str, Any]] = {"stiffness C of this run": ("kPa", materials.c_kpa)}
    if materials.law == "guccione":
        laws["stiffness alpha of this run"] = ("", materials.alpha)
    for title, (unit, values) in laws.items():
        regional[title] = (unit, {name: float(getattr(values, name)) for name in BODY_REGIONS})
    es = run.folder / "fields" / "es.vtu"
    if not es.is_file():
        return Section("anatomy", "Anatomy", ("This run kept no fields (outputs.fields = none): no 3D.",))
    said = (note,) if note else ()
    try:
        view = atrium(es, thickness, {**regional, **more})
    except OtherAnatomyError as error:
        said = (str(error),)
        view = atrium(es, None, {**regional, **more})
    if view is None:
        return Section("anatomy", "Anatomy", (*said, "The surface has more than 300,000 triangles: not drawn here."))
    return Section("anatomy", "Anatomy", said, atrium=view)


def transients_section(run: Run, pictures: Path) -> Section:
    """Pressure, volume and displacements against time."""
    table = run.folder / "transients.csv"
    if not table.is_file():
        return Section("transients", "Transients", ("This run has no transients.csv.",))
    from lacli.report.simulation_figures import transient_figure

    for suffix in ("png", "pdf", "svg"):
        transient_figure(table, pictures / f"transients.{suffix}")
    caption = "Pressure, volume and mean displacement of the regions from end-diastole (ED); the dashed line is end-systole (ES)."
    return Section("transients", "Transients", figures=(picture(pictures / "transients.png", caption),))


def closing(text: str, keys: list[str], manifest: Mapping[str, Any]) -> Section:
    """Provenance, methods with citations, BibTeX."""
    versions = manifest.get("versions") or {}
    rows = [(name, str(value)) for name, value in versions.items()]
    rows += [(name, str(manifest[name])) for name in ("key", "started", "finished", "engine") if manifest.get(name)]
    machine = manifest.get("machine") or {}
    rows += [(name, str(value)) for name, value in machine.items()]
    cited = bibtex(keys, str(versions.get("lacli", "")))
    table = Table("Provenance", ("what", "value"), tuple(rows))
    return Section("methods", "Methods and provenance", text=(text,), tables=(table,), verbatim=(cited,))


def kept_pictures(folder: Path, named: Mapping[str, str]) -> tuple[Figure, ...]:
    """The pictures that are in the folder, of file name -> caption."""
    return tuple(picture(folder / name, caption) for name, caption in named.items() if (folder / name).is_file())


def _features(run: Run) -> Table:
    errors = run.features.get("discretisation_error") or {}
    sources = run.features.get("discretisation_error_source") or {}
    spread = run.features.get(SPREAD)
    columns = ("feature", "value", "discretisation error, sd", *(() if spread is None else ("between equilibria",)), "unit")
    rows = [
        (
            KEYS[key].definition,
            number(run.features.get(key)),
            _stated(errors.get(key), sources.get(key, "")),
            *(() if spread is None else (number(spread.get(key)),)),
            KEYS[key].unit,
        )
        for key in ("edv_ml", *PUBLISHED)
        if key in run.features
    ]
    return Table("Features", columns, tuple(rows))


def _stated(error: float | None, source: str) -> str:
    """An error, and where it comes from."""
    return f"{number(error)} ({source})" if error is not None else ""


def _rows(title: str, named: Mapping[str, str], values: Mapping[str, Any]) -> Table:
    return Table(
        title, ("what", "value"), tuple((words, number(values.get(key))) for key, words in named.items() if key in values)
    )


def _costs(run: Run) -> Table:
    return _rows("Costs", _COSTS, {**run.features, **run.manifest})


def _doubts(run: Run) -> tuple[str, ...]:
    said = []
    if run.changed:
        said.append(f"No discretisation error is shown: {run.changed} Simulate the scene anew.")
    elif not run.features.get("discretisation_error"):
        said.append(f"No discretisation error is known: the bundle {run.scene.anatomy.bundle} cannot be read any more.")
    said += [words for of in (equilibria, stability) if (words := of.said_of(run.features))]
    return tuple(said)
