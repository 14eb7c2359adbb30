"""Verification by synthetic truth: simulate at known parameters, calibrate against the result at two noise levels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lacli.base.arrays import FloatArray
from lacli.base.errors import LacliError, UsageError
from lacli.base.files import write_json
from lacli.calibration.calibration import FILE, Calibration, Monitor, Settings, calibrate, calibration_identity, obstacle
from lacli.contracts.identity import Identity, write_identity
from lacli.contracts.targets import Targets
from lacli.inference.box import Box
from lacli.inference.runs import RunLog, Simulator, runs_identity

# name: (standard deviation of displacements, mm; of volumes, as a share of the end-diastolic volume)
NOISE_LEVELS: dict[str, tuple[float, float]] = {"baseline": (0.2, 0.05), "high": (1.0, 0.20)}


@dataclass(frozen=True)
class Recovery:
    """One noise level: the calibration, and per input the truth, whether it is inside the 95 % interval and the
    posterior's range, and |MAP - truth|."""

    level: str
    calibration: Calibration
    rows: list[dict[str, Any]]

    @property
    def inside(self) -> int:
        """Number of inputs whose truth is inside the 95 % interval."""
        return sum(row["inside95"] for row in self.rows)

    @property
    def outside_posterior(self) -> int:
        """Number of inputs whose truth is beyond all posterior samples."""
        return sum(not row["inside_posterior"] for row in self.rows)


def default_truth(box: Box) -> FloatArray:
    """A parameter set (d,) away from the box's centre and edges: stiffness differs between regions."""
    known = {
        "alpha_anterior": 0.9, "alpha_posterior": 1.6, "alpha_septum": 1.2, "alpha_lateral": 0.6, "alpha_roof": 2.2,
        "edp_mmhg": 7.0, "esp_mmhg": 22.0, "k_peri_kpa_per_um": 0.0015, "pth": 0.70,
    }  # fmt: skip
    return np.array([known.get(n, a + 0.4 * (b - a)) for n, a, b in zip(box.names, box.lower, box.upper, strict=True)])


def targets_at(outputs: dict[str, float], names: Sequence[str], displacement_mm: float, volume_share: float) -> Targets:
    """Targets with the outputs as means. Volumes' sd is a share of the end-diastolic volume (``edv_ml``; of the volume
    itself where that is not among the outputs)."""
    mean = np.array([outputs[name] for name in names])
    reference = outputs.get("edv_ml")
    sd = [
        displacement_mm if name.endswith("_mm") else volume_share * abs(reference if reference is not None else value)
        for name, value in zip(names, mean, strict=True)
    ]
    return Targets(tuple(names), mean, np.array(sd))


def logged(names: Sequence[str]) -> tuple[str, ...]:
    """Outputs that the log of a verification notes: the targets', and the volume that scales their noise."""
    return (*names, *(("edv_ml",) if "edv_ml" not in names else ()))


def truth_identity(simulator: Simulator, box: Box, names: Sequence[str], truth: FloatArray, settings: Settings) -> Identity:
    """What determines a verification: the simulator, the box, the truth and its noise, settings but for budgets."""
    truth_as_targets = Targets(box.names, truth, np.zeros(len(truth)))
    runs = runs_identity(simulator, box.names, logged(names))
    return calibration_identity(box, truth_as_targets, settings, runs, noise=NOISE_LEVELS, outputs=list(names))


def verify(
    simulator: Simulator,
    box: Box,
    names: Sequence[str],
    truth: FloatArray,
    settings: Settings,
    folder: Path,
    monitor: Monitor,
    retry: bool = False,
) -> list[Recovery]:
    """Calibrate at each noise level against a simulation at ``truth`` (d,); runs are shared between the levels.

    retry: as of ``RunLog``.

    Raises LacliError if the simulation at the truth fails.
    """
    identity = truth_identity(simulator, box, names, truth, settings)
    if words := obstacle(folder, identity):
        raise UsageError(f"{folder} {words}. Choose another --out.")
    log = RunLog(folder / "runs.csv", box.names, logged(names), runs_identity(simulator, box.names, logged(names)), retry)
    log.run(simulator, truth[None])
    row = log.frame(truth[None]).iloc[0]
    if str(row["status"]) != "done":
        raise LacliError(f"the simulation at the truth failed ({row['kind']}); choose another with --truth.")
    outputs = {str(k): float(v) for k, v in row.items() if k in (*names, "edv_ml") and np.isfinite(float(v))}
    write_identity(folder / FILE, identity)
    result = []
    for level, (displacement, volume) in NOISE_LEVELS.items():
        targets = targets_at(outputs, names, displacement, volume)
        # the log of the waves has only the features asked for, so that it can be read as a table of runs
        found = calibrate(simulator, box, targets, settings, folder / level, log, monitor=monitor)
        flat = found.chain.flat()
        rows: list[dict[str, Any]] = []
        for i, entry in enumerate(found.table):
            value = float(truth[i])
            inside = bool(float(entry["low95"]) <= value <= float(entry["high95"]))
            within = bool(flat[:, i].min() <= value <= flat[:, i].max())
            rows.append(
                {
                    **entry,
                    "truth": value,
                    "inside95": inside,
                    "inside_posterior": within,
                    "map_error": abs(float(entry["map"]) - value),
                }
            )
        result.append(Recovery(level, found, rows))
        write_json(folder / level / "recovery.json", rows)
    return result
