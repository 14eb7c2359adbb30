"""What a user sees when something goes wrong: a mishap is arranged, a command run, message and aftermath judged.

python benchmarks/robustness.py [--shots 100] [--seed 0] [--only-shots] [--record FILE] [--place FOLDER] [--json]
(the full disk needs root, else it is left out)

Asked: one clear message, exit code 1 or 2, no traceback, nothing lost or half-written, the same features when run again.
Of shots (shots.py) at simulate, design, calibrate and mesh, their FreeFEM, workers and compilers, at random moments: products
equal to the undisturbed ones, no orphan after 1 s, no lock or temporary left, each signal said, exit code 128 + n.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from shots import Range, Shot, shots

from lacli.cli.terminal.console import err, print_json, print_table
from lacli.contracts.bundle import Bundle, load, save
from lacli.contracts.labels import ENDO, OTHER
from lacli.contracts.motion import save_motion
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
        save_motion(self.motion, self.bundle_folder)

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


def mishaps(place: Place) -> Iterator[Verdict]:
    first = place.simulate()
    if first.returncode != 0:
        yield one_message("a plain simulation", first, "", code=0)
        return
    expected = features_of(first)
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


def volley(folder: Path, count: int, seed: int, record: Path | None) -> Iterator[Verdict]:
    """Shots at random moments, one line each on standard error; verdicts by target, victim and signal."""

    def tell(shot: Shot) -> None:
        faults = "; ".join(shot.faults) or "as asked"
        err.print(f"{shot.target}: {shot.how} of {shot.victim} after {shot.after_s:.1f} s: {faults}", highlight=False)
        if shot.faults:
            err.print(shot.said, highlight=False, markup=False, soft_wrap=True)

    place = Range(folder)
    landed, misses = shots(place, count, seed, tell, record)
    if importlib.util.find_spec("distributed") is not None:
        from shots_cluster import cluster_shots

        landed += cluster_shots(place, count // 7, seed, tell, record)
    groups: dict[tuple[str, str, str], list[Shot]] = {}
    for shot in landed:
        groups.setdefault((shot.target, shot.victim, shot.how), []).append(shot)
    for (target, victim, how), group in sorted(groups.items()):
        good = sum(not shot.faults for shot in group)
        faults = "; ".join(fault for shot in group for fault in shot.faults)
        verdict = Verdict(f"{target}: {how} of {victim}", group[-1].exit_code, group[-1].said[-120:], good == len(group))
        yield replace(verdict, aftermath=f"{good} of {len(group)} shots as asked" + (f" ({faults})" if faults else ""))
    good = sum(not shot.faults for shot in landed)
    missed = ", ".join(f"{name}: {number}" for name, number in misses.items()) or "none"
    total = Verdict(f"{len(landed)} shots that landed", 0, f"missed, and shot again: {missed}", good == len(landed))
    yield replace(total, aftermath=f"{good} of {len(landed)} as asked")


def main() -> None:
    """Print a line for each mishap; exit code 1 if one did not go as asked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--shots", type=int, default=100, help="shots that land; 0: none")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only-shots", action="store_true", help="leave the other mishaps out")
    parser.add_argument("--record", type=Path, help="shots as they land, a line each; started again, these are not shot again")
    parser.add_argument("--place", type=Path, help="where what is shot at is made; kept, for another call")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    # started in the background, or by nohup, signals are ignored, and that would be passed on
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    with tempfile.TemporaryDirectory(prefix="lacli-robustness-") as folder:
        verdicts: list[Verdict] = []
        if not options.only_shots:
            place = Place(Path(folder))
            load(place.bundle_folder)
            sources: list[Callable[[Place], Iterator[Verdict]]] = [bad_input, mishaps]
            verdicts += [verdict for source in sources for verdict in source(place)]
        if options.shots:
            place_of_shots = options.place or Path(folder) / "range"
            place_of_shots.mkdir(parents=True, exist_ok=True)
            verdicts += volley(place_of_shots, options.shots, options.seed, options.record)
    if options.json:
        print_json([vars(verdict) for verdict in verdicts])
    else:
        rows = [[v.case, "as asked" if v.passed else "NOT as asked", v.exit_code, v.aftermath, v.message] for v in verdicts]
        print_table("Mishaps", ["case", "verdict", "exit code", "aftermath", "message"], rows)
    sys.exit(not all(verdict.passed for verdict in verdicts))


if __name__ == "__main__":
    main()
