"""A study on disk: a folder a patient, a step done once and found again by the content of all that it read.

``STUDY/<participant_id>/steps/<step>.json`` is written when a step has ended well; ``<step>.log`` has what it said. A step whose
inputs, options, method or product have changed since is refused, never mixed; where its mark or product was removed it is done
again. What goes wrong with a patient is that patient's, with its reason.
"""

from __future__ import annotations

import hashlib
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from lacli.anatomy.inputs.parts import parts
from lacli.base.documents import read_json, read_toml
from lacli.base.errors import Cancelled, InputError, StorageError, UsageError
from lacli.base.files import write_json
from lacli.base.processes.locks import lock
from lacli.base.processes.process import supervise, while_wanted
from lacli.base.version import __version__
from lacli.cohort.participants import Participant
from lacli.cohort.steps import Step
from lacli.contracts.identity import METHODS, content_hash, solver_digest
from lacli.contracts.sections import ANNULUS_MODES
from lacli.mechanics.numerics.stated import coefficients
from lacli.motion.registration import ENGINES

TO_DO, DONE, REFUSED = "to do", "done", "refused"
_TIMEOUT_S = 30 * 86_400.0
_BLOCK = 1 << 20


@dataclass(frozen=True)
class Outcome:
    """A patient's state: ``done``, ``failed`` at ``step`` with its ``reason``; cpu_s of the steps done, by name."""

    participant_id: str
    status: str
    step: str
    reason: str
    cpu_s: dict[str, float]


@dataclass(frozen=True)
class Planned:
    """A step of the dry run: ``done``, ``to do``, or of a step that was done, on what it depends that it still is; of a patient
    whose results are of other inputs one row, ``refused`` with the reason."""

    participant_id: str
    step: str
    state: str
    command: str


def planned(patient: Participant, steps: Sequence[Step], folder: Path) -> list[Planned]:
    """The state of each step, nothing is run. Raises UsageError where what was done was done from something else."""
    rows: list[Planned] = []
    making: list[Step] = []
    for step in steps:
        state = _state(step, folder, making)
        if state.startswith(TO_DO):
            making.append(step)
        rows.append(Planned(patient.identifier, step.name, state, " ".join(("lacli", *step.arguments))))
    return rows


def run(
    patient: Participant, steps: Sequence[Step], folder: Path, tick: Callable[[str], None], wanted: Callable[[], bool]
) -> Outcome:
    """Do what is not done. tick: called with the name of each step that begins. Raises Cancelled where no longer wanted.

    A failure is the outcome's, not an exception; the steps before it stay done.
    """
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "steps").mkdir(exist_ok=True)
    cpu: dict[str, float] = {}
    with lock(folder / "steps" / ".lock", f"patient {patient.identifier}"):
        for step in steps:
            tick(step.name)
            try:
                if _state(step, folder) == TO_DO:
                    _do(step, folder, wanted)
                cpu[step.name] = float(read_json(_mark(step, folder))["cpu_s"])
            except (UsageError, InputError, StorageError) as error:
                return keep(folder, Outcome(patient.identifier, "failed", step.name, str(error), cpu))
    return keep(folder, Outcome(patient.identifier, "done", "", "", cpu))


def known_outcome(folder: Path) -> Outcome | None:
    """What an earlier call left of a patient. Raises InputError on a damaged file."""
    file = folder / "status.json"
    if not file.is_file():
        return None
    try:
        return Outcome(**read_json(file))
    except TypeError:
        raise InputError(f"{file}: not a patient's state; remove it.") from None


def keep(folder: Path, outcome: Outcome) -> Outcome:
    """Write a patient's state, as ``known_outcome`` reads it; gives it back. Raises StorageError."""
    write_json(folder / "status.json", asdict(outcome))
    return outcome


def _mark(step: Step, folder: Path) -> Path:
    return folder / "steps" / f"{step.name}.json"


def _state(step: Step, folder: Path, making: Sequence[Step] = ()) -> str:
    """``done`` or ``to do``; and of a step that was done, and reads what the steps ``making`` will make anew, that it is so if
    they make the same again.

    Raises UsageError where it was done from something else: results are never written over, nor mixed with those of other inputs.
    """
    mark = _mark(step, folder)
    known = read_json(mark) if mark.is_file() else None
    if not isinstance(known, dict) or not step.product.exists():
        return TO_DO
    if why := _otherwise(step, known, making):
        raise UsageError(f"{folder}: {step.name} was {why}; choose another --out, or remove {mark} and its results.")
    left = all(place.exists() and not any(other.fills(place) for other in making) for place in step.beside)
    before = [other.name for other in making if any(map(other.fills, step.reads))]
    same = f", if {' and '.join(before)} {'makes' if len(before) == 1 else 'make'} the same again; else refused"
    return f"{DONE if left else TO_DO}{same if before else ''}"


def _otherwise(step: Step, known: dict[str, object], making: Sequence[Step]) -> str:
    """How what is kept of a step was done otherwise than it would be now, in words; '' where it is the same, as far as that is
    known before ``making`` are done."""
    if known.get("arguments") != list(step.arguments):
        return "done with other options"
    reads = known.get("reads")
    digests = _digests(step, making)
    if changed := [n for n, digest in digests.items() if not isinstance(reads, dict) or reads.get(n) != digest]:
        return f"done from another {changed[0]}"
    if known.get("method") != (method := _method(step)):
        return f"done by another version ({known.get('method', 'it does not say which')}; this is {method})"
    if known.get("product") != content_digest(step.product):
        return f"done, but its {step.product.name} was changed since"
    return ""


def _method(step: Step) -> str:
    """What carries a step out: this version, its methods; where it uses them, FreeFEM's scripts, the model of discretisation
    errors, the ways that an annulus can be wrong, and how frames are registered."""
    command = step.arguments[0]
    content: dict[str, object] = {**METHODS, "scripts": solver_digest() if command == "calibrate" else ""}
    if command == "calibrate":
        content["errors"] = {**coefficients(), "annulus": ANNULUS_MODES}
    if command == "track":
        content["engines"] = {name: engine.settings for name, engine in ENGINES.items()}
    return f"lacli {__version__}, methods {content_hash(content)[:8]}"


def _digests(step: Step, making: Sequence[Step] = ()) -> dict[str, str]:
    """Digests of all that a step reads: its files, those that these name or that belong to them; not what ``making`` fill."""
    there = [file for file in step.reads if not any(other.fills(file) for other in making)]
    return {str(path): content_digest(path) for file in there for path in (file, *_named(file), *parts(file))}


def _named(file: Path) -> list[Path]:
    """The covariance that a file of targets names."""
    if file.suffix != ".toml" or not file.is_file():
        return []
    try:
        name = read_toml(file).get("covariance")
    except InputError:
        return []  # whoever reads it says so
    beside = file.parent / name if isinstance(name, str) and name and Path(name).name == name else None
    return [beside] if beside is not None and beside.is_file() else []


def content_digest(path: Path) -> str:
    """Digest of a file's bytes, or of all files below a folder with their names. Raises InputError where it is not there."""
    digest = hashlib.sha256()
    files = sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]
    try:
        for file in files:
            digest.update(str(file.relative_to(path)).encode() + b"\0")
            with file.open("rb") as stream:
                while block := stream.read(_BLOCK):
                    digest.update(block)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}).") from None
    return digest.hexdigest()[:32]


def last_words(lines: Sequence[str]) -> str:
    """Why a command ended, by the last lines it wrote: what lacli said, else the last that has words, without the frame that
    stands around refused options; '' where there are none."""
    bare = [line.strip("│╭╮╰╯─ \t\n") for line in lines]
    said = [line for line in bare if line.startswith("lacli: ")] or [line for line in bare if line]
    return said[-1].removeprefix("lacli: ").strip() if said else ""


def _do(step: Step, folder: Path, wanted: Callable[[], bool]) -> None:
    """Run the step. Raises InputError with its last words where it fails."""
    before = _digests(step)
    log = folder / "steps" / f"{step.name}.log"
    log.unlink(missing_ok=True)
    environment = {**os.environ, "COLUMNS": "400", "NO_COLOR": "1"}
    command = [sys.executable, "-m", "lacli", *step.arguments]
    with while_wanted(wanted):
        ended = supervise(command, cwd=folder, env=environment, log=log, timeout_s=_TIMEOUT_S, family=True)
    if ended.cut == "cancelled":
        raise Cancelled(f"cancelled during {step.name}; what is done is kept.")
    if ended.exit_code != 0 or ended.cut:
        why = last_words(ended.last_lines) or f"exit code {ended.exit_code}"
        raise InputError(f"{ended.cut + ': ' if ended.cut else ''}{why} (see {log})")
    if not step.product.exists():
        raise InputError(f"{step.name} left no {step.product} (see {log})")
    content = {
        "arguments": list(step.arguments),
        "reads": before,
        "cpu_s": ended.cpu_s,
        "wall_s": ended.wall_s,
        "method": _method(step),
        "product": content_digest(step.product),
    }
    write_json(_mark(step, folder), content)
