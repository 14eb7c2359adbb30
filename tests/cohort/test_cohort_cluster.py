"""A study on a cluster: patients as tasks; whoever is killed, nothing is lost and nothing runs on."""

from __future__ import annotations

import contextlib
import importlib.util
import threading
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import psutil
import pytest
from clusters import Cluster, no_slurm, said, slurm_node, wait_for

from lacli.api import cohort as api
from lacli.base.errors import LacliError, UsageError
from lacli.cohort.cluster import patients_on_cluster
from lacli.cohort.participants import Participant
from lacli.cohort.steps import Settings, Step
from lacli.cohort.study import Outcome, known_outcome
from lacli.contracts.labels import BODY_REGIONS
from lacli.contracts.targets import Targets, write_targets

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


@pytest.mark.slow
@pytest.mark.parametrize("place", ["dask", pytest.param("slurm", marks=pytest.mark.skipif(bool(no_slurm()), reason=no_slurm()))])
def test_the_whole_study_is_the_same_on_a_cluster_as_here(
    place: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest
) -> None:
    alphas, outputs = [f"alpha_{r}" for r in BODY_REGIONS], tuple(f"d_{r}_mm" for r in BODY_REGIONS)
    x = 0.5 + 3.5 * np.random.default_rng(0).random((40, 5))
    runs = pd.DataFrame(x, columns=alphas).assign(**dict(zip(outputs, (10 - 2 * x).T, strict=True)))
    runs.to_csv(tmp_path / "runs.csv", index=False)
    for name, alpha in (("sub-1", 1.5), ("sub-2", 2.5)):
        write_targets(tmp_path / f"{name}.toml", Targets(outputs, np.full(5, 10 - 2 * alpha), np.full(5, 0.3)))
    table = tmp_path / "participants.csv"
    table.write_text("participant_id,table,targets\nsub-1,runs.csv,sub-1.toml\nsub-2,runs.csv,sub-2.toml\n")
    (tmp_path / "settings.toml").write_text(
        "[calibrate]\nmax-waves = 1\nfirst-runs = 40\ness = 200\nfigures = false\n[compare]\nparticles = 100\n"
        '[slurm]\ncpus = 1\nmemory = "400M"\ntime = "00:10:00"\ninterface = "lo"\n'
    )
    seen: list[tuple[str, float]] = []
    with contextlib.ExitStack() as stack:
        if place == "slurm":
            stack.enter_context(slurm_node(tmp_path, monkeypatch))
            where: dict[str, Any] = {"slurm": True}
        else:
            where = {"scheduler": request.getfixturevalue("cluster").address}
        found = api.run_cohort(
            table, tmp_path / "study", settings=tmp_path / "settings.toml",
            progress=lambda event: seen.append((event.stage, event.done)), **where,
        )  # fmt: skip
    assert [(o.participant_id, o.status) for o in found.outcomes] == [("sub-1", "done"), ("sub-2", "done")]
    assert {("sub-1", 2), ("sub-2", 2)} <= set(seen)  # two steps each
    # slope 2 mm a unit: the truths within what .3 mm leave
    means = pd.read_csv(tmp_path / "study" / "regions.csv").groupby("participant_id")["alpha"].mean()
    assert means.tolist() == pytest.approx([1.5, 2.5], abs=0.15)
    again = api.run_cohort(table, tmp_path / "study", settings=tmp_path / "settings.toml")
    assert again.outcomes == found.outcomes, "found here, not done again"
