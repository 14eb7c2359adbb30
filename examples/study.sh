#!/usr/bin/env bash
# A whole study of synthetic patients whose truth is known, from the cohort to the report:
#   bash examples/study.sh [RESULTS_FOLDER [PATIENTS]]
# PATIENTS in each arm: 3, or 10 as in the published study. From the environment: ARMS ("heterogeneous"; all three are
# "heterogeneous control thickness"), CELL_MM (8), ORDER of the cells (1), TARGETS (published; motion: 27, course: 90), SETTINGS
# (study.toml beside this file; two_fidelities.toml with ORDER=2). Three patients take about 6 CPU minutes.
# Started again it goes on where it was.
set -euo pipefail
source "$(dirname "${BASH_SOURCE[0]}")/patients.sh"
begin study 3 "$@"

CELL_MM="${CELL_MM:-8}"
ORDER="${ORDER:-1}"
TARGETS="${TARGETS:-published}"
SETTINGS="${SETTINGS:-$ROOT/examples/study.toml}"
read -r -a ARMS <<<"${ARMS:-heterogeneous}"

for arm in "${ARMS[@]}"; do
  COHORT="$RESULTS/$arm/cohort"
  STUDY="$RESULTS/$arm/study"
  say "$arm: $PATIENTS synthetic patients"
  "$BIN/lacli" synthesize "$COHORT" --cohort "$PATIENTS" --arm "$arm" --targets "$TARGETS" \
    --cell-size-mm "$CELL_MM" --order "$ORDER"
  say "$arm: what will be done, and what it costs"
  "$BIN/lacli" cohort "$COHORT/participants.csv" --out "$STUDY" --settings "$SETTINGS" --dry-run
  say "$arm: the study"
  try "$arm: a patient failed" "$BIN/lacli" cohort "$COHORT/participants.csv" --out "$STUDY" --settings "$SETTINGS"
  if [ "$PATIENTS" -ge 3 ]; then
    say "$arm: statistics"
    try "$arm: no statistics" "$BIN/lacli" stats "$STUDY/regions.csv" --response d_mm --predictor alpha \
      --draws "$STUDY/draws.csv" --out "$STUDY/statistics" --targets "$COHORT/sub-01/targets.toml"
  fi
  say "$arm: truths against posteriors"
  try "$arm: a claim is the wrong way round, or none is done" "$PYTHON" "$ROOT/benchmarks/study.py" "$COHORT" "$STUDY"
  say "$arm: the page"
  "$BIN/lacli" report "$STUDY" --out "$RESULTS/$arm/report.html"
done
finish "pages are $RESULTS/*/report.html"
