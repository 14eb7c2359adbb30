"""Damage to files: bytes, arrays, words and cells, each by a seeded hand. Used by hostile.py."""

from __future__ import annotations

import gzip
import io
import os
import random
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

# words that a number, a text or a switch may be replaced by
WORDS = (
    "nan", "inf", "-inf", "1e400", "-1e308", "1e308", "1e-320", "-0.0", "0", "-1", "9" * 5000, "1" + "0" * 400, "true", '""',
    '"text"', "[]", "{}", "[1, 2]", "[" * 3000 + "]" * 3000, "1979-05-27", '"\\u0000"', "0x10", "1_000", "''' '''",
)  # fmt: skip
CELLS = (
    "", "nan", "inf", "-inf", "1e400", "1e308", "-9999", "1e20", "True", "oops", "1,5", "1;5", '"', "2020-01-01", "1+2j", "0x1F",
    "٣", " 1.5 ", "1.5\x00", "9" * 4000,
)  # fmt: skip


def by_bytes(rng: random.Random) -> tuple[str, Callable[[Path], None]]:
    """A way to damage any file, and its name."""
    ways: dict[str, Callable[[Path], None]] = {
        "cut short": lambda f: _rewrite(f, lambda b: b[: int(len(b) * place)]),
        "empty": lambda f: f.write_bytes(b""),
        "bits flipped": lambda f: _rewrite(f, lambda b: _flipped(b, rng)),
        "zeros inside": lambda f: _rewrite(f, lambda b: _over(b, place, b"\0" * 64)),
        "text inside": lambda f: _rewrite(f, lambda b: _over(b, place, b"\xff\xfe<oops>\r\n" * 4)),
        "a piece twice": lambda f: _rewrite(f, lambda b: b[: len(b) // 2] + b[len(b) // 4 :]),
        "halves swapped": lambda f: _rewrite(f, lambda b: b[len(b) // 2 :] + b[: len(b) // 2]),
        "noise": lambda f: f.write_bytes(rng.randbytes(min(f.stat().st_size, 1 << 16))),
        "a mark in front": lambda f: _rewrite(f, lambda b: b"\xef\xbb\xbf" + b),
        "UTF-16": lambda f: _rewrite(f, lambda b: b.decode("latin-1").encode("utf-16")),
        "zipped": lambda f: f.write_bytes(gzip.compress(f.read_bytes())),
        "a gzip bomb": lambda f: f.write_bytes(gzip.compress(bytes(1 << 28), 9)),
        "a zip bomb": _zip_bomb,
        "another format": lambda f: f.write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(512)),
        "a folder": _as_folder,
        "a link in a circle": _as_circle,
        "a pipe": _as_pipe,
        "gone": lambda f: f.unlink(),
    }
    place = rng.random()
    name = rng.choice(list(ways))
    return name, ways[name]


def by_words(rng: random.Random) -> tuple[str, Callable[[Path], None]]:
    """Damage to a document of ``key = value`` lines (TOML)."""
    word, extra = rng.choice(WORDS), rng.choice(("value", "key", "line", "keys", "deep", "twice"))

    def change(file: Path) -> None:
        lines = file.read_text().splitlines()
        at = [i for i, line in enumerate(lines) if "=" in line]
        i = rng.choice(at)
        key, _, value = lines[i].partition("=")
        if extra == "value":
            lines[i] = f"{key}= {word}"
        elif extra == "key":
            lines[i] = f"{key.strip()}_other = {value}"
        elif extra == "line":
            lines.insert(i, word)
        elif extra == "keys":
            lines.insert(i, ".".join("a" * 1 for _ in range(5000)) + " = 1")
        elif extra == "deep":
            lines.append("deep = " + "[" * 4000 + "]" * 4000)
        else:
            lines.insert(i, lines[i])
        file.write_text("\n".join(lines) + "\n")

    return f"{extra} {word[:12]}", change


def by_cells(rng: random.Random) -> tuple[str, Callable[[Path], None]]:
    """Damage to a table of comma-separated values."""
    cell, how = rng.choice(CELLS), rng.choice(("cell", "column", "heading", "row", "rows", "twice", "separator"))

    def change(file: Path) -> None:
        rows = [line.split(",") for line in file.read_text().splitlines()]
        i, j = rng.randrange(1, len(rows)), rng.randrange(len(rows[0]))
        if how == "cell":
            rows[i][j] = cell
        elif how == "column":
            for row in rows[1:]:
                row[j] = cell
        elif how == "heading":
            rows[0][j] = cell
        elif how == "row":
            rows[i] = [cell]
        elif how == "rows":
            rows = rows[: rng.randrange(3)]
        elif how == "twice":
            rows[0][j] = rows[0][0]
        text = (";" if how == "separator" else ",").join
        file.write_text("\n".join(text(row) for row in rows) + "\n")

    return f"{how} {cell[:12]}", change


def by_arrays(rng: random.Random) -> tuple[str, Callable[[Path], None]]:
    """Damage to the arrays of an .npz file."""
    ways: dict[str, Callable[[np.ndarray], Any]] = {
        "NaN": lambda a: _with(a, rng, np.nan),
        "inf": lambda a: _with(a, rng, np.inf),
        "1e308": lambda a: _with(a, rng, 1e308),
        "negative": lambda a: -a if a.dtype.kind in "fi" else a,
        "int8": lambda a: a.astype(np.int8) if a.dtype.kind in "fiub" else a,
        "half": lambda a: a.astype(np.float16) if a.dtype.kind == "f" else a,
        "complex": lambda a: a.astype(complex) if a.dtype.kind in "fi" else a,
        "text": lambda a: a.astype(str),
        "pickle": lambda a: np.array([{"a": 1}], dtype=object),
        "transposed": lambda a: a.T if a.ndim > 1 else a[None],
        "empty": lambda a: a.ravel()[:0],
        "one short": lambda a: a[:-1] if a.ndim else a[None],
        "scalar": lambda a: a.ravel()[:1].reshape(()) if a.size else a,
        "reversed": lambda a: a[::-1] if a.ndim else a,
    }
    name = rng.choice([*ways, "missing", "extra"])

    def change(file: Path) -> None:
        with np.load(file, allow_pickle=False) as data:
            arrays = {key: data[key] for key in data.files}
        key = rng.choice(sorted(arrays))
        if name == "missing":
            del arrays[key]
        elif name == "extra":
            arrays["extra"] = np.zeros(3)
        else:
            with np.errstate(all="ignore"):
                arrays[key] = ways[name](arrays[key])
        np.savez(file, **arrays)

    return name, change


def _with(a: np.ndarray, rng: random.Random, value: float) -> np.ndarray:
    if a.dtype.kind != "f" or not a.size:
        return a
    a = a.copy()
    a.reshape(-1)[rng.randrange(a.size)] = value
    return a


def _rewrite(file: Path, change: Callable[[bytes], bytes]) -> None:
    file.write_bytes(change(file.read_bytes()))


def _flipped(data: bytes, rng: random.Random) -> bytes:
    out = bytearray(data)
    for _ in range(rng.randrange(1, 9)):
        out[rng.randrange(len(out))] ^= 1 << rng.randrange(8)
    return bytes(out)


def _over(data: bytes, place: float, what: bytes) -> bytes:
    at = int(place * len(data))
    return data[:at] + what + data[at + len(what) :]


def _zip_bomb(file: Path) -> None:
    with io.BytesIO() as buffer:
        np.lib.format.write_array(buffer, np.zeros(8))
        head = buffer.getvalue()[:128]
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in ("times.npy", "samples.npy", "x.npy"):
            with archive.open(name, "w", force_zip64=True) as out:
                out.write(head)
                for _ in range(128):
                    out.write(bytes(1 << 20))


def _as_folder(file: Path) -> None:
    file.unlink()
    file.mkdir()


def _as_circle(file: Path) -> None:
    file.unlink()
    file.symlink_to(file.name)


def _as_pipe(file: Path) -> None:
    file.unlink()
    os.mkfifo(file)


def copy(source: Path, target: Path) -> None:
    """A fresh copy of a folder for one case."""
    shutil.copytree(source, target, symlinks=True)
