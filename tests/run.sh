#!/usr/bin/env bash
# Installs everything, then style, types and tests: bash tests/run.sh [PYTEST_ARGUMENTS]
set -euo pipefail
source "$(dirname "${BASH_SOURCE[0]}")/../examples/install.sh"
install_test_packages
install_lacli test,cluster
cd "$ROOT"

say "ruff"
"$BIN/ruff" check .
"$BIN/ruff" format --check .
say "mypy"
"$BIN/mypy"
say "order of the rooms"
"$BIN/lint-imports"
say "pytest"
# the installed package is tested, not the checkout: pytest must not put the root on the path
"$BIN/pytest" -n 2 "$@"
