"""The steps of one patient, as data: each a call of lacli that can be made by hand, with what it reads and what it leaves."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lacli.base.documents import brief, read_toml
from lacli.base.errors import UsageError
from lacli.cohort.participants import Participant

UNIFORM = "uniform"  # the model of one thickness everywhere; the column of its bundle
COMMANDS = ("mesh", "fat", "track", "calibrate", "compare")
SLURM = ("time", "memory", "cpus", "account", "partition", "modules", "limit", "interface")
# options of a calibration that say what is run and how: nothing where a table holds the runs
OF_RUNS = (
    *("set", "store", "workers", "scheduler", "warm", "retry", "sensitivities", "discretisation-error", "infer-errors"),
    *("first-runs", "wave-runs", "max-waves", "max-runs", "hours", "cheap", "reference-runs"),
)
_OPTION = re.compile(r"[a-z][a-z0-9-]*")
_PLAIN = re.compile(r"[A-Za-z0-9_./:=+,@ -]{1,200}")
READ = ("box", "landmarks", "fibres", "labels")  # options whose value names a file that the command reads
WRITTEN = ("store", "also")  # and those whose value it fills
_BUNDLE = "bundle"  # the key whose value is a folder, of options KEY=VALUE
OURS = ("out", "bundle", "anatomy", "targets", "from-table", "json", "other", "priors")


@dataclass(frozen=True)
class Settings:
    """What all patients share: options of each command (name -> value), and SLURM's."""

    options: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    slurm: Mapping[str, Any] = field(default_factory=dict)

    def arguments(self, command: str, without: Collection[str] = ()) -> list[str]:
        """The command's options as arguments, but for those that do nothing in this call of it."""
        words: list[str] = []
        for name, value in self.options.get(command, {}).items():
            if name in without:
                continue
            if value is True:
                words.append(f"--{name}")
            elif value is False:
                words.append(f"--no-{name}")
            else:
                for one in value if isinstance(value, list) else [value]:
                    words += [f"--{name}", str(one)]
        return words

    def reads(self, command: str, folder: Path, bundle: Path) -> list[Path]:
        """Files and folders that the command's options name and that are there; ``folder`` is where it is called, ``bundle`` the
        patient's, beside which another one is looked for."""
        found = []
        for name, value in self.options.get(command, {}).items():
            for text in map(str, value if isinstance(value, list) else [value]):
                key, _, named = (part.strip() for part in text.partition("="))
                if name in READ:
                    found.append(folder / text)
                elif key.split(".")[-1] == _BUNDLE:
                    found.append(bundle.parent / named.strip("\"'"))
        return [place for place in found if _is_there(place)]


@dataclass(frozen=True)
class Step:
    """name (a command, of a second call ``command_what``); arguments of ``lacli``; files and folders that it reads; the product
    that shows that it is done, and what else it leaves, in the folder of another step."""

    name: str
    arguments: tuple[str, ...]
    reads: tuple[Path, ...]
    product: Path
    beside: tuple[Path, ...] = ()

    def fills(self, place: Path) -> bool:
        """Whether a file or folder is, or lies in, the one that the step makes: the product, of a file the folder of it."""
        made = self.product.parent if self.product.suffix else self.product
        return place == made or made in place.parents


def read_settings(path: Path | None) -> Settings:
    """The settings file: tables ``[mesh]``, ``[fat]``, ``[track]``, ``[calibrate]``, ``[compare]`` of options without their
    dashes, ``[slurm]`` with time, memory, cpus, account, partition, modules, limit, interface. Raises UsageError."""
    if path is None:
        return Settings()
    document = read_toml(path, error=UsageError)
    slurm = document.pop("slurm", {})
    for command, table in document.items():
        if command not in COMMANDS or not isinstance(table, dict):
            raise UsageError(f"{path}: [{command}]: the tables are {', '.join((*COMMANDS, 'slurm'))}.")
        for name, value in table.items():
            if not _OPTION.fullmatch(name) or name in OURS:
                raise UsageError(f"{path}: {command}.{name}: not an option that all patients can share.")
            _check_value(path, f"{command}.{name}", value)
    if not isinstance(slurm, dict) or set(slurm) - set(SLURM):
        raise UsageError(f"{path}: [slurm] has the keys {', '.join(SLURM)}.")
    for name, value in slurm.items():
        for one in value if isinstance(value, list) else [value]:
            if isinstance(one, bool) or not _PLAIN.fullmatch(str(one)):
                raise UsageError(f"{path}: slurm.{name}: {brief(one)} cannot stand in a batch script.")
    return Settings(document, slurm)


def _is_there(place: Path) -> bool:
    try:
        return place.exists()
    except (OSError, ValueError):  # no name that a file could have
        return False


def _check_value(path: Path, name: str, value: Any) -> None:
    for one in value if isinstance(value, list) else [value]:
        if not isinstance(one, (str, int, float, bool)) or (isinstance(one, str) and one.startswith("-")):
            raise UsageError(f"{path}: {name}: {brief(one)}; a text, a number, true, false, or a list of them.")


def steps_of(patient: Participant, settings: Settings, folder: Path, scene: Path | None) -> list[Step]:
    """The steps of a patient in order; folder: the patient's own. scene: of those who have none of their own.

    Raises UsageError where a calibration has no scene.
    """
    paths, steps = patient.paths, []
    table = paths.get("table")
    own_bundle = "bundle" not in paths
    bundle, targets = paths.get("bundle", folder / "anatomy"), paths.get("targets", folder / "motion" / "targets.toml")

    def add(name: str, words: list[str], reads: list[Path], product: Path, beside: tuple[Path, ...] = ()) -> None:
        command = name.partition("_")[0]
        own = paths[UNIFORM] if name.endswith(f"_{UNIFORM}") else bundle
        read = dict.fromkeys([*reads, *settings.reads(command, folder, own)])
        # all patients share the options; those whose runs are done need none of the runs'
        without = OF_RUNS if command == "calibrate" and table is not None else ()
        steps.append(Step(name, (command, *words, *settings.arguments(command, without)), tuple(read), product, beside))

    if table is None:
        # tracking puts the annulus' motion into a bundle that is the study's own, and changes nothing else of it
        anatomy = [bundle / "wall.vtu", bundle / "boundary.vtp"]
        if own_bundle:
            add("mesh", [str(paths["labels"]), "--out", str(bundle)], [paths["labels"]], bundle / "anatomy.json")
        if "ct" in paths:
            words = [str(paths["ct"]), "--anatomy", str(bundle), "--out", str(folder / "fat")]
            add("fat", words, [paths["ct"], *anatomy], folder / "fat" / "fat.json")
        if "targets" not in paths:
            words = [str(paths["images"]), "--bundle", str(bundle), "--out", str(folder / "motion")]
            words += ["--update-bundle"] if own_bundle else []
            reads = [paths["images"], *anatomy]
            if (known := paths.get("priors")) is not None:
                words, reads = [*words, "--priors", str(known)], [*reads, known]
            # a bundle that is meshed anew has no motion any more
            add("track", words, reads, targets, (bundle / "motion.npz",) if own_bundle else ())
    calibration = folder / "calibration"
    words = ["--targets", str(targets), "--out", str(calibration)]
    if table is None:
        own = paths.get("scene", scene)
        if own is None:
            raise UsageError(f"{patient.identifier}: no scene to calibrate; give --scene, or a column scene.")
        words = [str(own), *words, "--set", f"anatomy.bundle={bundle}"]
        reads = [own, bundle, targets]
    else:
        words, reads = ["--from-table", str(table), *words], [table, targets]
    add("calibrate", words, reads, calibration / "result.json")
    compared = [str(calibration), "--targets", str(targets), "--out", str(folder / "comparison.json")]
    results = [calibration / "result.json"]
    if table is None and (wall := paths.get("uniform")) is not None:
        other = folder / f"calibration_{UNIFORM}"
        words = [str(reads[0]), "--targets", str(targets), "--out", str(other), "--set", f"anatomy.bundle={wall}"]
        add(f"calibrate_{UNIFORM}", words, [reads[0], wall, targets], other / "result.json")
        compared += ["--other", f"{UNIFORM}={other}"]
        results.append(other / "result.json")
    add("compare", compared, [*results, targets], folder / "comparison.json")
    return steps
