"""The README's picture: the example's synthetic atrium at end-diastole and end-systole. ``python docs/picture.py`` makes it."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

from PIL import Image

HERE = Path(__file__).resolve().parent
LARGEST_BYTES = 200_000


def lacli(*words: str) -> Any:
    """What a command says, as JSON."""
    call = [sys.executable, "-m", "lacli", *words, "--json"]
    return json.loads(subprocess.run(call, cwd=HERE.parent, check=True, capture_output=True, text=True, timeout=1800).stdout)


def main() -> None:
    """Simulate the example (or take what is stored) and write ``result.png``."""
    lacli("synthesize", "results/synthetic")
    run = lacli("simulate", "examples/scene.toml", "--out", "results/runs")
    with Image.open(Path(HERE.parent, run["folder"], "shapes.png")) as picture:
        small = picture.convert("RGB")
        small.thumbnail((680, 680))
        # all colours: with fewer, the legend would lose those of small regions
        small.save(HERE / "result.png", optimize=True)
    size = (HERE / "result.png").stat().st_size
    if size >= LARGEST_BYTES:
        raise SystemExit(f"result.png has {size} bytes; fewer than {LARGEST_BYTES} are wanted")


if __name__ == "__main__":
    main()
