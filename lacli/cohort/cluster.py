"""Patients on the workers of a Dask cluster, a patient a task; the workers see the study's folder and the patients' files.

A lost worker's patient goes to another worker and goes on from the steps that are done (a calibration from its runs); a lost
scheduler, or a client that is gone, ends what runs, and the same command goes on later.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from lacli.base.errors import Cancelled, MachineError, StorageError
from lacli.base.notes import note
from lacli.cohort.participants import Participant
from lacli.cohort.steps import Step
from lacli.cohort.study import Outcome, keep, run
from lacli.contracts.failures import MOST_ATTEMPTS
from lacli.mechanics.places.cluster import tasks_on_cluster
from lacli.mechanics.places.trials import portable


def patients_on_cluster(
    chosen: Sequence[tuple[Participant, Sequence[Step]]],
    home: Path,
    scheduler: str,
    begun: Callable[[int, str], None],
    look: Callable[[], None] = lambda: None,
) -> Iterator[tuple[int, Outcome]]:
    """Do what is not done of every patient; yield (index, outcome) as they end.

    home: the study's folder, the same on all workers. begun(index, step): a patient's step begins. look: called about each
    second, may raise. Raises UsageError where no scheduler answers, LacliError where it is lost, StorageError where a disk is
    full.
    """
    ended: Counter[int] = Counter()
    at: dict[int, str] = {}

    def tell(index: int, event: dict[str, str]) -> None:
        at[index] = event["step"]
        begun(index, event["step"])

    def lost(index: int, kind: str, message: str, memory_mb: float = 0.0, last: bool = False) -> Outcome | None:
        if kind == "disk_full":
            raise StorageError(message)
        name = chosen[index][0].identifier
        ended[index] += 1
        if not last and ended[index] < MOST_ATTEMPTS:
            note(f"{name}: {message} Tried once more.", once=False)
            return None
        return keep(home / name, Outcome(name, "failed", at.get(index, ""), f"given up: {message}", {}))

    tasks = [(patient, list(steps), home / patient.identifier) for patient, steps in chosen]
    return tasks_on_cluster(_patient, tasks, scheduler, lost, tell, look)


def _patient(
    report: Callable[[Any], None], wanted: Callable[[], bool], patient: Participant, steps: Sequence[Step], folder: Path
) -> tuple[str, Any]:
    """Body of a task on a worker."""
    try:
        return "result", run(patient, steps, folder, lambda name: report({"step": name}), wanted)
    except Cancelled as error:
        return "ended", ("cancelled", str(error), 0.0)
    except MachineError as error:
        return "ended", (error.kind, str(error), 0.0)
    except Exception as error:
        return "error", portable(error)
