#!/usr/bin/env bash
# A study from gated images to the report, of synthetic patients whose motion and stiffness are known:
#   bash examples/gated.sh [RESULTS_FOLDER [PATIENTS]]
# Each patient has a label map and a CT of end-diastole and gated frames of a whole cycle, and what is known of its pressures and
# pericardium: the ranges that these are drawn from. The study meshes, measures fat, tracks, calibrates and compares. PATIENTS: 2, or
# 10 as in the published study. From the environment: VOXEL_MM (1.5), of the images; FRAMES (10); SETTINGS and SCENE (gated.toml and gated_scene.toml beside this file).
# Started again it goes on where it was.
set -euo pipefail
source "$(dirname "${BASH_SOURCE[0]}")/patients.sh"
begin gated 2 "$@"

VOXEL_MM="${VOXEL_MM:-1.5}"
FRAMES="${FRAMES:-10}"
SETTINGS="${SETTINGS:-$ROOT/examples/gated.toml}"
SCENE="${SCENE:-$ROOT/examples/gated_scene.toml}"
COHORT="$RESULTS/cohort"
STUDY="$RESULTS/study"
mkdir -p "$COHORT"

say "$PATIENTS synthetic patients: label map and CT, gated frames, their truth"
rows="participant_id,arm,labels,ct,images,priors"
for ((seed = 1; seed <= PATIENTS; seed++)); do
  name="$(printf 'sub-%02d' "$seed")"
  "$BIN/lacli" synthesize "$COHORT/$name/still" --seed "$seed" --image --voxel-mm "$VOXEL_MM"
  "$BIN/lacli" synthesize "$COHORT/$name/gated" --seed "$seed" --gated --voxel-mm "$VOXEL_MM" --frames "$FRAMES"
  rows+=$'\n'"$name,heterogeneous,$name/still/labels.nrrd,$name/still/ct.nrrd,$name/gated/frames,priors.toml"
done
printf '%s\n' "$rows" >"$COHORT/participants.csv"
# what the benchmark holds the posteriors against, and what is known of the loads as if they had been measured
"$PYTHON" - "$COHORT" <<'PY'
import json
import sys
from pathlib import Path

import pandas as pd
import tomli_w

from lacli.contracts.priors import prior_tables
from lacli.synthetic.cohort import load_priors

known = {"priors": prior_tables(load_priors())}
(Path(sys.argv[1]) / "priors.toml").write_text(tomli_w.dumps(known))
found = sorted(Path(sys.argv[1]).glob("sub-*/gated/truth/parameters.json"))
rows = [{"participant_id": file.parts[-4], **json.loads(file.read_text())} for file in found]
pd.DataFrame(rows).to_csv(Path(sys.argv[1]) / "truths.csv", index=False)
PY

say "what will be done, and what it costs"
"$BIN/lacli" cohort "$COHORT/participants.csv" --out "$STUDY" --scene "$SCENE" --settings "$SETTINGS" --dry-run
say "the study"
try "a patient failed" "$BIN/lacli" cohort "$COHORT/participants.csv" --out "$STUDY" --scene "$SCENE" --settings "$SETTINGS"
say "truths against posteriors"
try "a claim is the wrong way round, or none is done" "$PYTHON" "$ROOT/benchmarks/study.py" "$COHORT" "$STUDY"
say "the page"
"$BIN/lacli" report "$STUDY" --out "$RESULTS/report.html"
finish "$RESULTS/report.html"
