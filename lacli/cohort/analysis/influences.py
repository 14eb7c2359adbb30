"""Which inputs make which features vary, patient by patient: from the derivatives that the patients' own runs tell, else from the
total effects of the first wave's emulators over the box."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from lacli.contracts.tables.file import read_frame
from lacli.contracts.tables.gradients import read_gradients

RUNS = "runs.csv"
DERIVATIVES, TOTAL = "derivatives", "total effects"
_POINTS = 512  # of an index: a share within a few percent


def influences(patient: str, calibration: Path, result: Mapping[str, Any]) -> list[dict[str, Any]]:
    """A row a feature: the share of its variance that each input makes under the prior, to first order about the most probable
    point, (dy/dx_j s_j)^2 over their sum, with s the prior's sd.

    From the finished run nearest to the most probable point (in the posterior's sds) that tells derivatives. Where none does,
    the total effects (Sobol') of the first wave's emulators over their sum; column ``by`` says which; nothing where there was no
    wave. Raises TableError, InputError where a file is damaged.
    """
    return _by_derivatives(patient, calibration, result) or _by_emulators(patient, calibration, result)


def _by_emulators(patient: str, calibration: Path, result: Mapping[str, Any]) -> list[dict[str, Any]]:
    from lacli.cohort.patient import box_of
    from lacli.inference.emulation.emulator_set import load_emulators
    from lacli.inference.sensitivity import function_indices

    file = calibration / "wave_1" / "emulators.npz"
    if not result.get("waves") or not file.is_file():
        return []
    emulators, box = load_emulators(file), box_of(calibration)
    total = np.maximum(function_indices(emulators.predict_mean, box.lower, box.upper, _POINTS, resamples=2).st, 0.0)
    shares = total / np.maximum(total.sum(axis=1, keepdims=True), 1e-300)
    return [
        {"participant_id": patient, "feature": name, "by": TOTAL, **dict(zip(box.names, row, strict=True))}
        for name, row in zip(emulators.outputs, shares.tolist(), strict=True)
    ]


def _by_derivatives(patient: str, calibration: Path, result: Mapping[str, Any]) -> list[dict[str, Any]]:
    file = calibration / RUNS
    rows = result["posterior"]
    inputs = [str(row["input"]) for row in rows]
    if not file.is_file() or any(row.get("prior_sd") is None or row.get("map") is None for row in rows):
        return []
    frame = read_frame(file)
    features = [str(row["feature"]) for row in result["fit"] if str(row["feature"]) in frame]
    if "status" not in frame or not set(inputs) <= set(frame.columns):
        return []
    done = frame[frame["status"] == "done"].reset_index(drop=True)
    gradients = read_gradients(done, features, inputs, str(file))
    if gradients is None:
        return []
    best, sd, prior = (np.array([float(row[key]) for row in rows]) for key in ("map", "sd", "prior_sd"))
    away = (((done[inputs].to_numpy(float) - best) / np.maximum(sd, 1e-300)) ** 2).sum(axis=1)
    told = np.isfinite(gradients).all(axis=(1, 2))
    if not told.any():
        return []
    nearest = int(np.argmin(np.where(told, away, np.inf)))
    variance = (gradients[nearest] * prior[:, None]) ** 2
    total = variance.sum(axis=0)
    shares = np.divide(variance, total, out=np.zeros_like(variance), where=total > 0)
    return [
        {
            "participant_id": patient,
            "feature": name,
            "by": DERIVATIVES,
            **dict(zip(inputs, map(float, shares[:, i]), strict=True)),
        }
        for i, name in enumerate(features)
    ]


def over_patients(rows: Sequence[Mapping[str, Any]]) -> tuple[list[str], list[str], np.ndarray]:
    """Inputs, features, and the mean shares over patients (inputs, features) of features that all of them have."""
    frame, inputs = _shares(rows)
    count = frame["participant_id"].nunique()
    mean = frame.groupby("feature", sort=False)[inputs].agg("mean")
    held = frame["feature"].value_counts()
    features = [str(name) for name in mean.index if held[name] == count]
    return inputs, features, mean.loc[features].to_numpy(float).T


def by_patient(rows: Sequence[Mapping[str, Any]]) -> tuple[list[str], list[str], np.ndarray]:
    """Inputs, patients, and each patient's mean shares over its features (inputs, patients)."""
    frame, inputs = _shares(rows)
    mean = frame.groupby("participant_id", sort=False)[inputs].agg("mean")
    return inputs, [str(name) for name in mean.index], mean.to_numpy(float).T


def _shares(rows: Sequence[Mapping[str, Any]]) -> tuple[pd.DataFrame, list[str]]:
    """The rows that tell a share of every input, and the inputs."""
    frame = pd.DataFrame(list(rows))
    inputs = [str(name) for name in frame.columns if name not in ("participant_id", "feature", "by")]
    return frame.dropna(axis=0, how="any"), inputs
