"""Shots at a study on a Dask cluster at random moments: is anything lost, does anything run on?

    python benchmarks/cohort_shots.py [--shots 10] [--seed 0]

Three patients on two workers; their steps are stand-ins (`lacli --version`, and a small `lacli synthesize` whose product is the
same each time). In turn a worker, its nanny, the scheduler and the client (SIGKILL, SIGINT, SIGTERM) are shot, 0 to 8 s after the
first step began. Asked: no step of lacli runs on after scheduler or client are gone (30 s are given, the time it took is told);
the study, asked for again (with a new scheduler where that was shot), ends with every step of every patient done; a step that was
done before is not done again; the products are those of a study that nobody shot at. Exit code 1 where one of them is missed.
"""

from __future__ import annotations

import argparse
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path

import psutil
from shots_cluster import Cluster

from lacli.cohort.cluster import patients_on_cluster
from lacli.cohort.participants import Participant
from lacli.cohort.steps import Step
from lacli.cohort.study import Outcome, content_digest

NAMES = ("sub-1", "sub-2", "sub-3")
CASES = (
    ("worker", "SIGKILL"), ("client", "SIGKILL"), ("scheduler", "SIGKILL"), ("nanny", "SIGKILL"), ("client", "SIGINT"),
    ("client", "SIGTERM"),
)  # fmt: skip
_LATEST_S, _FAREWELL_S, _PATIENCE_S = 8.0, 30.0, 900.0


def patients(home: Path) -> list[tuple[Participant, list[Step]]]:
    """The stand-ins' steps."""
    (home / "given").touch()
    found = []
    for name in NAMES:
        made = home / name / "atrium"
        words = ("synthesize", str(made), "--cell-size-mm", "12", "--order", "1")
        steps = [
            Step("mesh", ("--version",), (), home / "given"),
            Step("track", words, (), made / "wall.vtu"),
            Step("compare", ("--version",), (made / "wall.vtu",), home / "given"),
        ]
        found.append((Participant(name, {}, {}), steps))
    return found


def study(home: Path, address: str) -> dict[str, Outcome]:
    """What the client does."""
    return {o.participant_id: o for _, o in patients_on_cluster(patients(home), home, address, lambda index, step: None)}


def at_work(home: Path) -> list[psutil.Process]:
    """Steps of lacli that run for this study."""
    found = []
    for process in psutil.process_iter(["cmdline", "status"]):
        words = process.info["cmdline"] or []
        if words[1:3] == ["-m", "lacli"] and process.info["status"] != psutil.STATUS_ZOMBIE:
            with suppress(psutil.Error):
                if Path(process.cwd()).is_relative_to(home):
                    found.append(process)
    return found


def marks(home: Path) -> dict[str, int]:
    """When each step that is done was done, by its mark."""
    files = [file for file in home.glob("*/steps/*.json") if not file.name.startswith(".")]  # one being written is no mark yet
    return {str(file.relative_to(home)): file.stat().st_mtime_ns for file in files}


def shoot(folder: Path, victim: str, how: str, after_s: float, expected: str) -> list[str]:
    """Faults of one shot."""
    home, faults = Path(tempfile.mkdtemp(dir=folder)), list[str]()
    cluster = Cluster(folder)
    command = [sys.executable, __file__, "--client", str(home), cluster.address]
    client = psutil.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    while not at_work(home) and client.poll() is None:
        time.sleep(0.02)
    time.sleep(after_s)
    if client.poll() is not None:
        faults.append("missed: the study had ended")
    before = marks(home)
    nannies = [nanny.pid for nanny in cluster.nannies]
    with suppress(psutil.Error):
        workers = [
            p
            for n in cluster.nannies
            for p in n.children(recursive=True)
            if p.ppid() in nannies and "spawn" in " ".join(p.cmdline())
        ]
        hit = {"worker": workers[-1] if workers else cluster.nannies[0], "nanny": cluster.nannies[0],
               "scheduler": cluster.scheduler, "client": client}[victim]  # fmt: skip
        hit.send_signal(signal.Signals[how])
    if victim in ("scheduler", "client"):
        went = time.monotonic()
        while at_work(home) and time.monotonic() < went + _FAREWELL_S:
            time.sleep(0.1)
        print(f"    steps ended within {time.monotonic() - went:.1f} s")
        faults += [f"{len(left)} steps {_FAREWELL_S:g} s later"] if (left := at_work(home)) else []
    _, said = client.communicate(timeout=_PATIENCE_S)
    if "Traceback" in said:
        faults.append(f"a traceback: {said[-200:]}")
    if victim == "scheduler":
        cluster.stop()
        cluster = Cluster(folder)
    again = subprocess.run([*command[:-1], cluster.address], capture_output=True, text=True, check=False, timeout=_PATIENCE_S)
    cluster.stop()
    if again.returncode != 0:
        faults.append(f"asked again: {again.stderr[-300:]}")
    after = marks(home)
    faults += [f"{len(after)} steps done"] if len(after) != 3 * len(NAMES) else []
    faults += [f"done again: {name}" for name, time_ns in before.items() if after.get(name) != time_ns]
    faults += [f"{name}: another product" for name in NAMES if product(home, name) != expected]
    shutil.rmtree(home)
    return faults


def product(home: Path, name: str) -> str:
    """Digest of what a patient's study made; '' where it is not there."""
    file = home / name / "atrium" / "wall.vtu"
    return content_digest(file) if file.is_file() else ""


def client(home: Path, address: str) -> int:
    """The process that is shot as the client."""
    from lacli.base.errors import LacliError
    from lacli.base.processes import signals

    # a shell that starts this benchmark in the background lets it ignore Ctrl-C, and what ignores it goes on ignoring it
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        signals.catch()
        found = study(home, address)
        wrong = {name: o.reason for name, o in found.items() if o.status != "done"}
        print("; ".join(f"{name}: {reason}" for name, reason in wrong.items()), file=sys.stderr)
        code = int(bool(wrong))
    except LacliError as error:
        print(error, file=sys.stderr)
        code = 1
    finally:
        signals.settle()
    return code


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--shots", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--client", nargs=2, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.client:
        return client(Path(options.client[0]), options.client[1])
    os.environ["OMP_NUM_THREADS"] = "1"
    chance, faulty = random.Random(options.seed), 0
    with tempfile.TemporaryDirectory(prefix="lacli-shots-") as name:
        folder = Path(name)
        made = folder / "expected"
        subprocess.run([sys.executable, "-m", "lacli", "synthesize", str(made), "--cell-size-mm", "12", "--order", "1"],
                       check=True, capture_output=True)  # fmt: skip
        expected = content_digest(made / "wall.vtu")
        for number in range(options.shots):
            victim, how = CASES[number % len(CASES)]
            after_s = chance.uniform(0, _LATEST_S)
            faults = shoot(folder, victim, how, after_s, expected)
            faulty += bool(faults)
            print(f"{number + 1:3d} {victim:9} {how:8} after {after_s:4.1f} s: {'; '.join(faults) or 'nothing lost'}", flush=True)
    print(f"{options.shots} shots, {faulty} with a fault (asked: 0)")
    return int(faulty > 0)


if __name__ == "__main__":
    sys.exit(main())
