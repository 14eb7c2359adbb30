"""Hostile input to every reader: what the user reads, how long it takes, how much memory, and whether the answer changes.

python benchmarks/hostile.py [--cases 1000] [--seed 0] [--only READER] [--case NUMBER] [--workers 2] [--record FILE] [--json]

Each case damages one file of a good set and runs the cheapest command that reads it, in a process of its own with limits.
Asked of every case: one message with exit code 1 or 2, or the answer of the undamaged input, or another one with a note.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import multiprocessing
import os
import random
import re
import resource
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import records
from hostile_files import by_arrays, by_bytes, by_cells, by_words, copy

LIMIT_S, LIMIT_MB, ADDRESS_SPACE = 60, 2048, 12 << 30
_CHATTER = re.compile(r"Warning|warn\(|vtk|VTK|ERR\||ITK|libpng|HDF5|Exception|errno", re.IGNORECASE)
ASKED = "0 each of: traceback, other answer unsaid, nonsense planned, library's own words, hang, over 2 GB, odd exit code"

SCENE = """[anatomy]
bundle = "la"
[materials]
c_kpa = 1.7
alpha = 1.0
[loads]
edp_mmhg = 2
esp_mmhg = 14
[numerics]
order = 1
[outputs]
frames = 0
fields = "none"
"""
PLAN = ("simulate", "scene.toml", "--dry-run", "--json")
# scene keys for --set, with what cannot be
SETTINGS = (
    "loads.esp_mmhg", "loads.edp_mmhg", "materials.c_kpa", "materials.alpha", "materials.c_kpa.roof", "materials.bf",
    "materials.kappa_kpa", "pericardium.k_peri_kpa_per_um", "pericardium.pth", "pericardium.ramp", "motion.amplitude_mm",
    "motion.es_time", "numerics.tolerance_mm", "numerics.timeout_s", "numerics.max_newton", "outputs.frames", "loads.nonsense",
    "loads", "numerics.order", "loads.vein_spring_kpa_per_um", "materials.ring_c_kpa", "numerics.kappa_points_kpa",
)  # fmt: skip
NONSENSE = ("1e9", "-1", "nan", "inf", "1e308", "1e-300", "'text'", "true", "[1]", "{}", "9" * 5000, "", "[" * 2000, "0")


@dataclass(frozen=True)
class Reader:
    """The file that is damaged, the command that reads it, how it is damaged, its share of the cases."""

    name: str
    file: str
    command: tuple[str, ...]
    ways: tuple[Callable[[random.Random], tuple[str, Callable[[Path], None]]], ...]
    share: float = 1.0


FIT = ("--no-figures", "--json")
LABELS, SURFACE = ("--la", "9", "--out", "out"), ("--out", "out", "--no-pictures")
EMULATE = ("emulate", "--inputs", "X.csv", "--outputs", "Y.csv", "--out", "e2.npz", *FIT)
RANK = ("sensitivity", "--emulators", "e.npz", "--box", "b.toml", "--out", "se", *FIT)
MATCH = ("match", "--emulators", "e.npz", "--targets", "t.toml", "--box", "b.toml", "--out", "m", *FIT)
SAMPLE = ("posterior", *MATCH[1:7], "--prior", "box", "--ess", "50", "--out", "p", *FIT)
RUN = ("simulate", "scene.toml", "--out", "runs", *FIT)
# what is damaged in a checked format must not change the answer; another number in a text is another input
WRITTEN = ("scene", "set", "box", "targets", "inputs", "outputs", "landmarks")
READERS = (
    Reader("scene", "scene.toml", PLAN, (by_words, by_words, by_bytes), 3.0),
    Reader("set", "", PLAN, (), 3.0),
    Reader("wall", "la/wall.vtu", PLAN, (by_bytes,), 1.5),
    Reader("boundary", "la/boundary.vtp", PLAN, (by_bytes,), 1.5),
    Reader("anatomy", "la/anatomy.json", PLAN, (by_bytes,)),
    Reader("motion", "la/motion.npz", PLAN, (by_arrays, by_arrays, by_bytes), 2.0),
    *(
        Reader(f"labels {end}", f"labels.{end}", ("mesh", f"labels.{end}", *LABELS), (by_bytes,))
        for end in ("nrrd", "nii.gz", "mha")
    ),
    *(Reader(end, f"s.{end}", ("mesh", f"s.{end}", *SURFACE), (by_bytes,)) for end in ("stl", "ply", "vtp", "vtk", "obj")),
    *(Reader(f"carp {end}", f"c.{end}", ("mesh", "c.elem", *SURFACE), (by_bytes,)) for end in ("elem", "pts")),
    Reader("landmarks", "l.toml", ("mesh", "s.stl", "--landmarks", "l.toml", *SURFACE), (by_words, by_bytes)),
    Reader("inputs", "X.csv", EMULATE, (by_cells, by_bytes), 2.0),
    Reader("outputs", "Y.csv", EMULATE, (by_cells, by_bytes), 2.0),
    Reader("emulators", "e.npz", RANK, (by_arrays, by_bytes), 2.0),
    Reader("box", "b.toml", RANK, (by_words, by_bytes), 1.5),
    Reader("targets", "t.toml", MATCH, (by_words, by_bytes), 1.5),
    Reader("chain", "p/chain.npz", SAMPLE, (by_arrays, by_bytes), 1.5),
    Reader("run", "runs/*/manifest.json", RUN, (by_bytes,), 0.5),
    Reader("features", "runs/*/features.json", RUN, (by_bytes,), 0.5),
)


@dataclass(frozen=True)
class Verdict:
    """A case: its number, reader, damage, what came of it, what the user read, seconds, MB."""

    case: int
    reader: str
    damage: str
    verdict: str
    words: str
    wall_s: float
    memory_mb: float


def good_set(folder: Path) -> None:
    """Files that every command takes (or, for surfaces, refuses for what they are)."""
    import pyvista as pv
    import SimpleITK as sitk

    from lacli.contracts.bundle import save
    from lacli.contracts.motion import save_motion
    from lacli.synthetic.atrium import synthesize

    bundle, motion = synthesize(1, cell_size_mm=9.0, order=1)
    save(bundle, folder / "la")
    save_motion(motion, folder / "la")
    (folder / "scene.toml").write_text(SCENE)
    array = np.zeros((24, 26, 28), np.uint8)
    array[6:18, 6:20, 6:22] = 2
    image = sitk.GetImageFromArray(array)
    image.SetSpacing((3.0, 3.0, 3.0))
    for name in ("labels.nrrd", "labels.nii.gz", "labels.mha"):
        sitk.WriteImage(image, str(folder / name), useCompression=True)
    ball = pv.Sphere(radius=25.0, theta_resolution=24, phi_resolution=24)
    for name in ("s.stl", "s.ply", "s.vtp", "s.vtk", "s.obj"):
        ball.save(folder / name)
    faces = ball.faces.reshape(-1, 4)[:, 1:]
    np.savetxt(folder / "c.pts", 1000.0 * np.asarray(ball.points), header=str(ball.n_points), comments="", fmt="%.3f")
    rows = "\n".join(f"Tr {a} {b} {c} 1" for a, b, c in faces)
    (folder / "c.elem").write_text(f"{len(faces)}\n{rows}\n")
    (folder / "l.toml").write_text("[mv]\ncentre = [0.0, 0.0, -25.0]\nnormal = [0.0, 0.0, -1.0]\n")
    rng = np.random.default_rng(1)
    x = rng.uniform(0.5, 4.0, (24, 2))
    for name, heading, table in (("X.csv", "a,b", x), ("Y.csv", "v_ml,d_mm", np.c_[50 + 10 / x[:, 0], x.sum(1)])):
        np.savetxt(folder / name, table, delimiter=",", header=heading, comments="")
    (folder / "t.toml").write_text("[targets.v_ml]\nmean = 55.0\nsd = 1.0\n[targets.d_mm]\nmean = 4.0\nsd = 0.3\n")
    (folder / "b.toml").write_text("[box]\na = [0.6, 3.9]\nb = [0.6, 3.9]\n")
    by_name = {reader.name: reader for reader in READERS}
    for name, out in (("inputs", "e.npz"), ("chain", "p"), ("run", "runs")):
        words = [out if word == "e2.npz" else word for word in by_name[name].command]
        code, said, output, *_ = call(words, folder)
        if code != 0:
            raise SystemExit(f"the good set itself is refused ({code}): {' '.join(words)}: {said} {output}")


def call(words: list[str] | tuple[str, ...], folder: Path) -> tuple[int | None, str, str, float, float]:
    """Exit code (None: it hung), standard error, standard output, seconds, MB of one command in a forked process."""
    start = time.monotonic()
    outputs = [folder / ".out", folder / ".err"]
    child = os.fork()
    if child == 0:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        os.chdir(folder)
        os.setsid()
        for number, file in enumerate(outputs, 1):
            os.dup2(os.open(file, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
        resource.setrlimit(resource.RLIMIT_AS, (ADDRESS_SPACE, ADDRESS_SPACE))
        sys.argv = ["lacli", *words]
        from lacli.cli.main import run

        try:
            run()
        except SystemExit as ended:
            os._exit(ended.code if isinstance(ended.code, int) else 1)
        except BaseException:
            import traceback

            traceback.print_exc()
            sys.stderr.flush()
            os._exit(99)
    code: int | None = None
    while time.monotonic() - start < LIMIT_S:
        done, status, usage = os.wait4(child, os.WNOHANG)
        if done:
            code = os.waitstatus_to_exitcode(status)
            break
        time.sleep(0.02)
    else:
        os.killpg(child, signal.SIGKILL)
        _, _, usage = os.wait4(child, 0)
    text = [file.read_text(errors="replace") if file.exists() else "" for file in outputs]
    return code, text[1], text[0], time.monotonic() - start, usage.ru_maxrss / 1024


def answer(output: str) -> str:
    """What a command found, without what differs from call to call (seconds, memory, places)."""
    passing = r'"(?:[a-z_]*(?:cpu_s|wall_s|memory_mb|_s)|started|finished|key|already|folder|repeated|seconds)": [^\n]*'
    text = re.sub(passing, "", output)
    return re.sub(r"/tmp/[^\s\"]*", "", text)


def plan(case: int, seed: int) -> tuple[Reader, random.Random]:
    """The reader and the hand of one case."""
    rng = random.Random(f"{seed} {case}")
    return rng.choices(READERS, [reader.share for reader in READERS])[0], rng


def judge(case: int, seed: int, good: Path, place: Path, wanted: dict[str, tuple[int, str]], only: Reader | None) -> Verdict:
    """Do one case in ``place``."""
    reader, rng = plan(case, seed)
    reader = only or reader
    copy(good, place)
    words = list(reader.command)
    if reader.name == "set":
        key, value = rng.choice(SETTINGS), rng.choice(NONSENSE)
        words += ["--set", f"{key}={value}"]
        damage = f"{key}={value[:12]}"
    else:
        damage, change = rng.choice(reader.ways)(rng)
        change(next(iter(place.glob(reader.file))))
    code, said, output, wall_s, memory_mb = call(words, place)
    verdict = _verdict(code, said, output, memory_mb, wanted[reader.name])
    if verdict == "other answer unsaid" and reader.name in WRITTEN:
        verdict = "nonsense planned" if _nonsense(reader.name, damage) else "another input, taken"
    return Verdict(case, reader.name, damage, verdict, said.strip()[-600:], round(wall_s, 1), round(memory_mb))


def _nonsense(reader: str, damage: str) -> bool:
    """Whether what was written where a number belongs cannot be one."""
    how, _, word = damage.partition(" ")
    if (reader, word) == ("box", "[1, 2]") or (how == "heading" and word in ("oops", "True")):
        return False  # a range, a name
    return any(word in damage for word in ("nan", "inf", "1e400", "1e308", "1e9", "999", "text", "true", "[", "oops", "=-1"))


def _verdict(code: int | None, said: str, output: str, memory_mb: float, wanted: tuple[int, str]) -> str:
    if code is None:
        return "hang"
    if "Traceback" in said or code == 99:
        return "traceback"
    if memory_mb > LIMIT_MB:
        return "over 2 GB"
    if code not in (0, 1, 2):
        return "odd exit code"
    messages = [line for line in said.splitlines() if line.strip()]
    own = [line for line in messages if line.startswith(("lacli:", "note:", "warning:"))]
    if any(_CHATTER.search(line) for line in messages if line not in own):
        return "library's own words"
    if code:
        told = [line for line in own if line.startswith("lacli:")]
        return "refused" if len(told) == 1 else "refused without one message"
    if wanted[0] == 0 and answer(output) == wanted[1]:
        return "same answer"
    told = any(line.startswith(("note:", "warning:")) or "made again" in line for line in messages)
    return "other answer, said" if told else "other answer unsaid"


def cases(numbers: list[int], seed: int, only: Reader | None, workers: int) -> Iterator[Verdict]:
    """All verdicts as they come."""
    # no TemporaryDirectory: a forked child that ends would take it along
    name = tempfile.mkdtemp(prefix="lacli-hostile-")
    try:
        good = Path(name) / "good"
        good.mkdir()
        os.environ["XDG_CACHE_HOME"] = os.environ.get("XDG_CACHE_HOME", str(Path.home() / ".cache"))
        good_set(good)
        wanted = {}
        for reader in READERS:
            place = Path(name) / "wanted"
            copy(good, place)
            code, _, output, *_ = call(reader.command, place)
            wanted[reader.name] = (code if code is not None else -1, answer(output))
            shutil.rmtree(place)
        _load()
        with multiprocessing.get_context("fork").Pool(workers) as pool:
            todo = [(case, seed, good, Path(name) / f"case_{case}", wanted, only) for case in numbers]
            yield from pool.imap_unordered(_one, todo)
    finally:
        shutil.rmtree(name, ignore_errors=True)


def _load() -> None:
    """Load once what every case's process would load anew."""
    import importlib

    for module in ("pandas", "scipy.stats", "sklearn.mixture", "pyvista", "meshio", "SALib", "emcee", "statsmodels.api"):
        with contextlib.suppress(ImportError):
            importlib.import_module(module)


def _one(task: tuple[Any, ...]) -> Verdict:
    try:
        return judge(*task)
    finally:
        shutil.rmtree(task[3], ignore_errors=True)


FINE = ("refused", "same answer", "other answer, said", "another input, taken")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", choices=[reader.name for reader in READERS])
    parser.add_argument("--case", type=int, help="this case alone")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--record", type=Path, help="verdicts as they come, a line each; started again, its cases are not redone")
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args()
    only = next((reader for reader in READERS if reader.name == given.only), None)
    numbers = [given.case] if given.case is not None else list(range(given.cases))
    found = records.read(given.record, Verdict)
    counts = Counter(verdict.verdict for verdict in found)
    known = {verdict.case for verdict in found}
    for verdict in cases([n for n in numbers if n not in known], given.seed, only, given.workers):
        found.append(verdict)
        records.add(given.record, verdict)
        counts[verdict.verdict] += 1
        if verdict.verdict not in FINE or given.case is not None:
            print(f"{verdict.case} {verdict.reader}, {verdict.damage}: {verdict.verdict}\n    {verdict.words[-300:]}", flush=True)
    if given.json:
        print(json.dumps([asdict(verdict) for verdict in found]))
    print(f"asked: {ASKED}\nmeasured over {len(found)} cases, seed {given.seed}: {dict(counts.most_common())}")
    print(f"slowest {max(v.wall_s for v in found):.0f} s, most memory {max(v.memory_mb for v in found):.0f} MB")


if __name__ == "__main__":
    main()
