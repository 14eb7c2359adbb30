"""What files of lacli hold, field by field: key, unit, meaning. Pages take their tables from here; tests compare with files."""

from __future__ import annotations

from dataclasses import dataclass

from lacli.contracts.labels import REGIONS
from lacli.contracts.tables.columns import ERROR_SUFFIX, SPREAD_SUFFIX, STATUS


@dataclass(frozen=True)
class Field:
    """A field of a file: ``key`` as it stands there (``<...>``: a name), ``unit`` ("" for none), ``text``, and whether it is
    always there."""

    key: str
    unit: str
    text: str
    always: bool = True


# features.json, beside the features of lacli.contracts.features at end-systole
RUN: tuple[Field, ...] = (
    Field("unloaded_volume_ml", "mL", "cavity without pressure; null where not sought or not found"),
    Field("ed_volume_error", "", "end-diastolic volume against the image's, a share"),
    Field("ed_shape_error_mean_mm", "mm", "distance of the end-diastolic wall from the image, mean"),
    Field("ed_shape_error_p95_mm", "mm", "the same, exceeded by 5 % of the points"),
    Field("ed_unstable_modes", "", "ways out of an end-diastolic equilibrium that is not stable", always=False),
    Field("es_unstable_modes", "", "the same at end-systole"),
    Field("unstable_frames", "", "the same of other frames that have any, by time; with `outputs.sensitivities`", always=False),
    Field("unloading_iterations", "", "iterations to the state at end-diastole", always=False),
    Field("rest_move_mean_mm", "mm", "how far the last of `numerics.rest_sweeps` moved the springs' rest, mean", always=False),
    Field("rest_move_max_mm", "mm", "the same, at most", always=False),
    Field("min_jacobian", "", "smallest volume ratio of the loaded states"),
    Field("unknowns", "", "unknowns of a linear system, displacements and pressures"),
    Field("newton_iterations", "", "solutions of a linear system"),
    Field("load_steps", "", "load steps"),
    Field("steps_back", "", "load steps that failed and were tried again, smaller"),
    Field("factorisations", "", "factorised matrices, those of stability checks and derivatives among them"),
    Field("cpu_s", "s", "CPU time of FreeFEM"),
    Field("peak_memory_mb", "MB", "largest memory of FreeFEM"),
    *(
        Field(f"{what}_{region}", "", f"{text}, {region}; with `outputs.strain`", always=False)
        for what, text in (
            ("fibre_stretch", "length along the fibre against end-diastole, minus 1, mean over the wall"),
            ("thickness_change", "thickness against end-diastole, minus 1, mean over the wall"),
        )
        for region in REGIONS
    ),
    Field("sensitivities", "", "whether `sensitivities.csv` is there, by state; with `outputs.sensitivities`", always=False),
    Field(
        "equilibria",
        "",
        "states `found` along two ways to end-systole (0: the second ends nowhere), the way whose state is `kept`, "
        "`energy_above_uj` of the other (uJ), `farthest_mm` between nodes of both; with `outputs.equilibria`",
        always=False,
    ),
    Field("equilibria_spread", "as the feature", "difference of both by feature, 0 where they are one", always=False),
    Field(
        "discretisation_error", "as the feature", "errors by feature (one standard deviation); in `--json` alone", always=False
    ),
    Field("discretisation_error_source", "", "of each: `measured` by `lacli tradeoff`, or by the `model`", always=False),
)

MANIFEST: tuple[Field, ...] = (
    Field("key", "", "key of the content: scene, bundle, solver, version; the folder's name"),
    Field("status", "", "`done` or `failed`"),
    Field("kind", "", "kind of failure; null where done"),
    Field("message", "", "what was said of it"),
    Field("started", "", "date and time, UTC"),
    Field("finished", "", "date and time, UTC"),
    Field("wall_s", "s", "time between them"),
    Field("cpu_s", "s", "CPU time of FreeFEM"),
    Field("peak_memory_mb", "MB", "largest memory of FreeFEM"),
    Field("engine", "", "what evaluated the laws: compiled kernels or FreeFEM's own language"),
    Field("newton_iterations", "", "solutions of a linear system; of a run that is done", always=False),
    Field("sensitivities", "", "as in `features.json`", always=False),
    Field("equilibria", "", "as in `features.json`", always=False),
    Field(
        "start",
        "",
        "`way` `warm` or `cold`, and the run started `from`, how far, what of it was accepted; with `--warm`",
        always=False,
    ),
    Field("machine", "", "system and number of processors"),
    Field("products", "bytes", "size of each file that makes the run complete"),
    Field("sha256", "", "digest of each of them"),
    Field("versions", "", "of lacli, python, numpy, freefem"),
)

# tables of runs, beside inputs and outputs; what `design` and `calibrate` write, and any table may have
TABLE: tuple[Field, ...] = (
    Field(
        STATUS,
        "",
        "`done` (or `ok`, `success`, `converged`, ...); `failed` (or `error`, `diverged`, `timeout`, ...); of runs that never "
        "finished (`killed`, `pending`, `running`, `cancelled`, ...), which are left out; an empty cell, or any other word, is "
        "refused with the words that are known",
    ),
    Field("kind", "", "kind of failure"),
    Field("message", "", "what was said of it", always=False),
    Field("cpu_s", "s", "cost"),
    Field("peak_memory_mb", "MB", "cost"),
    Field("attempts", "", "how often the machine ended the run", always=False),
    Field(f"<output>{ERROR_SUFFIX}", "as the output", "one standard deviation, where known", always=False),
    Field(
        f"<output>{SPREAD_SUFFIX}",
        "as the output",
        "of two equilibria of the run; half of it is in the error; with `outputs.equilibria`",
        always=False,
    ),
    Field("d<output>/d<input>", "the output's over the input's", "derivative at the run; empty where unknown", always=False),
)

TARGET: tuple[Field, ...] = (
    Field("mean", "the feature's", "finite number"),
    Field("sd", "the feature's", "standard deviation, positive"),
    Field("unit", "", "for people", always=False),
    Field("source", "", "for people", always=False),
)
