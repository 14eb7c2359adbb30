"""Scores a folder of atria with their truth: right, wrong with a warning, silently wrong, refused, no answer, traceback.

Run: python benchmarks/atria.py FOLDER [--simulate] [--only WORD]   FOLDER holds the files and truth.json
     python benchmarks/atria.py --synthetic 25 [--only WORD]       seeds x variants, made here
     ... --record FILE.jsonl    a line a file as it is done; those that stand there are not run again

A refusal is answered once as a user would: the landmarks that it left get the true place of each opening that its message asks
for, its normal from the middle of the veins outward, and the same command runs again.

Right: every opening that the file has is named and within its tolerance, five regions, a closed ring and plane round each. An
anatomy that may be refused counts as it should be either way. Each runs in a process of its own, with a time limit.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path
from typing import Any

import numpy as np

LIMIT_CPU_S, LIMIT_S = 120, 3600  # of processor time (a shared machine must not turn a right answer into none), of the clock
LACLI = [sys.executable, "-c", "from lacli.cli.main import run; run()"]
NEEDED = ("mv", "rspv", "ripv", "lspv", "lipv")
SCALE = {"mm": 1.0, "um": 1e-3, "cm": 10.0, "m": 1e3}
KINDS = ("right", "rightly refused", "wrong, warned", "silently wrong", "refused", "no answer", "traceback")


def centres(bundle: Any) -> dict[str, np.ndarray]:
    """Centre (3,) mm of each opening's plane: of its largest piece."""
    from lacli.contracts.labels import PLANES
    from lacli.geometry.curves import triangle_components
    from lacli.geometry.triangles import area_normals

    found = {}
    for name, value in PLANES.items():
        faces = bundle.triangles[bundle.tags == value, :3]
        if len(faces):
            _, part = triangle_components(faces)
            area = np.linalg.norm(area_normals(bundle.points[faces]), axis=1)
            mine = part == np.argmax(np.bincount(part, area))
            found[name] = np.average(bundle.points[faces[mine]].mean(axis=1), axis=0, weights=area[mine])
    return found


def judge(truth: dict[str, Any], bundle: Any, scale: float) -> list[str]:
    """What is wrong with a bundle, in words; nothing if it is right."""
    from lacli.contracts.labels import REGIONS, RINGS

    found = centres(bundle)
    wrong = []
    for name, place in truth["openings"].items():
        name = {"laa": "appendage"}.get(name, name)
        if name not in found:
            if name in NEEDED or (name == "appendage" and truth["appendage"] == "open"):
                wrong.append(f"{name} missing")
            continue
        if name == "appendage" and truth["appendage"] != "open":
            continue  # a closed one has no centre to compare with
        gap = float(np.linalg.norm(found[name] - scale * np.array(place)))
        if gap > truth["tol_mm"]:
            wrong.append(f"{name} {gap:.0f} mm off")
    here = set(np.unique(bundle.region).tolist())
    wrong += [f"no {n}" for n, v in REGIONS.items() if v not in here]
    wrong += [f"no ring of {n}" for n in NEEDED if RINGS[n] not in here]
    return wrong


def one(file: Path, truth: dict[str, Any], simulate: bool) -> dict[str, Any]:
    """Mesh a file as the command does, in a process of its own, and judge; a refusal is answered once."""
    with tempfile.TemporaryDirectory() as place:
        out = Path(place) / "anatomy"
        got = meshed(file, truth, out, [])
        if got["kind"] in ("refused", "rightly refused"):
            answer = answered(truth, out.with_name("anatomy-landmarks.toml"), got["message"])
            got["helped"] = "nothing to answer"
            if answer is not None:
                again = meshed(file, truth, out, ["--landmarks", str(answer)])
                got["helped"] = again["kind"] + (f" ({again['words']})" if again["words"] else "")
        elif simulate and got["kind"] == "right":
            got["words"] += simulated(out)
        return got


def answered(truth: dict[str, Any], left: Path, message: str) -> Path | None:
    """The landmarks that a refusal left with the true places of what its message asks for; None where nothing is asked."""
    import tomli_w

    asked = {n for n in (*NEEDED, "appendage") if re.search(rf"\[{n}\]|{n.upper()} at \(", message)}
    scale = SCALE[truth["units"]]
    places = {("appendage" if n == "laa" else n): scale * np.array(p) for n, p in truth["openings"].items()}
    asked &= set(places)
    if not asked or not left.is_file():
        return None
    veins = np.mean([p for n, p in places.items() if n in NEEDED and n != "mv"], axis=0)
    table = tomllib.loads(left.read_text())
    for name in asked:
        centre = (veins + places["mv"]) / 2
        away = places[name] - (veins if name == "mv" else centre)
        table[name] = {"centre": places[name].tolist(), "normal": (away / np.linalg.norm(away)).tolist()}
    file = left.with_name("answer.toml")
    file.write_text(tomli_w.dumps(table))
    return file


def meshed(file: Path, truth: dict[str, Any], out: Path, more: list[str]) -> dict[str, Any]:
    """What the command gives: its kind, what is wrong in words, its usage."""
    words = [*LACLI, "mesh", str(file), "--out", str(out), "--no-pictures", "--json", *more]
    for name in ("la", "lv"):
        if name in truth["args"]:
            words += [f"--{name}", str(truth["args"][name])]
    run = subprocess.run([sys.executable, "-c", TIMED, *words], capture_output=True, text=True, check=False)
    lines = run.stderr.strip().splitlines()
    usage = json.loads(lines[-1]) if lines and lines[-1].startswith("{") else {"cpu_s": 0.0, "mb": 0.0}
    message = " ".join(lines[:-1])
    if "Traceback" in message:
        return {"kind": "traceback", "words": message[-200:], **usage}
    if run.returncode < 0 or run.returncode > 128:
        return {"kind": "no answer", "words": f"ended after {LIMIT_CPU_S} CPU s or {LIMIT_S} s", **usage}
    if run.returncode:
        kind = "rightly refused" if "refused" in truth["expect"] else "refused"
        return {"kind": kind, "words": message[:300], "message": message, **usage}
    from lacli.contracts.bundle import load

    wrong = judge(truth, load(out), SCALE[truth["units"]])
    report = json.loads(run.stdout)
    warned = "confiden" in " ".join(report["notes"]) or any(o["confidence"] < 0.6 for o in report["openings"].values())
    kind = "right" if not wrong else "wrong, warned" if warned else "silently wrong"
    return {"kind": kind, "words": ", ".join(wrong), "jacobian": report["scaled_jacobian_min"], **usage}


# the command in a process group of its own, with a limit on its processor time and on the clock; its usage as the last line
TIMED = f"""
import json, os, resource, signal, subprocess, sys
limit = lambda: resource.setrlimit(resource.RLIMIT_CPU, ({LIMIT_CPU_S}, {LIMIT_CPU_S}))
child = subprocess.Popen(sys.argv[1:], start_new_session=True, preexec_fn=limit)
try:
    code = child.wait(timeout={LIMIT_S})
except subprocess.TimeoutExpired:
    os.killpg(child.pid, signal.SIGKILL)
    code = child.wait()
used = resource.getrusage(resource.RUSAGE_CHILDREN)
print(json.dumps(dict(cpu_s=used.ru_utime + used.ru_stime, mb=used.ru_maxrss / 1024)), file=sys.stderr)
sys.exit(code if code >= 0 else 128 - code)
"""


def simulated(bundle: Path) -> str:
    """Whether the default simulation ends, in words."""
    words = [*LACLI, "simulate", "--help"]
    if subprocess.run(words, capture_output=True, check=False).returncode:
        return " (no simulate command)"
    scene = bundle.parent / "scene.toml"
    scene.write_text(f'[anatomy]\nbundle = "{bundle}"\n')
    # a mesh of one instant has no frames of its annulus: it stays in place
    words = [*LACLI, "simulate", str(scene), "--out", str(bundle.parent / "run"), "--set", "motion.annulus=none", "--no-figures"]
    try:
        run = subprocess.run(words, capture_output=True, text=True, timeout=3600, check=False)
    except subprocess.TimeoutExpired:
        return " simulation: no end in an hour"
    return " simulation ended" if run.returncode == 0 else f" simulation failed: {run.stderr.strip()[-200:]}"


def main() -> None:
    """All files, one line each, and the counts."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument("--synthetic", type=int, default=0, help="number of seeds")
    parser.add_argument("--simulate", action="store_true")
    parser.add_argument("--only", default="", help="files whose name holds this word")
    parser.add_argument("--record", type=Path, help="file of rows, to go on with")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as made:
        folder = asked.folder
        if asked.synthetic:
            from lacli.synthetic.variants import write

            folder = Path(made)
            write(folder, range(1, asked.synthetic + 1), asked.only)
        if folder is None:
            parser.error("give a folder, or --synthetic")
        rows = [] if asked.record is None or not asked.record.is_file() else read_rows(asked.record)
        done = {row["file"] for row in rows}
        for truth in json.loads((folder / "truth.json").read_text()):
            if asked.only in truth["file"] and truth["file"] not in done:
                got = {"file": truth["file"], **one(folder / truth["file"], truth, asked.simulate)}
                rows.append(got)
                if asked.record is not None:
                    with asked.record.open("a") as stream:
                        stream.write(json.dumps(got) + "\n")
                show(got)
        summary(rows)


def read_rows(file: Path) -> list[dict[str, Any]]:
    """Rows of an earlier run."""
    return [json.loads(line) for line in file.read_text().splitlines()]


def show(got: dict[str, Any]) -> None:
    """One line."""
    quality = f"{got['jacobian']:.3f}" if "jacobian" in got else "-"
    helped = f"  helped: {got['helped']}" if "helped" in got else ""
    figures = f"{got['cpu_s']:7.1f} s{got['mb']:7.0f} MB  SJ {quality}"
    print(f"{got['file']:<28}{got['kind']:<18}{figures}  {got['words']}{helped}", flush=True)


def summary(rows: list[dict[str, Any]]) -> None:
    """Counts and figures of all rows."""
    if not rows:
        return
    count = {kind: sum(row["kind"] == kind for row in rows) for kind in KINDS}
    print(", ".join(f"{k}: {v}" for k, v in count.items()))
    spent, quality = [row["cpu_s"] for row in rows], [row["jacobian"] for row in rows if "jacobian" in row]
    share = 100 * (count["right"] + count["rightly refused"]) / len(rows)
    print(f"as it should be {share:.0f} %, CPU s mean {np.mean(spent):.1f} max {max(spent):.1f}, "
          f"MB max {max(row['mb'] for row in rows):.0f}, least scaled Jacobian {min(quality, default=0.0):.3f}")  # fmt: skip
    helped = [row["helped"] == "right" for row in rows if "helped" in row]
    print(f"refusals that succeed with what they ask for: {sum(helped)} of {len(helped)}")


if __name__ == "__main__":
    main()
