"""The header of a NIfTI file (1 or 2, in one file or two), read by itself: the image library guesses where it contradicts itself.

The layout is that of nifti1.h and nifti2.h (nifti.nimh.nih.gov). Matrices are turned from the format's RAS to LPS, in mm.
"""

from __future__ import annotations

import gzip
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lacli.base.arrays import FloatArray
from lacli.base.errors import InputError

SUFFIXES = (".nii", ".nii.gz", ".hdr", ".img")
UNITS = {0: ("", 1.0), 1: ("metres", 1e3), 2: ("millimetres", 1.0), 3: ("micrometres", 1e-3)}
_CHUNK = 1 << 20
_LPS = np.diag([-1.0, -1.0, 1.0])


@dataclass(frozen=True)
class Header:
    """shape: voxels along i, j, k, ...; voxel_bytes; offset: of the first voxel; pixdim (3,) mm; unit: what the header calls its
    lengths, "" where it does not say; qform, sform: (3, 4) index -> mm, LPS, or None where not set."""

    shape: tuple[int, ...]
    voxel_bytes: int
    offset: int
    pixdim: FloatArray
    unit: str
    qform: FloatArray | None
    sform: FloatArray | None

    @property
    def affine(self) -> FloatArray | None:
        """The matrix that holds: the sform where it is set, as the standard has it, else the qform."""
        return self.qform if self.sform is None else self.sform

    @property
    def data_bytes(self) -> int:
        """Size of the voxels."""
        size = self.voxel_bytes
        for n in self.shape:
            size *= max(n, 1)
        return size


def read_header(path: Path, count_voxels: bool = True) -> Header:
    """The header of a .nii, .nii.gz, .hdr or .img file, and (``count_voxels``) whether all voxels are there.

    Raises InputError where it is no NIfTI header, the file is cut short, the affine is not finite or contradicts the voxel size.
    """
    low = path.name.lower()
    pair = low.endswith((".hdr", ".img"))
    file = path.with_suffix(".hdr") if low.endswith(".img") else path
    if not file.is_file():
        raise InputError(f"{path}: its header {file.name} is not there.")
    head = _begin(file, 544)
    header, magic = _parse(path, head)
    if pair and magic.startswith(b"n+"):
        pair = False
    data = path.with_suffix(".img") if pair else path
    if count_voxels and header.data_bytes <= 1 << 32:  # larger ones are refused for their size
        needed = (0 if pair else header.offset) + header.data_bytes
        _check_length(data, needed)
    return header


def _begin(file: Path, count: int) -> bytes:
    try:
        with gzip.open(file) if file.name.lower().endswith(".gz") else file.open("rb") as stream:
            return stream.read(count)
    except (OSError, EOFError, zlib.error) as error:
        raise InputError(f"{file}: the file is truncated, or not compressed as its name says ({error}).") from None


def _check_length(file: Path, needed: int) -> None:
    """Count to ``needed`` and no further: what a compressed file holds beyond is not looked at."""
    if not file.is_file():
        raise InputError(f"{file}: no such file; the voxels are in it.")
    if not file.name.lower().endswith(".gz"):
        found = file.stat().st_size
    else:
        found = 0
        try:
            with gzip.open(file) as stream:
                while found < needed and (piece := stream.read(min(_CHUNK, needed - found))):
                    found += len(piece)
        except (OSError, EOFError, zlib.error) as error:
            raise InputError(f"{file}: the file is truncated, or not compressed as its name says ({error}).") from None
    if found < needed:
        raise InputError(f"{file}: the file is truncated, it has {found} bytes of {needed}.")


def _parse(path: Path, head: bytes) -> tuple[Header, bytes]:
    if len(head) < 348:
        raise InputError(f"{path}: the file is truncated, its header has {len(head)} bytes of 348.")
    order = next((o for o in "<>" if struct.unpack(f"{o}i", head[:4])[0] in (348, 540)), None)
    if order is None:
        raise InputError(f"{path}: the image cannot be read, it does not begin as NIfTI does; it may be of another format.")

    def take(kind: str, at: int) -> tuple[float, ...]:
        return struct.unpack_from(f"{order}{kind}", head, at)

    if struct.unpack(f"{order}i", head[:4])[0] == 348:
        magic = head[344:348]
        dim, bits, pixdim, (offset,) = take("8h", 40), take("h", 72)[0], take("8f", 76), take("f", 108)
        scaling, units, codes = take("2f", 112), head[123], take("2h", 252)
        quaternion, rows = take("6f", 256), take("12f", 280)
    else:
        if len(head) < 540:
            raise InputError(f"{path}: the file is truncated, its header has {len(head)} bytes of 540.")
        magic = head[4:8]
        dim, bits, pixdim, (offset,) = take("8q", 16), take("h", 14)[0], take("8d", 104), take("q", 168)
        scaling, units, codes = take("2d", 176), int(take("i", 500)[0]), take("2i", 344)
        quaternion, rows = take("6d", 352), take("12d", 400)
    if magic[:3] not in (b"n+1", b"ni1", b"n+2", b"ni2"):
        raise InputError(
            f"{path}: the header is of Analyze 7.5, which does not say where left and right are; convert it to NIfTI or NRRD."
        )
    if not 1 <= dim[0] <= 7 or any(n < 1 for n in dim[1 : 1 + int(dim[0])]) or bits < 1:
        raise InputError(f"{path}: the NIfTI header is damaged (dimensions {[int(n) for n in dim]}, {int(bits)} bits a voxel).")
    used = [pixdim[1:4], [offset], scaling]
    used += [quaternion] if codes[0] > 0 else []
    used += [rows] if codes[1] > 0 else []
    if not all(np.isfinite(values).all() for values in used):
        raise InputError(
            f"{path}: the affine or scaling of the NIfTI header has a value that is not finite (NaN); correct the header."
        )
    unit, factor = UNITS.get(units & 7, ("", 1.0))
    spacing = np.abs(np.array(pixdim[1:4], dtype=np.float64)) * factor
    sform = _LPS @ (np.array(rows, dtype=np.float64).reshape(3, 4) * factor) if codes[1] > 0 else None
    qform = _LPS @ _quaternion(quaternion, spacing, pixdim[0], factor) if codes[0] > 0 else None
    shape = tuple(int(n) for n in dim[1 : 1 + int(dim[0])])
    header = Header(shape, int(bits) // 8, int(offset), spacing, unit, qform, sform)
    if sform is not None:
        _check_columns(path, sform, spacing)
    return header, magic


def _quaternion(values: tuple[float, ...], spacing: FloatArray, sign: float, factor: float) -> FloatArray:
    """(3, 4) RAS of the qform: nifti1.h, method 2."""
    b, c, d = values[:3]
    norm = b * b + c * c + d * d
    if norm > 1.0:
        b, c, d = (v / np.sqrt(norm) for v in (b, c, d))
    a = np.sqrt(max(0.0, 1.0 - (b * b + c * c + d * d)))
    turn = np.array(
        [
            [a * a + b * b - c * c - d * d, 2 * (b * c - a * d), 2 * (b * d + a * c)],
            [2 * (b * c + a * d), a * a + c * c - b * b - d * d, 2 * (c * d - a * b)],
            [2 * (b * d - a * c), 2 * (c * d + a * b), a * a + d * d - b * b - c * c],
        ]
    )
    step = spacing * np.array([1.0, 1.0, -1.0 if sign < 0 else 1.0])
    return np.column_stack([turn * step, np.array(values[3:6]) * factor])


def _check_columns(path: Path, sform: FloatArray, spacing: FloatArray) -> None:
    length = np.linalg.norm(sform[:, :3], axis=0)
    if np.any(np.abs(length - spacing) > 0.01 * np.maximum(spacing, 1e-30)):
        raise InputError(
            f"{path}: the NIfTI header contradicts itself: the columns of the sform are "
            f"{' x '.join(f'{v:.4g}' for v in length)} mm long, pixdim says {' x '.join(f'{v:.4g}' for v in spacing)} mm; "
            "correct the header."
        )
