# Sourced by the examples of whole studies: installs, takes RESULTS and PATIENTS from their arguments, gathers what goes wrong.
# shellcheck shell=bash

source "$(dirname "${BASH_SOURCE[0]}")/install.sh"

# begin NAME PATIENTS [RESULTS_FOLDER [PATIENTS]]: the first two stand where the user gave none
begin() {
  install_lacli
  RESULTS="${3:-$ROOT/results/$1}"
  PATIENTS="${4:-$2}"
  [[ "$PATIENTS" =~ ^[1-9][0-9]*$ ]] || die "$PATIENTS patients; a whole number, 1 or more."
  mkdir -p "$RESULTS"
}

# what goes wrong with one patient, or is not as it should be, is told at the end; the report is made all the same
WRONG=()

# try WORDS COMMAND...
try() {
  local what="$1"
  shift
  "$@" || WRONG+=("$what")
}

# finish WORDS: fails where something went wrong
finish() {
  local words
  for words in ${WRONG[@]+"${WRONG[@]}"}; do say "$words (see above)"; done
  say "done: $1"
  [ "${#WRONG[@]}" -eq 0 ]
}
