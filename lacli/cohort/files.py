"""The names of a study's own files, which stand beside its patients' folders."""

from __future__ import annotations

PATIENTS, REGIONS, DRAWS, MODELS, SUMMARY = "patients.csv", "regions.csv", "draws.csv", "models.csv", "summary.json"
FEATURES, WAVES, CONTRASTS, ANATOMIES = "features.csv", "waves.csv", "contrasts.csv", "anatomies.csv"
COURSES, FRAMES, DISCRETISATION = "courses.csv", "frames.csv", "discretisation.csv"
OUTPUTS, INFLUENCES, SCORES, CONVERGENCE = "emulators.csv", "influences.csv", "scores.csv", "convergence.csv"
TRANSIENTS, MISFITS, WALLS = "transients.csv", "misfits.csv", "walls.csv"
TABLES = (
    PATIENTS, REGIONS, DRAWS, MODELS, FEATURES, WAVES, CONTRASTS, ANATOMIES, COURSES, FRAMES, DISCRETISATION, OUTPUTS, INFLUENCES,
    SCORES, CONVERGENCE, TRANSIENTS, MISFITS, WALLS,
)  # fmt: skip
STATE = ("status", "step", "reason", "cpu_s", "warnings")  # columns of the table of patients that are the study's own
SLURM = "slurm"  # folder of what SLURM's jobs say
OWN = (*TABLES, SUMMARY, SLURM)  # no participant can have such a name: the folder would stand where the study writes
