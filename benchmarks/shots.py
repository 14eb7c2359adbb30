"""Processes of lacli shot at random moments: what the user reads, what is left over, and whether a rerun gives the same.

Used by robustness.py. A shot lands when its victim is there to be hit; one that misses is counted and tried again.
"""

from __future__ import annotations

import itertools
import os
import random
import shutil
import signal
import subprocess
import sys
import time
import uuid
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pandas as pd
import psutil
import records
from sameness import bundle_of, chains, features, rows, same

from lacli.contracts.bundle import save
from lacli.contracts.motion import save_motion
from lacli.synthetic.atrium import synthesize

LACLI = [sys.executable, "-m", "lacli"]
# small and quick: what is judged here is not the mechanics
SCENE = """[anatomy]
bundle = "{bundle}"
[loads]
edp_mmhg = 0
esp_mmhg = 6
[numerics]
order = 1
[outputs]
frames = 0
fields = "es"
"""
EARLIER = 0.7  # a victim that was gone is aimed at in so much of the time before: its life is shorter than was measured
MOST_MISSES = 100
MARK = "LACLI_SHOT"
CLUSTER = "design on Dask"
SIGNALS = ("SIGKILL", "SIGTERM", "SIGHUP", "SIGINT")
LEFTOVERS = (".locks/*", ".lock-*", "**/.lock-*", ".tmp-*", "**/.tmp-*", "**/.part-*", "**/.build-*", "**/.old-*")


@dataclass(frozen=True)
class Target:
    """A command, how long it takes undisturbed, and its products as plain content."""

    name: str
    words: Callable[[Path], list[str]]
    content: Callable[[Path], object]
    seed_folder: Path | None = None  # what a shot's folder begins with
    cold_cache: bool = False
    timing: list[float] = field(default_factory=list)
    expected: list[object] = field(default_factory=list)


@dataclass
class Shot:
    """What came of one shot that landed."""

    target: str
    victim: str
    how: str
    after_s: float
    exit_code: int = 0
    faults: list[str] = field(default_factory=list)
    said: str = ""
    number: int = -1
    missed: int = 0


class Range:
    """A folder with a scene, a store of finished runs and the undisturbed products of every command; made once."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.scene = folder, folder / "scene.toml"
        self.cache, self.seed = folder / "cache", folder / "seed"
        if (folder / "ready").is_file():
            return
        bundle, motion = synthesize(1, cell_size_mm=8.0)
        save(bundle, folder / "la")
        save_motion(motion, folder / "la")
        self.scene.write_text(SCENE.format(bundle="la"))
        self._tables()
        label = [*LACLI, "synthesize", str(folder / "syn"), "--cell-size-mm", "8", "--image", "--voxel-mm", "2"]
        subprocess.run(label, check=True, capture_output=True)
        self._runs()
        (folder / "ready").touch()

    def _tables(self) -> None:
        """Runs and targets for a calibration that makes no run itself."""
        x = np.random.default_rng(0).uniform([1, 4], [3, 10], (40, 2))
        table = {
            "c_kpa": x[:, 0],
            "bf": x[:, 1],
            "d_global_mm": 6 / x[:, 0] + 0.1 * x[:, 1],
            "esv_ml": 80 - 5 * x[:, 0] + x[:, 1],
        }
        pd.DataFrame(table).to_csv(self.folder / "table.csv", index=False)
        text = "[targets]\nd_global_mm = { mean = 3.7, sd = 0.1 }\nesv_ml = { mean = 77.0, sd = 1.0 }\n"
        (self.folder / "targets.toml").write_text(text)

    def _runs(self) -> None:
        """A store that holds most runs of a calibration of the scene, so that a few are left for each shot."""
        (self.folder / "box.toml").write_text("[box]\nc_roof_kpa = [0.5, 4.0]\nalpha_roof = [0.5, 2.0]\n")
        at = self.folder / "first"
        environment = {**os.environ, "XDG_CACHE_HOME": str(self.cache), "OMP_NUM_THREADS": "1"}
        subprocess.run(
            [*LACLI, "simulate", str(self.scene), "--out", f"{at}/runs", "--no-figures"],
            check=True, capture_output=True, env=environment,
        )  # fmt: skip
        (found,) = features(at).values()
        text = f"[targets]\nd_roof_mm = {{ mean = {found['d_roof_mm']}, sd = 0.3 }}\n"
        (self.folder / "of_runs.toml").write_text(text)
        subprocess.run([*LACLI, *self.calibrate_runs(at)], check=True, capture_output=True, env=environment)
        shutil.copytree(at / "runs", self.seed / "runs", ignore=shutil.ignore_patterns(".*"))
        for number, run in enumerate(sorted((self.seed / "runs").iterdir())):
            if number % 5 == 0:
                shutil.rmtree(run)

    def calibrate_runs(self, at: Path) -> list[str]:
        """A calibration that makes runs: one wave, and those at its answer."""
        words = [
            "calibrate",
            str(self.scene),
            "--targets",
            str(self.folder / "of_runs.toml"),
            "--box",
            str(self.folder / "box.toml"),
        ]
        words += ["--first-runs", "12", "--max-waves", "1", "--ess", "300", "--workers", "1", "--no-figures", "--json"]
        return [*words, "--store", f"{at}/runs", "--out", f"{at}/calibration"]

    def targets(self) -> list[Target]:
        scene = str(self.scene)
        simulate = ["simulate", scene, "--json"]
        design = ["design", scene, "-n", "3", "--input", "c_roof_kpa", "--run", "--workers", "1", "--json"]
        calibrate = ["calibrate", "--from-table", str(self.folder / "table.csv"), "--targets", str(self.folder / "targets.toml")]
        calibrate += ["--no-figures", "--ess", "300", "--json"]
        mesh = ["mesh", str(self.folder / "syn" / "labels.nrrd"), "--la", "2", "--lv", "3", "--wall", "4", "--cell-size-mm", "6"]
        return [
            Target("simulate", lambda at: [*simulate, "--out", f"{at}/runs", "--no-figures"], features),
            Target("simulate, pictures", lambda at: [*simulate, "--out", f"{at}/runs"], features),
            Target("design", lambda at: [*design, "--store", f"{at}/runs", "--out", f"{at}/design.csv"], rows),
            Target("calibrate", lambda at: [*calibrate, "--out", f"{at}/calibration"], chains),
            Target("calibrate, runs", self.calibrate_runs, chains, self.seed),
            Target("mesh", lambda at: [*mesh, "--out", f"{at}/bundle", "--no-pictures"], bundle_of),
            Target("simulate, compiling", lambda at: [*simulate, "--out", f"{at}/runs", "--no-figures"], features, None, True),
        ]


def marked(mark: str) -> list[psutil.Process]:
    """Every process, whoever its parent, that was started with the mark in its environment; zombies not counted."""
    found = []
    for process in psutil.process_iter():
        with suppress(psutil.Error, OSError):
            if process.environ().get(MARK) == mark and process.status() != psutil.STATUS_ZOMBIE:
                found.append(process)
    return found


def catches(pid: int, number: int) -> bool:
    """Whether a process has a handler for the signal: before, only the interpreter itself is being started."""
    with suppress(OSError, StopIteration):
        line = next(line for line in Path(f"/proc/{pid}/status").read_text().splitlines() if line.startswith("SigCgt"))
        return bool(int(line.split()[1], 16) >> (number - 1) & 1)
    return False


def is_victim(process: psutil.Process, victim: str) -> bool:
    with suppress(psutil.Error):
        words = process.cmdline()
        name = Path(words[0]).name if words else ""
        if victim == "FreeFEM":
            return "FreeFem" in name and any(".tmp-" in word for word in words)
        if victim == "compiler":
            return name in ("cc1plus", "g++", "ld", "as", "collect2")
        if victim == "worker":
            return "lacli.mechanics.places.worker" in words and "python" in name
    return False


class Shooter:
    """Runs a target, shoots, judges, runs it again, compares."""

    def __init__(self, place: Range, seed: int) -> None:
        self.place, self.chance = place, random.Random(seed)
        self.misses: Counter[str] = Counter()

    def environment(self, mark: str, target: Target, at: Path) -> dict[str, str]:
        cache = at / "cache" if target.cold_cache else self.place.cache
        return {**os.environ, MARK: mark, "XDG_CACHE_HOME": str(cache), "OMP_NUM_THREADS": "1"}

    def run(self, target: Target, at: Path, mark: str) -> subprocess.CompletedProcess[str]:
        command = [*LACLI, *target.words(at)]
        environment = self.environment(mark, target, at)
        return subprocess.run(command, capture_output=True, text=True, check=False, timeout=900, env=environment)

    def undisturbed(self, target: Target) -> None:
        """Measure the time and the products of a run that nobody disturbs."""
        at = self.fresh(target)
        start = time.monotonic()
        answer = self.run(target, at, "none")
        if answer.returncode != 0:
            raise SystemExit(f"{target.name}, undisturbed: {answer.stderr[-1000:]}")
        target.timing.append(time.monotonic() - start)
        target.expected.append(target.content(at))
        shutil.rmtree(at)

    def fresh(self, target: Target) -> Path:
        at = self.place.folder / f"shot-{uuid.uuid4().hex[:8]}"
        if target.seed_folder is None:
            at.mkdir()
        else:
            shutil.copytree(target.seed_folder, at)
        return at

    def shoot(self, target: Target, victim: str, how: str) -> Shot:
        """One shot that lands; those that miss are counted."""
        missed = 0
        while True:
            at, mark = self.fresh(target), uuid.uuid4().hex
            shot = self._try(target, victim, how, at, mark, EARLIER**missed)
            shutil.rmtree(at, ignore_errors=True)
            if shot is not None:
                shot.missed = missed
                return shot
            missed += 1
            if missed == MOST_MISSES:
                raise SystemExit(f"{target.name}: {how} missed {victim} {missed} times")
            self.misses[f"{target.name}, {victim}"] += 1

    def _try(self, target: Target, victim: str, how: str, at: Path, mark: str, share: float) -> Shot | None:
        number = signal.Signals[how]
        with subprocess.Popen(
            [*LACLI, *target.words(at)],
            env=self.environment(mark, target, at),
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        ) as lacli:
            prey, after_s = self._aim(lacli, target, victim, mark, share)
            if prey is None:
                lacli.communicate()
                return None
            try:
                prey.send_signal(number)
            except psutil.Error:
                lacli.communicate()
                return None
            shot = Shot(target.name, victim, how, after_s)
            if victim == "lacli":
                deadline = time.monotonic() + 20
                while lacli.poll() is None and time.monotonic() < deadline:
                    time.sleep(0.01)
                self._no_orphan(shot, mark)
            _, said = lacli.communicate(timeout=900)
        shot.exit_code, shot.said = lacli.returncode, said.strip()[-3000:]
        if victim == "lacli" and lacli.returncode == 0:
            return None  # it had all but ended
        self._judge(shot, number, said)
        self._no_orphan(shot, mark)
        self._again(shot, target, at, mark)
        return shot

    def _aim(
        self, lacli: subprocess.Popen[str], target: Target, victim: str, mark: str, share: float
    ) -> tuple[psutil.Process | None, float]:
        """The victim at a random moment of its life, or of the first ``share`` of it; None where it has gone by then."""
        begin, usual = time.monotonic(), share * target.timing[0]
        if victim == "lacli":
            while not catches(lacli.pid, signal.SIGTERM):
                if lacli.poll() is not None:
                    return None, 0.0
                time.sleep(0.002)
            time.sleep(self.chance.uniform(0, usual))
            if lacli.poll() is not None:
                return None, 0.0
            return psutil.Process(lacli.pid), time.monotonic() - begin
        wait_s = self.chance.uniform(0, 0.35 * usual if victim != "compiler" else 0.5 * usual)
        while not (prey := [p for p in marked(mark) if is_victim(p, victim)]):
            if lacli.poll() is not None:
                return None, 0.0
            time.sleep(0.01)
        time.sleep(wait_s)
        prey = [p for p in marked(mark) if is_victim(p, victim)]
        return (self.chance.choice(prey) if prey else None), time.monotonic() - begin

    def _judge(self, shot: Shot, number: int, said: str) -> None:
        """What was read: one message that says it, no traceback."""
        if "Traceback" in said or "Exception ignored" in said:
            shot.faults.append("traceback")
        lines = [line for line in said.splitlines() if line.startswith("lacli:")]
        if shot.victim == "lacli":
            wanted = -number if number == signal.SIGKILL else 128 + number
            if shot.exit_code != wanted:
                shot.faults.append(f"exit code {shot.exit_code}, not {wanted}")
            if number != signal.SIGKILL and len(lines) != 1:
                shot.faults.append(f"{len(lines)} messages")
        elif "killed from outside" not in said:
            shot.faults.append("not said")

    def _no_orphan(self, shot: Shot, mark: str) -> None:
        end = time.monotonic() + 1.0
        while (left := marked(mark)) and time.monotonic() < end:
            time.sleep(0.05)
        if left:
            names = set()
            for process in left:
                with suppress(psutil.Error):
                    names.add(" ".join(process.cmdline())[-60:])
                    process.kill()
            shot.faults.append(f"orphans: {', '.join(sorted(names))}")

    def _again(self, shot: Shot, target: Target, at: Path, mark: str) -> None:
        """The same command again: products equal to the undisturbed ones, and nothing left over."""
        answer = self.run(target, at, mark)
        if answer.returncode != 0:
            shot.faults.append(f"run again: exit code {answer.returncode}: {answer.stderr[-200:]}")
            return
        verdict = same(target.content(at), target.expected[0])
        if verdict == "NO":
            shot.faults.append("run again: NOT the same")
        left = {str(path.relative_to(at)) for pattern in LEFTOVERS for path in at.glob(pattern)}
        left |= {path.name for path in self.place.cache.glob("lacli/.*")}
        if left:
            shot.faults.append(f"left over: {', '.join(sorted(left))}")


def plan(targets: list[Target], shots: int, seed: int) -> Iterator[tuple[int, Target, str, str, random.Random]]:
    """Number, whom to shoot, how, the shot's own chance: compilers (slow to wait for) in every twenty-fifth, FreeFEM and workers
    in a third, else lacli itself, every command in its turn."""
    *quick, compiling = targets
    runs = [target for target in quick if target.name.startswith(("simulate", "design", "calibrate, runs"))]
    turn = itertools.cycle(quick)
    for number in range(shots):
        chance, how = random.Random(f"{seed} {number}"), SIGNALS[number % len(SIGNALS)]
        if number % 25 == 24:
            yield number, compiling, chance.choice(["compiler", "lacli"]), chance.choice(SIGNALS), chance
        elif number % 3 == 2:
            target = chance.choice(runs)
            victim = "FreeFEM" if target.name.startswith("simulate") else chance.choice(["FreeFEM", "worker"])
            yield number, target, victim, how, chance
        else:
            yield number, next(turn), "lacli", how, chance


def shots(
    place: Range, count: int, seed: int, tell: Callable[[Shot], None], record: Path | None = None
) -> tuple[list[Shot], Counter[str]]:
    """``count`` shots that landed, and how many missed, by target and victim; those in ``record`` are not shot again."""
    shooter, targets = Shooter(place, seed), place.targets()
    landed = [shot for shot in records.read(record, Shot) if shot.target != CLUSTER]
    known = {shot.number for shot in landed}
    for shot in landed:
        shooter.misses[f"{shot.target}, {shot.victim}"] += shot.missed
    for number, target, victim, how, chance in plan(targets, count, seed):
        if number in known:
            continue
        if not target.timing:
            shooter.undisturbed(target)
        shooter.chance = chance
        shot = shooter.shoot(target, victim, how)
        shot.number = number
        records.add(record, shot)
        landed.append(shot)
        tell(shot)
    return landed, +shooter.misses
