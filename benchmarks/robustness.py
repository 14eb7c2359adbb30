"""What a user sees when something goes wrong: a mishap is arranged, ``lacli simulate`` run, message and aftermath judged.

python benchmarks/robustness.py [--json]      (about 20 short simulations; the full disk needs root, else it is left out)

Asked: one clear message, exit code 1 or 2, no traceback, nothing lost or half-written, the same features when run again.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lacli.cli.console import print_json, print_table
from lacli.contracts.bundle import Bundle, load, save
from lacli.contracts.labels import ENDO, OTHER
from lacli.motion.annulus import FILE as MOTION
from lacli.synthetic.atrium import synthesize

LACLI = [sys.executable, "-c", "from lacli.cli.main import run; run()"]
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


@dataclass(frozen=True)
class Verdict:
    """One mishap: what the user read, and whether all that was asked held."""

    case: str
    exit_code: int
    message: str
    passed: bool
    aftermath: str = ""


class Place:
    """A folder with a good bundle, and what is needed to spoil it."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.root = folder, folder / "runs"
        self.bundle_folder = folder / "la"
        self.bundle, self.motion = synthesize(1, cell_size_mm=6.0)
        self.write(self.bundle)
        self.scene = folder / "scene.toml"
        self.scene.write_text(SCENE.format(bundle="la"))

    def write(self, bundle: Bundle) -> None:
        save(bundle, self.bundle_folder)
        m = self.motion
        np.savez(
            self.bundle_folder / MOTION,
            times=m.times,
            wall_point=m.wall_point,
            positions=m.positions,
            es_time=np.array(m.es_time),
        )

    def command(self, *more: str) -> list[str]:
        return [*LACLI, "simulate", str(self.scene), "--out", str(self.root), "--no-figures", "--json", *more]

    def simulate(self, *more: str, **environment: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            self.command(*more), capture_output=True, text=True, check=False, timeout=900, env={**os.environ, **environment}
        )


def one_message(case: str, answer: subprocess.CompletedProcess[str], words: str, code: int = 1) -> Verdict:
    """Exit code, one message with ``words``, no traceback."""
    lines = [line for line in answer.stderr.strip().splitlines() if line.strip()]
    text = " ".join(line for line in lines if not line.lstrip()[:1].isdigit())  # without the progress lines
    passed = answer.returncode == code and words in text and "Traceback" not in answer.stderr
    return Verdict(case, answer.returncode, text[-220:], passed)


def bad_input(place: Place) -> Iterator[Verdict]:
    good = place.bundle

    def changed(array: str, at: int, value: object) -> Bundle:
        copy = getattr(good, array).copy()
        copy[at] = value
        return replace(good, **{array: copy})

    def twice() -> Bundle:
        n = len(good.points)
        stacked = {name: np.concatenate([getattr(good, name)] * 2) for name in ("region", "tags")}
        return Bundle(
            points=np.vstack([good.points, good.points + 200]),
            tets=np.vstack([good.tets, good.tets + n]),
            triangles=np.vstack([good.triangles, good.triangles + n]),
            **stacked,
        )

    endo = int(np.flatnonzero(good.tags == ENDO)[0])
    spoilt: list[tuple[str, Bundle, str]] = [
        ("wrong units (micrometres)", replace(good, points=good.points * 1000), "micrometres"),
        ("NaN in a mesh", changed("points", 5, np.nan), "not finite"),
        ("inverted cell", changed("tets", 3, good.tets[3][[0, 2, 1, *range(3, good.tets.shape[1])]]), "inverted"),
        ("two unconnected pieces", twice(), "unconnected"),
        ("unknown region", changed("region", 3, 9), "unknown region 9"),
        ("missing tag", changed("tags", endo, OTHER), "cavity surface"),
    ]
    for case, bundle, words in spoilt:
        place.write(bundle)
        yield one_message(case, place.simulate(), words)
    place.write(good)
    (place.bundle_folder / "wall.vtu").write_bytes((place.bundle_folder / "wall.vtu").read_bytes()[:5000])
    yield one_message("damaged file", place.simulate(), "cannot be read")
    place.write(good)
    yield one_message("unknown key", place.simulate("--set", "loads.epd_mmhg=8"), "unknown key", code=2)
    yield one_message("FreeFEM missing", place.simulate(LACLI_FREEFEM="/nowhere/FreeFem++"), "no such program")
    yield one_message("time-out", place.simulate("--set", "numerics.timeout_s=0.2"), "0.2 s")


def features_of(answer: subprocess.CompletedProcess[str]) -> dict[str, float]:
    found = json.loads(answer.stdout)["features"]
    return {name: value for name, value in found.items() if isinstance(value, float) and name.endswith(("_ml", "_mm"))}


def children(pid: int) -> list[int]:
    try:
        return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    except OSError:
        return []


def running(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


def freefem_of(lacli: subprocess.Popen[str]) -> list[int]:
    """The run's FreeFEM, not the short one by which lacli finds out whether FreeFEM works."""
    found = []
    for pid in children(lacli.pid):
        with suppress(OSError):  # a short one that has ended by now
            line = Path(f"/proc/{pid}/cmdline").read_bytes()
            if b"FreeFem" in line and b".tmp-" in line:
                found.append(pid)
    return found


def shot(place: Place, case: str, after_s: float, whom: str, how: signal.Signals, expected: dict[str, float]) -> Verdict:
    """Send ``how`` to lacli or to FreeFEM some seconds after FreeFEM has started; then run again."""
    setting = f"numerics.timeout_s={3600 + np.random.default_rng().random():.6f}"  # a key of its own, the same physics
    with subprocess.Popen(place.command("--set", setting), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as lacli:
        while not (solver := freefem_of(lacli)) and lacli.poll() is None:
            time.sleep(0.01)
        time.sleep(after_s)
        for pid in [lacli.pid] if whom == "lacli" else freefem_of(lacli):
            os.kill(pid, how)
        _, said = lacli.communicate(timeout=900)
    end = time.monotonic() + 3
    while any(map(running, solver)) and time.monotonic() < end:
        time.sleep(0.05)
    orphans = sum(map(running, solver))
    again = place.simulate("--set", setting)
    same = again.returncode == 0 and all(abs(value - expected[name]) < 1e-9 for name, value in features_of(again).items())
    leftovers = len(list(place.root.glob(".tmp-*")))
    lines = [line for line in said.strip().splitlines() if not line.lstrip()[:1].isdigit()]
    message = " ".join(lines)[-220:]
    ok = same and not orphans and not leftovers and "Traceback" not in said and (bool(message) or how == signal.SIGKILL)
    aftermath = f"{orphans} orphans, {leftovers} leftovers, run again: {'same features' if same else 'NOT the same'}"
    return Verdict(f"{case} after {after_s:.1f} s", lacli.returncode, message, ok, aftermath)


def mishaps(place: Place) -> Iterator[Verdict]:
    first = place.simulate()
    if first.returncode != 0:
        yield one_message("a plain simulation", first, "", code=0)
        return
    expected = features_of(first)
    lasting = json.loads(first.stdout)["manifest"]["wall_s"]
    for share in (0.1, 0.5, 0.9):
        yield shot(place, "kill -9 of FreeFEM", share * lasting, "FreeFEM", signal.SIGKILL, expected)
        yield shot(place, "kill -9 of lacli", share * lasting, "lacli", signal.SIGKILL, expected)
    yield shot(place, "Ctrl-C", 0.5 * lasting, "lacli", signal.SIGINT, expected)
    yield damaged_product(place, expected)
    yield from full_disk(place, expected)


def damaged_product(place: Place, expected: dict[str, float]) -> Verdict:
    folder = Path(json.loads(place.simulate().stdout)["folder"])
    (folder / "features.json").write_text("{")
    again = place.simulate()
    same = again.returncode == 0 and features_of(again) == expected
    return Verdict("a product cut short", again.returncode, "", same, "run again: same features" if same else "NOT the same")


@contextmanager
def tiny_disk(folder: Path, size: str) -> Iterator[bool]:
    folder.mkdir(exist_ok=True)
    mount = ["mount", "-t", "tmpfs", "-o", f"size={size}", "none", str(folder)]
    mounted = subprocess.run(mount, capture_output=True, check=False).returncode == 0
    try:
        yield mounted
    finally:
        if mounted:
            subprocess.run(["umount", str(folder)], check=True)


def full_disk(place: Place, expected: dict[str, float]) -> Iterator[Verdict]:
    home = place.root
    whole = sum(path.stat().st_size for path in Path(json.loads(place.simulate().stdout)["folder"]).rglob("*") if path.is_file())
    for share in (0.1, 0.8):
        size = f"{max(48, int(share * whole / 1024))}k"
        with tiny_disk(place.folder / "disk", size) as mounted:
            if not mounted:
                return
            place.root = place.folder / "disk" / "runs"
            answer = place.simulate()
            verdict = one_message(f"disk full ({size})", answer, "disk is full")
            done = [path for path in place.root.glob("*/manifest.json") if json.loads(path.read_text())["status"] == "done"]
            resize = ["mount", "-o", "remount,size=200m", str(place.folder / "disk")]
            subprocess.run(resize, check=True)
            again = place.simulate()
            same = again.returncode == 0 and features_of(again) == expected
            yield replace(
                verdict,
                passed=verdict.passed and not done and same,
                aftermath=f"space made: {'same features' if same else 'NOT the same'}",
            )
    place.root = home


def main() -> None:
    """Print a line for each mishap; exit code 1 if one did not go as asked."""
    with tempfile.TemporaryDirectory(prefix="lacli-robustness-") as folder:
        place = Place(Path(folder))
        load(place.bundle_folder)
        sources: list[Callable[[Place], Iterator[Verdict]]] = [bad_input, mishaps]
        verdicts = [verdict for source in sources for verdict in source(place)]
    if "--json" in sys.argv:
        print_json([vars(verdict) for verdict in verdicts])
    else:
        rows = [[v.case, "as asked" if v.passed else "NOT as asked", v.exit_code, v.aftermath, v.message] for v in verdicts]
        print_table("Mishaps", ["case", "verdict", "exit code", "aftermath", "message"], rows)
    sys.exit(not all(verdict.passed for verdict in verdicts))


if __name__ == "__main__":
    main()
