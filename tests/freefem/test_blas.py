"""FreeFEM's solver runs on the processor's own kernels, whether OpenBLAS knows the processor or not."""

import os
import subprocess
from pathlib import Path

import pytest

from lacli.freefem import blas
from lacli.freefem.program import find

AVX2 = "fpu sse2 avx avx2 fma"
AVX512 = f"{AVX2} avx512f avx512dq avx512cd avx512bw avx512vl"


def said(vendor: str, flags: str) -> str:
    one = f"processor\t: 0\nvendor_id\t: {vendor}\nmodel name\t: any: of them\nflags\t\t: {flags}\n\n"
    return one + one.replace("processor\t: 0", "processor\t: 1")


PROCESSORS = [
    (said("GenuineIntel", AVX512), "SkylakeX"),
    (said("GenuineIntel", AVX512.replace(" avx512vl", "")), "Haswell"),
    (said("GenuineIntel", AVX2), "Haswell"),
    (said("GenuineIntel", AVX2.replace(" fma", "")), None),
    # AMD's newer than OpenBLAS are taken for a Barcelona: a quarter of the speed on a Zen 5
    (said("AuthenticAMD", AVX512), "SkylakeX"),
    (said("AuthenticAMD", AVX2), "Haswell"),
    (said("HygonGenuine", AVX2), "Haswell"),
    (said("AuthenticAMD", "fpu sse2 avx fma"), None),
    (said("CentaurHauls", AVX2), None),
    ("processor\t: 0\nCPU implementer\t: 0x41\nFeatures\t: fp asimd\n", None),
    ("", None),
]


@pytest.mark.parametrize(("text", "kernel"), PROCESSORS)
def test_the_kernel_is_what_the_processor_can(text: str, kernel: str | None) -> None:
    assert blas.kernel_of(text) == kernel


def test_a_users_choice_stands(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(blas, "_here", lambda: "SkylakeX")
    monkeypatch.delenv(blas.CHOICE, raising=False)
    assert find().environment()[blas.CHOICE] == "SkylakeX"
    monkeypatch.setenv(blas.CHOICE, "Nehalem")
    assert find().environment()[blas.CHOICE] == "Nehalem"


@pytest.mark.parametrize(("text", "kernel"), PROCESSORS)
def test_a_script_asks_the_machine_it_runs_on(
    text: str, kernel: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whoever wrote it: another processor, another user's choice."""
    monkeypatch.setattr(blas, "_here", lambda: "SkylakeX")
    monkeypatch.setenv(blas.CHOICE, "Nehalem")
    (tmp_path / "cpuinfo").write_text(text, encoding="utf-8")
    script = f'set -eu\n{blas.shell_lines(tmp_path / "cpuinfo")}echo "kernel ${{{blas.CHOICE}:-}}"'

    def told(**chosen: str) -> str:
        environment = {"PATH": os.environ["PATH"], **chosen}
        return subprocess.run(["sh", "-c", script], capture_output=True, text=True, check=True, env=environment).stdout

    assert told() == f"kernel {kernel or ''}\n"
    assert told(**{blas.CHOICE: "Zen"}) == "kernel Zen\n"


def test_a_machine_that_tells_nothing_of_its_processor(tmp_path: Path) -> None:
    script = f"set -eu\n{blas.shell_lines(tmp_path / 'none')}"
    assert subprocess.run(["sh", "-c", script], capture_output=True, text=True, check=True).stderr == ""


def test_freefem_starts_on_it() -> None:
    environment = find().environment() | {"OPENBLAS_VERBOSE": "2"}
    wanted = environment.get(blas.CHOICE)
    if wanted is None:
        pytest.skip("OpenBLAS chooses here by itself")
    answer = subprocess.run(
        [str(find().binary), "-nw", "-v", "0", "/dev/null"],
        env=environment,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    core = [line for line in (answer.stdout + answer.stderr).splitlines() if line.startswith("Core")]
    if not core:
        pytest.skip("FreeFEM's BLAS here is not OpenBLAS")
    assert core == [f"Core: {wanted}"]
