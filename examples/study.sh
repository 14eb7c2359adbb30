#!/usr/bin/env bash
# A whole study of synthetic patients whose truth is known, from the cohort to the report: bash examples/study.sh [RESULTS_FOLDER]
# From the environment: PATIENTS (3) in each arm, ARMS ("heterogeneous control thickness"), CELL_MM (8), SETTINGS (study.toml).
# Started again it goes on where it was.
set -euo pipefail
source "$(dirname "${BASH_SOURCE[0]}")/install.sh"
install_lacli

RESULTS="${1:-$ROOT/results/study}"
PATIENTS="${PATIENTS:-3}"
CELL_MM="${CELL_MM:-8}"
SETTINGS="${SETTINGS:-$ROOT/examples/study.toml}"
read -r -a ARMS <<<"${ARMS:-heterogeneous control thickness}"
mkdir -p "$RESULTS"

for arm in "${ARMS[@]}"; do
  COHORT="$RESULTS/$arm/cohort"
  STUDY="$RESULTS/$arm/study"
  say "$arm: $PATIENTS synthetic patients"
  "$BIN/lacli" synthesize "$COHORT" --cohort "$PATIENTS" --arm "$arm" --cell-size-mm "$CELL_MM" --order 1
  say "$arm: what will be done, and what it costs"
  "$BIN/lacli" cohort "$COHORT/participants.csv" --out "$STUDY" --settings "$SETTINGS" --dry-run
  say "$arm: the study"
  "$BIN/lacli" cohort "$COHORT/participants.csv" --out "$STUDY" --settings "$SETTINGS"
  if [ "$PATIENTS" -ge 3 ]; then
    say "$arm: statistics"
    "$BIN/lacli" stats "$STUDY/regions.csv" --response d_mm --predictor alpha --out "$STUDY/statistics" \
      --targets "$COHORT/sub-01/targets.toml"
  fi
  say "$arm: truths against posteriors"
  "$PYTHON" "$ROOT/benchmarks/study.py" "$COHORT" "$STUDY"
  say "$arm: the page"
  "$BIN/lacli" report "$STUDY" --out "$RESULTS/$arm/report.html"
done
say "done: pages are $RESULTS/*/report.html"
