"""What several test packages share."""

from __future__ import annotations

import signal
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from hypothesis import settings

from lacli.base.errors import SolverMissingError
from lacli.contracts.scene import Scene, build_scene
from lacli.freefem.program import FreeFem, find

# started in the background, or by nohup, Python finds signals ignored and would pass that on to everything the tests start
signal.signal(signal.SIGINT, signal.default_int_handler)
signal.signal(signal.SIGHUP, signal.SIG_DFL)

# a busy machine is no reason to fail: the time of one example is not what is tested
settings.register_profile("lacli", deadline=None)
settings.load_profile("lacli")


@pytest.fixture(scope="session")
def freefem() -> FreeFem:
    """The installed FreeFEM."""
    try:
        return find()
    except SolverMissingError as error:
        pytest.skip(f"needs FreeFEM: {error}")


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 128 kB."""
    folder = tmp_path / "small"
    folder.mkdir()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=128k", "none", str(folder)], capture_output=True, check=False)
    if mounted.returncode != 0:
        pytest.skip("mounting a small disk needs root")
    try:
        yield folder
    finally:
        subprocess.run(["umount", str(folder)], check=True)


@pytest.fixture
def scene_of(tmp_path: Path) -> Callable[..., Scene]:
    """A scene on a stand-in bundle (files of arbitrary bytes: enough for keys, not for a simulation)."""
    bundle = tmp_path / "bundle"
    bundle.mkdir()
    (bundle / "wall.vtu").write_bytes(b"wall")
    (bundle / "boundary.vtp").write_bytes(b"boundary")

    def make(*overrides: str) -> Scene:
        return build_scene({"anatomy": {"bundle": "bundle"}}, list(overrides), folder=tmp_path, where="test")

    return make
