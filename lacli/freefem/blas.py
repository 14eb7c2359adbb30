"""Which of OpenBLAS's kernels FreeFEM's solver should run on, where OpenBLAS would not know the processor."""

from __future__ import annotations

import functools
import os
from pathlib import Path

CHOICE = "OPENBLAS_CORETYPE"
_CPU = Path("/proc/cpuinfo")
_LAST = {"SkylakeX": "avx512vl", "Haswell": "fma"}  # of what a kernel needs, the flag that tells it apart
_AVX512 = {"avx512f", "avx512cd", "avx512bw", "avx512dq", "avx512vl"}
_AVX2 = {"avx2", "fma"}


def kernel_of(cpuinfo: str) -> str | None:
    """The kernel for an Intel processor by what /proc/cpuinfo says it can; None: OpenBLAS's own choice is as good.

    OpenBLAS chooses by the model's number, and takes one that is newer than itself for a Pentium 4 (``Prescott``), whose kernel
    uses none of the newer instructions. Models that it knows get the same kernels as here.
    """
    lines = (line.partition(":") for line in cpuinfo.splitlines())
    said: dict[str, str] = {}
    for name, _, value in lines:
        said.setdefault(name.strip(), value.strip())
    if said.get("vendor_id") != "GenuineIntel":
        return None
    flags = set(said.get("flags", "").split())
    if flags >= _AVX512 | _AVX2:
        return "SkylakeX"
    return "Haswell" if flags >= _AVX2 else None


@functools.cache
def _here() -> str | None:
    try:
        return kernel_of(_CPU.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError):
        return None


def environment() -> dict[str, str]:
    """What a run's environment gets: the kernel's name, or nothing where the user has chosen or there is no need."""
    name = _here()
    return {} if name is None or os.environ.get(CHOICE) else {CHOICE: name}


def shell_lines() -> str:
    """The same for a shell script, which may be run on another machine: there only if its processor can."""
    return "".join(
        f"if grep -qw {_LAST[kernel]} /proc/cpuinfo; then export {name}={kernel}; fi\n" for name, kernel in environment().items()
    )
