"""Scores the naming of synthetic atria in all their forms, without meshing: right, doubted, silently wrong.

Run: python benchmarks/variants.py [--first 1] [--seeds 25] [--only WORD]; whole bundles: atria.py --synthetic N

Right: each opening of the file has its name, within 10 mm of its centre, with the confidence that `lacli mesh` asks for. Each
atrium is named again with every vein left out in turn: there anything but a refusal is silently wrong.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections import Counter, defaultdict
from pathlib import Path
from typing import Any

import numpy as np

from lacli.anatomy.inputs import repair
from lacli.anatomy.inputs.meshes import anything
from lacli.anatomy.inputs.voxels import voxel_field
from lacli.anatomy.openings import branches, finding, naming
from lacli.anatomy.openings.candidate import Candidate, halves
from lacli.base.errors import AnatomyError
from lacli.synthetic.variants import write


def places(named: naming.Naming, everything: list[Candidate]) -> dict[str, np.ndarray]:
    """Centre (3,) mm of each named opening, of a common trunk's two veins apart."""
    found = {n: everything[i].centre for n, i in named.best.names.items()}
    if named.best.trunk is not None:
        found |= {
            n: h.centre for n, h in zip(named.best.trunk, halves(everything[named.best.names[named.best.trunk[0]]]), strict=True)
        }
    return found


def certain(named: naming.Naming | None) -> bool:
    """Whether `lacli mesh` would go on."""
    return (
        named is not None
        and not named.best.missing
        and named.confidence >= naming.LEAST_CONFIDENCE
        and named.best.cost <= naming.MOST_COST
    )


def verdict(truth: dict[str, Any], everything: list[Candidate]) -> str:
    """Of one atrium."""
    named = naming.assign(everything, None)
    if named is None or not certain(named):
        return "doubted"
    scale = 10.0 if truth["units"] == "cm" else 1.0
    found = places(named, everything)
    wanted = {("appendage" if n == "laa" else n): scale * np.array(c) for n, c in truth["openings"].items()}
    ok = all(n in found and np.linalg.norm(found[n] - c) <= truth["tol_mm"] for n, c in wanted.items())
    return "right" if ok else "silently wrong"


def main() -> None:
    """All variants, counts each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--first", type=int, default=1, help="the first seed, so that a run can be done in pieces")
    parser.add_argument("--seeds", type=int, default=25)
    parser.add_argument("--only", default="", help="files whose name holds this word")
    asked = parser.parse_args()
    start = time.process_time()
    count: dict[str, Counter[str]] = defaultdict(Counter)
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        write(folder, range(asked.first, asked.first + asked.seeds), asked.only)
        for truth in json.loads((folder / "truth.json").read_text()):
            kind = truth["file"].split("_")[0]
            mesh = anything.read(folder / truth["file"])
            try:
                whole = repair.repair(mesh.points, mesh.triangles)
            except AnatomyError as error:
                count[kind]["refused"] += 1
                print(truth["file"], "refused:", error)
                continue
            skeleton = branches.find(voxel_field(whole.surface, 1.0))
            everything, _ = finding.gather(whole.surface, list(whole.rims), skeleton, None)
            got = verdict(truth, everything)
            count[kind][got] += 1
            if got != "right":
                print(truth["file"], got, flush=True)
            if kind in ("trunk", "five"):
                continue  # without one vein these are other atria, maybe whole ones
            scale = 10.0 if truth["units"] == "cm" else 1.0
            for name in naming.VEINS:
                centre = scale * np.array(truth["openings"][name])
                less = [c for c in everything if np.linalg.norm(c.centre - centre) > 3.0]
                wrong = certain(naming.assign(less, None))
                count["one vein less"]["silently wrong" if wrong else "refused, as it should be"] += 1
    for kind, counts in count.items():
        print(f"{kind:<16}{dict(counts)}")
    forms = [c for kind, c in count.items() if kind != "one vein less"]
    total = sum(sum(c.values()) for c in forms)
    right, wrong = sum(c["right"] for c in forms), sum(c["silently wrong"] for c in forms)
    share = 100 * right / max(total, 1)
    print(f"right {right} of {total} ({share:.1f} %), silently wrong {wrong}; CPU {time.process_time() - start:.0f} s")


if __name__ == "__main__":
    main()
