#!/usr/bin/env bash
# Installs everything and simulates the embedded synthetic left atrium: bash examples/run.sh [RESULTS_FOLDER]
set -euo pipefail
source "$(dirname "${BASH_SOURCE[0]}")/install.sh"
install_lacli

RESULTS="${1:-$ROOT/results}"
ANATOMY="$RESULTS/synthetic"
mkdir -p "$RESULTS"

"$BIN/lacli" doctor
say "a synthetic left atrium"
"$BIN/lacli" synthesize "$ANATOMY"
say "its simulation: what will be modelled, then the run"
SCENE="$ROOT/examples/scene.toml"
"$BIN/lacli" simulate "$SCENE" --set "anatomy.bundle=$ANATOMY" --dry-run
"$BIN/lacli" simulate "$SCENE" --set "anatomy.bundle=$ANATOMY" --out "$RESULTS/runs"

say "done. Features, transients, fields and pictures of each run:"
for run in "$RESULTS"/runs/*/; do
  printf '   %s\n' "$run"
  for picture in "$run"*.png; do
    if [ -f "$picture" ]; then printf '      %s\n' "$(basename "$picture")"; fi
  done
done
