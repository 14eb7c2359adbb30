"""Which of OpenBLAS's kernels FreeFEM's solver should run on, where OpenBLAS would not know the processor."""

from __future__ import annotations

import functools
import os
from pathlib import Path

CHOICE = "OPENBLAS_CORETYPE"
_CPU = Path("/proc/cpuinfo")
_VENDORS = ("GenuineIntel", "AuthenticAMD", "HygonGenuine")
_AVX2 = ("avx2", "fma")
# the best first: what a processor must be able to do; OpenBLAS does not ask again, and what it cannot ends the run
_NEEDED = {"SkylakeX": (*_AVX2, "avx512f", "avx512cd", "avx512bw", "avx512dq", "avx512vl"), "Haswell": _AVX2}


def kernel_of(cpuinfo: str) -> str | None:
    """The kernel for a processor by what /proc/cpuinfo says it can; None: OpenBLAS's own choice is as good.

    OpenBLAS chooses by the model's number. One that is newer than itself it takes for a Pentium 4 (``Prescott``), of AMD for a
    ``Barcelona``, whose kernels use none of the newer instructions: a quarter of the speed (23 and 26 GFlop/s of 92 on a Zen 5).
    Models that it knows get kernels as fast as their own.
    """
    lines = (line.partition(":") for line in cpuinfo.splitlines())
    said: dict[str, str] = {}
    for name, _, value in lines:
        said.setdefault(name.strip(), value.strip())
    if said.get("vendor_id") not in _VENDORS:
        return None
    flags = set(said.get("flags", "").split())
    return next((kernel for kernel, needed in _NEEDED.items() if flags.issuperset(needed)), None)


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


def shell_lines(cpuinfo: Path = _CPU) -> str:
    """The same for a shell script, which asks the machine that it runs on, its processor and its user's choice."""
    vendors = "|".join(_VENDORS)
    ways = []
    for kernel, needed in _NEEDED.items():
        asked = " && ".join(f"can {flag}" for flag in needed)
        ways.append(f"if {asked}; then export {CHOICE}={kernel}")
    return (
        f'if [ -z "${{{CHOICE}:-}}" ] && grep -Eqs "^vendor_id.*({vendors})" {cpuinfo}; then\n'
        f'  can() {{ grep -m 1 "^flags" {cpuinfo} | grep -qw "$1"; }}\n'
        f"  {'; el'.join(ways)}; fi\nfi\n"
    )
