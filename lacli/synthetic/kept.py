"""Whether a folder that was synthesized still holds what was written: digests of its files, in its description."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lacli.anatomy.bundle_folder import FILES as FILES
from lacli.base.errors import AnatomyError
from lacli.contracts.identity import file_digest


def digests(folder: Path, description: str) -> dict[str, str]:
    """Digest of every file below ``folder``, but of the one that will name them, by its path there."""
    files = sorted(path for path in folder.rglob("*") if path.is_file() and path.name != description)
    return {path.relative_to(folder).as_posix(): file_digest(path) for path in files}


def check(folder: Path, info: Mapping[str, Any]) -> None:
    """Raises AnatomyError that names the files of ``folder`` that are missing, or not as its description says."""
    known = info.get(FILES, {})
    if not isinstance(known, dict):
        raise AnatomyError(f"{folder}: its description is damaged; choose another folder, or remove this one.")
    other = [name for name, digest in known.items() if not _is(folder / str(name), digest)]
    if other:
        more = f" and {len(other) - 3} more" if len(other) > 3 else ""
        raise AnatomyError(
            f"{folder}: {', '.join(map(str, other[:3]))}{more} changed since `lacli synthesize` wrote it; choose another folder, "
            "or remove this one to have it made again."
        )


def _is(file: Path, digest: object) -> bool:
    return file.is_file() and file_digest(file) == digest
