"""The covariance of targets' errors as a file beside ``targets.toml``, named there by ``covariance``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lacli.base.arrays import FloatArray
from lacli.base.errors import TableError
from lacli.base.schema import Array, array_file, write_arrays

_SCHEMA = {"names": Array("text", ("p",), distinct=True), "covariance": Array("float", ("p", "p"))}
_BYTES = 1 << 28  # of 5,000 targets
_SAME_SD = 1e-3


def write_covariance(path: Path, names: Sequence[str], covariance: FloatArray) -> None:
    """Write ``names`` (p,) and ``covariance`` (p, p) as an .npz."""
    write_arrays(path, {"names": np.array(list(names)), "covariance": covariance})


def read_covariance(targets: Path, file: object, names: Sequence[str], sd: FloatArray) -> FloatArray:
    """(p, p) in the order of ``names``; ``file`` is relative to the folder of ``targets``.

    Raises TableError where it is missing, damaged, not of these targets, not positive definite, or its
    diagonal is not sd squared.
    """
    if not isinstance(file, str) or not file or Path(file).name != file:
        raise TableError(f"{targets}: covariance must name a file in the same folder, found {file!r}.")
    path = targets.parent / file
    if not path.is_file():
        raise TableError(f"{targets}: its covariance {file} is missing. Without the line the errors count as independent.")
    with array_file(
        path, "a covariance", "Write targets and covariance again, together.", error=TableError, largest=_BYTES
    ) as arrays:
        a = arrays.read(_SCHEMA)
        known, covariance = [str(name) for name in a["names"]], a["covariance"]
    missing = [name for name in names if name not in known]
    if missing:
        raise TableError(f"{path}: no row for {', '.join(missing)}; the covariance is of other targets.")
    j = [known.index(name) for name in names]
    chosen = covariance[np.ix_(j, j)]
    if not np.isfinite(chosen).all() or not np.allclose(chosen, chosen.T, rtol=1e-8, atol=0):
        raise TableError(f"{path}: the covariance is not symmetric, or has values that are not finite.")
    apart = np.abs(np.sqrt(np.maximum(np.diag(chosen), 0.0)) / sd - 1.0)
    if apart.max() > _SAME_SD:
        name = names[int(np.argmax(apart))]
        raise TableError(f"{path}: the variance of {name} is not its sd in {targets.name} squared; write both together.")
    try:
        np.linalg.cholesky(chosen)
    except np.linalg.LinAlgError:
        raise TableError(f"{path}: the covariance is not positive definite; some targets are combinations of others.") from None
    return chosen


def nearest_correlation(matrix: FloatArray) -> FloatArray:
    """The correlation matrix without negative eigenvalues, its diagonal 1 again (Higham's first step)."""
    value, vector = np.linalg.eigh(0.5 * (matrix + matrix.T))
    kept = (vector * np.maximum(value, 1e-3)) @ vector.T
    size = np.sqrt(np.diag(kept))
    return kept / np.outer(size, size)
