"""What makes two things the same: everything that determines a result, by name, and digests of it.

Whatever is kept to be used again lies beside its ``Identity``. Asked for once more it is used if the identity is the same;
where it differs, ``settle`` names what does, and nothing is mixed or written over.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import itertools
import json
import math
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lacli.base.documents import read_json
from lacli.base.errors import AnatomyError, UsageError
from lacli.base.files import write_json
from lacli.base.resources import folder as resource_folder
from lacli.base.schema import array_file
from lacli.base.version import __version__
from lacli.contracts.scene import Scene

# a number for each kind of kept thing: raised when what is kept is made in another way, so that nothing old is taken for new;
# "runs" also when a scene's plan changes (lacli/mechanics/plan.py), which the deck and the libraries do not tell
METHODS: dict[str, int] = {
    "runs": 3, "calibration": 7, "emulators": 1, "region": 2, "chain": 4, "accuracy": 4, "figures": 1, "result": 1,
    # of a study's steps alone, whose marks have all numbers
    "anatomy": 6, "motion": 5, "comparison": 6,
}  # fmt: skip
_SHOWN = 6  # differences named in a message
_EXACT = 2**53  # whole numbers below it are the same as floats
_LISTED = 32  # numbers of an array that are kept as they are, so that a message can show them; longer ones as a digest


@dataclasses.dataclass(frozen=True)
class Identity:
    """What determines a kept thing: its kind, and plain values by dotted key (``materials.c_kpa.roof``). Equal by digest."""

    kind: str
    content: Mapping[str, Any] = dataclasses.field(compare=False)
    digest: str = dataclasses.field(init=False)

    def __post_init__(self) -> None:
        # contents that are equal have one digest: 1.0 and 1 are the same number, and -0.0 is 0
        content = {key: _canonical(value) for key, value in self.content.items()}
        object.__setattr__(self, "digest", content_hash({"kind": self.kind, "content": content}))

    def document(self) -> dict[str, Any]:
        """As it is written beside what is kept."""
        return {"kind": self.kind, "digest": self.digest, "content": dict(self.content)}

    def text(self) -> str:
        """The document in one line, for a place inside a file."""
        return json.dumps(self.document(), sort_keys=True)


def identify(kind: str, **parts: Any) -> Identity:
    """The identity of a thing of that kind (one of METHODS) made from ``parts``, this method and this version of lacli.

    parts: plain values, arrays, dataclasses, models, mappings of them; every field of a dataclass counts, but those whose
    metadata say ``determines``: False. Numbers that belong to names (a field ``names`` beside arrays of its length) get the
    names as keys.
    """
    return Identity(kind, flatten({**parts, "method": METHODS[kind], "lacli": __version__}))


def flatten(value: Any, prefix: str = "") -> dict[str, Any]:
    """Plain values by dotted key."""
    value = plain(value)
    if not isinstance(value, dict) or not value:
        return {prefix: value}
    flat: dict[str, Any] = {}
    for key, inner in value.items():
        flat |= flatten(inner, f"{prefix}.{key}" if prefix else str(key))
    return flat


def plain(value: Any) -> Any:
    """The value as JSON has it. Long arrays become a digest, numbers that are not finite their name."""
    if isinstance(value, Identity):
        return dict(value.content)
    if hasattr(value, "content_digest"):
        return "content " + value.content_digest()
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return _fields(value)
    if hasattr(value, "model_dump"):
        return plain(value.model_dump(mode="json"))
    if isinstance(value, Mapping):
        return {str(key): plain(inner) for key, inner in value.items()}
    if isinstance(value, np.ndarray):
        return plain(value.tolist()) if value.size <= _LISTED else "content " + array_digest(value)
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, (set, frozenset)):
        return sorted(plain(inner) for inner in value)
    if isinstance(value, (list, tuple)):
        items = [plain(inner) for inner in value]
        return dict(enumerate(items, 1)) if any(isinstance(item, dict) for item in items) else items
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    if value is None or isinstance(value, (str, int, float, bool)):
        return value
    raise TypeError(f"{type(value).__name__} does not say what determines it")


def _canonical(value: Any) -> Any:
    if isinstance(value, list):
        return [_canonical(inner) for inner in value]
    return float(value) if isinstance(value, (int, float)) and abs(value) < _EXACT else value


def _fields(value: Any) -> dict[str, Any]:
    determining = [field.name for field in dataclasses.fields(value) if field.metadata.get("determines", True)]
    content = {name: getattr(value, name) for name in determining}
    if hasattr(value, "as_given"):
        content |= value.as_given()
    names = content.get("names")
    if isinstance(names, tuple):
        for key, inner in content.items():
            if isinstance(inner, np.ndarray) and inner.shape == (len(names),):
                content[key] = dict(zip(names, inner.tolist(), strict=True))
    return {key: plain(inner) for key, inner in content.items()}


def array_digest(*arrays: Any) -> str:
    """Digest of arrays' types, shapes and values."""
    total = hashlib.sha256()
    for array in arrays:
        value = np.ascontiguousarray(array)
        total.update(f"\0{value.dtype.str}\0{value.shape}\0".encode())
        total.update(value.tobytes())
    return total.hexdigest()[:16]


def file_digest(file: Path) -> str:
    """sha256 of a file's bytes."""
    with file.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


# --- what is kept, against what is asked ------------------------------------------------------------------------------


def differences(old: Identity, new: Identity) -> list[str]:
    """In words, each determining value that is not the same: its key, what it was and what it is now."""
    pairs = [
        (key, old.content.get(key, "nothing"), new.content.get(key, "nothing"))
        for key in dict.fromkeys([*new.content, *old.content])
        if old.content.get(key, _ABSENT) != new.content.get(key, _ABSENT)
    ]
    words = [f"{key} was {_shown(before)}, is {_shown(now)}" for key, before, now in pairs]
    return words if old.kind == new.kind else [f"it was {old.kind}, is {new.kind}", *words]


_ABSENT = object()


def _shown(value: Any) -> str:
    text = f"{value:.12g}" if isinstance(value, float) else str(value)
    return text if len(text) <= 60 else text[:57] + "..."


def beside(table: Path) -> Path:
    """Where the identity of a kept table is written."""
    return table.with_name(table.name + ".identity.json")


def write_identity(file: Path, identity: Identity) -> None:
    """Write the identity as JSON, whole or not at all. Raises StorageError."""
    write_json(file, identity.document())


def read_identity(file: Path) -> Identity | None:
    """What ``write_identity`` wrote; None where there is none that can be believed (absent, damaged, edited)."""
    try:
        return parse_identity(file.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None


def of_own_runs(file: Path, key: str) -> Any:
    """What a calibration's identity says of the simulations that its answer is of: where cheap ones carried it, of the reference.

    None where it does not say it. Raises InputError where the file cannot be read.
    """
    identity = read_json(file)
    content = identity.get("content") if isinstance(identity, dict) else None
    if not isinstance(content, dict):
        return None
    corrected = any(name.startswith("reference.") for name in content)
    return content.get(f"{'reference' if corrected else 'runs'}.{key}")


def parse_identity(text: str) -> Identity | None:
    """An identity from its text; None where it is none, or was edited."""
    try:
        document = json.loads(text)
        identity = Identity(str(document["kind"]), dict(document["content"]))
        return identity if identity.digest == document["digest"] else None
    except (ValueError, KeyError, TypeError, RecursionError):
        return None


def conflict(kept: Identity | None, wanted: Identity, what: str) -> str:
    """Why what is kept (None: it does not say what it was made from) is not what is wanted, in words; '' where it is."""
    if kept is None:
        return f"holds {what} that does not say what it was made from (it was made elsewhere, by an older version, or edited)"
    if kept == wanted:
        return ""
    words = differences(kept, wanted)
    more = f"; and {len(words) - _SHOWN} more" if len(words) > _SHOWN else ""
    return f"holds {what} made from something else: {'; '.join(words[:_SHOWN])}{more}"


def settle(out: Path, obstacle: Callable[[Path], str], fresh: bool, table: bool = False) -> Path:
    """Where the work goes: ``out`` if nothing is in the way there; else, with ``fresh``, the first numbered sub-folder that
    is free or holds the same (so that the same call, repeated, goes on there).

    obstacle: what is in the way at a place, in words, '' for nothing. table: ``out`` is a file, its sub-folder beside it.
    Raises UsageError that names what is in the way. Nothing is written.
    """
    words = obstacle(out)
    if not words:
        return out
    free = next(place for place in _fresh_places(out, table) if not obstacle(place))
    if fresh:
        return free
    raise UsageError(
        f"{out} {words}. Choose another --out, or give --fresh to start in a folder of its own ({free}); what is there stays as"
        " it is."
    )


def _fresh_places(out: Path, table: bool) -> Iterator[Path]:
    for number in itertools.count(1):
        yield out.parent / f"{out.stem}_fresh_{number}" / out.name if table else out / f"fresh_{number}"


# --- content of what determines a run ---------------------------------------------------------------------------------


def content_hash(parts: Mapping[str, Any]) -> str:
    """A short, stable key of plain JSON-able content."""
    text = json.dumps(parts, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def run_key(scene: Scene) -> str:
    """Key of a run's content: scene, the bundle's files (not their path), deck and libraries, method and version of lacli.

    Raises AnatomyError if the bundle is not there.
    """
    return content_hash(
        {
            "scene": scene.content(),
            "bundle": bundle_digest(scene.anatomy.bundle),
            "solver": solver_digest(),
            "method": METHODS["runs"],
            "version": __version__,
        }
    )


def determinants(scene: Scene) -> dict[str, Any]:
    """What determines the runs of a scene, by name: scene, content of the bundle, FreeFEM scripts and libraries, method.

    Raises AnatomyError if the bundle is not there.
    """
    return {
        **scene.content(),
        "bundle": f"content {bundle_digest(scene.anatomy.bundle)[:16]}",
        "scripts": f"content {solver_digest()[:16]}",
        "runs_method": METHODS["runs"],
    }


def bundle_digest(folder: Path) -> str:
    """Digest of a bundle's ``wall.vtu``, ``boundary.vtp`` and the arrays of ``motion.npz`` (where there is one)."""
    states = []
    for name in ("wall.vtu", "boundary.vtp", "motion.npz"):
        file = folder / name
        if file.is_file():
            state = file.stat()
            states.append((file, state.st_size, state.st_mtime_ns))
        elif name != "motion.npz":
            raise AnatomyError(
                f"{folder}: not an anatomy bundle, {name} is missing. `lacli synthesize` or `lacli mesh` writes one."
            )
    return _digest(tuple(states))


@functools.lru_cache(maxsize=32)
def _digest(states: tuple[tuple[Path, int, int], ...]) -> str:
    total = hashlib.sha256()
    for file, _, _ in states:
        total.update(f"\0{file.name}\0".encode())
        if file.suffix == ".npz":
            _update_arrays(total, file)
        else:
            total.update(file.read_bytes())
    return total.hexdigest()


def _update_arrays(total: Any, file: Path) -> None:
    with array_file(file, "a file of arrays", "Write the bundle again.", error=AnatomyError) as arrays:
        for name, value in arrays.everything():
            total.update(f"\0{name}\0{value.dtype.str}\0{value.shape}\0".encode())
            total.update(value.tobytes())


@functools.lru_cache(maxsize=1)
def solver_digest() -> str:
    """Digest of every file of ``templates/`` and ``solvers/`` but the emulators' kernel, which takes no part in a run."""
    total = hashlib.sha256()
    for name in ("templates", "solvers"):
        root = resource_folder(name)
        for file in sorted(
            path for path in root.rglob("*") if path.is_file() and path.suffix in (".j2", ".edp", ".idp", ".cpp", ".hpp")
        ):
            if file.is_relative_to(root / "emulator"):
                continue
            total.update(f"\0{name}/{file.relative_to(root)}\0".encode())
            total.update(file.read_bytes())
    return total.hexdigest()
