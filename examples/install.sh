# Sourced by examples and tests/run.sh: system packages, virtual environment .venv, lacli.
# Does nothing twice: what is there is kept. After it, $PYTHON is the environment's Python and $BIN its bin folder.
# shellcheck shell=bash

ROOT="$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)"
VENV="${LACLI_VENV:-$ROOT/.venv}"
PYTHON="$VENV/bin/python"
BIN="$VENV/bin"

# the solver; a compiler and headers for its compiled kernels; what the wheels of gmsh and VTK expect of the system
PACKAGES=(
  freefem++ libfreefem++-dev libmumps-seq-dev libopenblas0-pthread g++ python3-venv
  libglu1-mesa libxcursor1 libxft2 libxinerama1 libegl1
)

# for the tests of runs on SLURM, and of pages in a browser, which are skipped where these cannot be had
TEST_PACKAGES=(slurm-wlm munge chromium chromium-driver)

say() { printf '== %s\n' "$*"; }

die() {
  printf 'lacli: %s\n' "$*" >&2
  exit 1
}

# install_packages PACKAGE...: those that are missing; fails where they cannot be had
install_packages() {
  local package missing=() as_root=()
  for package in "$@"; do
    dpkg-query -W -f '${db:Status-Status}\n' "$package" 2>/dev/null | grep -qx installed || missing+=("$package")
  done
  if [ "${#missing[@]}" -eq 0 ]; then
    return
  fi
  if [ "$(id -u)" -ne 0 ]; then
    command -v sudo >/dev/null || die "these packages are missing: ${missing[*]}. Install them as root, or install sudo."
    as_root=(sudo)
  fi
  say "system packages: ${missing[*]}"
  "${as_root[@]}" env DEBIAN_FRONTEND=noninteractive apt-get update -q &&
    "${as_root[@]}" env DEBIAN_FRONTEND=noninteractive apt-get install -y -q --no-install-recommends "${missing[@]}"
}

install_test_packages() {
  command -v dpkg-query >/dev/null && (install_packages "${TEST_PACKAGES[@]}") ||
    say "no ${TEST_PACKAGES[*]} here: the tests of runs on SLURM and of pages in a browser are skipped"
}

install_system_packages() {
  if ! command -v dpkg-query >/dev/null; then
    say "no Debian packages here: FreeFEM 4.9 or later, g++, and the libraries of gmsh and VTK must be there already"
    return
  fi
  install_packages "${PACKAGES[@]}"
}

make_environment() {
  local python="${LACLI_PYTHON:-python3}"
  command -v "$python" >/dev/null || die "$python is not installed: sudo apt-get install -y python3 python3-venv"
  "$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))' ||
    die "Python 3.11 or later is needed; $python is $("$python" -V 2>&1). Set LACLI_PYTHON to a newer one."
  if [ ! -x "$PYTHON" ]; then
    say "virtual environment $VENV"
    "$python" -m venv "$VENV"
  fi
}

# install_lacli [EXTRA]: again only when the package's files have changed since
install_lacli() {
  local target="$ROOT${1:+[$1]}" stamp="$VENV/.lacli-installed${1:+-${1//,/-}}" state
  state="$(cd "$ROOT" && find pyproject.toml README.md LICENSE lacli templates solvers -type f ! -name '*.pyc' -print0 |
    sort -z | xargs -0 sha256sum | sha256sum)"
  if [ -f "$stamp" ] && [ "$(cat "$stamp")" = "$state" ]; then
    return
  fi
  say "lacli into $VENV"
  rm -f "$VENV"/.lacli-installed*
  # the wheel is built anew (same version, other content), its dependencies are kept
  "$PYTHON" -m pip install -q --disable-pip-version-check "$target"
  "$PYTHON" -m pip install -q --disable-pip-version-check --force-reinstall --no-deps "$ROOT"
  printf '%s\n' "$state" >"$stamp"
}

install_system_packages
make_environment
export OMP_NUM_THREADS="${OMP_NUM_THREADS:-1}" OPENBLAS_NUM_THREADS="${OPENBLAS_NUM_THREADS:-1}"
