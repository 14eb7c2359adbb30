"""A study on a cluster: patients as tasks; whoever is killed, nothing is lost and nothing runs on."""

from __future__ import annotations

import importlib.util
import threading
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import psutil
import pytest
from clusters import Cluster, no_slurm, said, slurm_node, wait_for

from lacli.base.errors import LacliError, UsageError
from lacli.cohort.cluster import patients_on_cluster
from lacli.cohort.participants import Participant
from lacli.cohort.steps import Settings, Step
from lacli.cohort.study import Outcome, known_outcome

pytestmark = pytest.mark.skipif(importlib.util.find_spec("dask_jobqueue") is None, reason="needs the extra 'cluster'")
NAMES = ("sub-1", "sub-2", "sub-3")


def patients(home: Path, names: tuple[str, ...] = NAMES) -> list[tuple[Participant, list[Step]]]:
    """Stand-ins for the steps: a cheap one, one of some seconds with a product of its own, a cheap one."""
    found = []
    for name in names:
        made = home / name / "atrium"
        words = ("synthesize", str(made), "--cell-size-mm", "12", "--order", "1")
        cheap = ("--version",)
        home.mkdir(exist_ok=True)
        (home / "given").touch()
        steps = [
            Step("mesh", cheap, (), home / "given"),
            Step("track", words, (), made / "anatomy.json"),
            Step("compare", cheap, (), made),
        ]
        found.append((Participant(name, {}, {}), steps))
    return found


def steps_at_work(home: Path) -> list[psutil.Process]:
    """The processes of lacli that make a stand-in's product."""
    found = []
    for process in psutil.process_iter(["cmdline"]):
        with suppress(psutil.Error):
            words = process.info["cmdline"] or []
            if words[1:4] == ["-m", "lacli", "synthesize"] and Path(words[4]).is_relative_to(home):
                found.append(process)
    return found


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[Cluster]:
    (tmp_path / "cluster").mkdir()
    it = Cluster(tmp_path / "cluster", workers=2)
    try:
        yield it
    finally:
        it.stop()


def run(home: Path, address: str) -> dict[str, Outcome]:
    return {o.participant_id: o for _, o in patients_on_cluster(patients(home), home, address, lambda index, step: None)}


def all_done(home: Path, outcomes: dict[str, Outcome]) -> None:
    assert {name: (o.status, o.reason) for name, o in outcomes.items()} == dict.fromkeys(NAMES, ("done", ""))
    for name in NAMES:
        assert known_outcome(home / name) == outcomes[name]
        assert (home / name / "atrium" / "wall.vtu").is_file()
    assert not steps_at_work(home)


@pytest.mark.slow
def test_the_patient_of_a_lost_worker_goes_elsewhere(cluster: Cluster, tmp_path: Path) -> None:
    home, killed = tmp_path / "study", list[int]()

    def shoot() -> None:
        wait_for(lambda: steps_at_work(home), 60)
        nannies = [nanny.pid for nanny in cluster.nannies]
        worker = next(p for p in steps_at_work(home)[0].parents() if p.ppid() in nannies)
        killed.append(worker.pid)
        worker.kill()

    shot = threading.Thread(target=shoot, daemon=True)
    shot.start()
    all_done(home, run(home, cluster.address))
    shot.join()
    assert killed


@pytest.mark.slow
def test_a_lost_scheduler_is_one_message_and_the_rest_is_done_later(cluster: Cluster, tmp_path: Path) -> None:
    home = tmp_path / "study"

    def shoot() -> None:
        wait_for(lambda: steps_at_work(home), 60)
        cluster.scheduler.kill()

    threading.Thread(target=shoot, daemon=True).start()
    with pytest.raises(LacliError, match=r"connection to the Dask scheduler at .* is lost. What was finished is kept"):
        run(home, cluster.address)
    wait_for(lambda: not steps_at_work(home), 10)
    cluster.stop()
    (tmp_path / "other").mkdir()
    other = Cluster(tmp_path / "other", workers=2)
    try:
        all_done(home, run(home, other.address))
    finally:
        other.stop()


def test_one_way_to_a_cluster_and_none_without_a_scheduler(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from lacli.mechanics.places import cluster as places

    monkeypatch.setattr(places, "_CONNECT_S", 1)
    with pytest.raises(UsageError, match="no Dask scheduler answers"):
        run(tmp_path / "study", "tcp://127.0.0.1:1")
    monkeypatch.setenv("PATH", "")
    from lacli.cohort.slurm import workers

    with pytest.raises(UsageError, match="no sbatch here"), workers(Settings(), tmp_path):
        pass


@pytest.mark.slow
@pytest.mark.skipif(bool(no_slurm()), reason=no_slurm())
def test_a_study_on_slurm_survives_a_lost_job(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from lacli.cohort.slurm import workers

    home, lost = tmp_path / "study", list[str]()
    settings = Settings(slurm={"cpus": 1, "memory": "400M", "time": "00:10:00", "interface": "lo", "limit": 2})
    home.mkdir()
    monkeypatch.setenv("DASK_DISTRIBUTED__DEPLOY__LOST_WORKER_TIMEOUT", "1s")
    with slurm_node(tmp_path, monkeypatch), workers(settings, home) as (address, keep):

        def shoot() -> None:
            wait_for(lambda: steps_at_work(home), 60)
            lost.append(said(["squeue", "-h", "-o", "%i", "-t", "R"]).split()[0])
            said(["scancel", lost[0]])

        shot = threading.Thread(target=shoot, daemon=True)
        shot.start()
        keep(3)
        found = dict(patients_on_cluster(patients(home), home, address, lambda index, step: None, lambda: keep(3)))
        shot.join()
        all_done(home, {o.participant_id: o for o in found.values()})
        assert lost
        names = said(["squeue", "-h", "-o", "%j %C"]).split("\n")
        assert set(filter(None, names)) == {"lacli-cohort 1"}
