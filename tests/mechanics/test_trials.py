"""Runs that the machine ended: tried again, given up with the reason after the third time."""

from __future__ import annotations

from pathlib import Path

import pytest
from shapes import hollow_cube

from lacli.base.errors import LacliError, StorageError
from lacli.contracts.bundle import save
from lacli.contracts.failures import MOST_ATTEMPTS
from lacli.contracts.scene import Scene, build_scene
from lacli.mechanics.places.trials import Trials, portable
from lacli.mechanics.places.worker import reporter


@pytest.fixture
def scenes(tmp_path: Path) -> list[Scene]:
    save(hollow_cube(), tmp_path / "la")
    document = {"anatomy": {"bundle": "la"}}
    return [build_scene(document, [f"loads.esp_mmhg={p}"], folder=tmp_path, where="test") for p in (15, 16)]


def test_the_third_time_is_the_last_and_says_how_each_ended(scenes: list[Scene], tmp_path: Path) -> None:
    trials = Trials(scenes, tmp_path)
    for _ in range(MOST_ATTEMPTS - 1):
        assert trials.ended(0, "killed", "FreeFEM was killed.", 1500.0) is None
    assert trials.ended(1, "killed", "FreeFEM was killed.") is None, "each run has its own count"
    result = trials.ended(0, "out_of_memory", "Too little memory.", 900.0)
    assert result is not None
    assert (result.status, result.kind, result.manifest["attempts"]) == ("failed", "out_of_memory", MOST_ATTEMPTS)
    assert result.manifest["peak_memory_mb"] == 1500.0
    assert "2 x" in result.message and "Too little memory." in result.message
    assert trials.alone == {0, 1}
    assert list(tmp_path.glob(f"{result.key}*")) == [], "nothing of it is kept"


def test_a_full_disk_ends_everything_and_a_last_try_is_the_last(scenes: list[Scene], tmp_path: Path) -> None:
    trials = Trials(scenes, tmp_path)
    with pytest.raises(StorageError, match="no room"):
        trials.ended(0, "disk_full", "no room")
    result = trials.ended(1, "lost_worker", "The worker is gone.", last=True)
    assert result is not None and result.kind == "lost_worker"


def test_errors_travel_as_what_they_are_and_bugs_with_their_traceback() -> None:
    same = portable(StorageError("full"))
    assert type(same) is StorageError and str(same) == "full"

    class Odd(LacliError):
        def __init__(self, a: int, b: int) -> None:
            super().__init__(f"{a} and {b}")

    odd = portable(Odd(1, 2))
    assert type(odd) is LacliError and str(odd) == "1 and 2"
    try:
        raise KeyError("bug")
    except KeyError as error:
        told = portable(error)
    assert type(told) is RuntimeError and "Traceback" in str(told) and "KeyError: 'bug'" in str(told)


def test_a_worker_s_progress_is_sent_no_oftener_than_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, sent = iter([10.0, 10.0, 10.4, 11.1, 11.1]), list[int]()
    monkeypatch.setattr("lacli.mechanics.places.worker.time.monotonic", lambda: next(clock))
    report = reporter(sent.append, 1.0)
    for event in (1, 2, 3):  # at 10, 10.4 and 11.1 s
        report(event)
    assert sent == [1, 3]
