"""Emulators as a file: numbers and names only, checked when read."""

from __future__ import annotations

from dataclasses import astuple
from pathlib import Path
from typing import Any

import numpy as np

from lacli.base.arrays import FloatArray
from lacli.base.errors import InputError
from lacli.base.files import replacing
from lacli.base.schema import Array, array_file, unfit
from lacli.base.threads import one_thread
from lacli.inference.emulation import gp
from lacli.inference.emulation.emulator import Emulator
from lacli.inference.emulation.emulator_set import EmulatorSet
from lacli.inference.emulation.scales import OutputScale

FORMAT = 2
_REMEDY = "Run `lacli emulate` again."
_HEAD = {
    "inputs": Array("text", ("d",), distinct=True),
    "outputs": Array("text", ("p",), distinct=True),
}
# of each output; u: the training inputs, in [-1, 1] but for rounding
_EACH = {
    "log_inputs": Array("bool", ("d",)),
    "low": Array(shape=("d",)),
    "high": Array(shape=("d",)),
    "scales": Array(shape=(5,)),
    "quality": Array(shape=(4,)),
    "theta": Array(shape=("theta",)),
    "u": Array(shape=("n", "d"), least=-1.0 - 1e-6, most=1.0 + 1e-6),
    "y": Array(shape=("n",)),
    "noise": Array(shape=("n",), least=0.0),
}


def save_emulators(path: Path, emulators: EmulatorSet) -> None:
    """Write the emulators to an .npz file (numbers and names only); the file appears whole or not at all."""
    arrays: dict[str, Any] = {
        "format": np.array(FORMAT), "inputs": np.array(emulators.inputs), "outputs": np.array(emulators.outputs),
    }  # fmt: skip
    for i, e in enumerate(emulators.emulators):
        arrays |= {
            f"{i}_log_inputs": e.log_inputs, f"{i}_low": e.low, f"{i}_high": e.high,
            f"{i}_scales": np.array([*astuple(e.output_scale), e.shift, e.scale], float),
            f"{i}_quality": np.array([e.inflation, e.held_out_r2, e.error_sd, e.process.objective], float),
            f"{i}_theta": e.process.theta, f"{i}_u": e.process.u, f"{i}_y": e.process.y, f"{i}_noise": e.process.noise,
        }  # fmt: skip
    with replacing(Path(path)) as temporary, temporary.open("wb") as stream:
        np.savez_compressed(stream, **arrays)


def load_emulators(path: Path) -> EmulatorSet:
    """Read what ``save_emulators`` wrote. Raises InputError if the file is missing, damaged or of another kind."""
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such emulator file. Make it with `lacli emulate`.")
    with array_file(path, "an emulator file", _REMEDY) as file, one_thread():
        number = int(file.read({"format": Array("int")})["format"])
        if number != FORMAT:
            raise InputError(f"{path}: written in format {number}, this program reads {FORMAT}. {_REMEDY}")
        head = file.read(_HEAD)
        if not len(head["inputs"]) or not len(head["outputs"]):
            raise unfit("it names no input or no output")
        emulators = []
        for i, output in enumerate(head["outputs"].tolist()):
            a = file.read({f"{i}_{name}": array for name, array in _EACH.items()})
            emulators.append(_emulator(output, {name: a[f"{i}_{name}"] for name in _EACH}))
        result = EmulatorSet(tuple(head["inputs"].tolist()), tuple(emulators))
        _check_common_range(result)
    return result


def _emulator(output: str, a: dict[str, Any]) -> Emulator:
    log, offset, sign, shift, scale = (float(v) for v in a["scales"])
    inflation, r2, error_sd, objective = (float(v) for v in a["quality"])
    d, n = len(a["low"]), len(a["y"])
    bounds = np.array([gp.LENGTH_BOUNDS] * d + [gp.S2_BOUNDS, gp.ETA_BOUNDS])
    if len(a["theta"]) != d + 2:
        raise unfit(f"{output}: {len(a['theta'])} hyperparameters for {d} inputs, {d + 2} are expected")
    if n < d + 2:
        raise unfit(f"{output}: {n} runs for {d} inputs")
    if (a["theta"] < np.log(bounds[:, 0]) - 1e-9).any() or (a["theta"] > np.log(bounds[:, 1]) + 1e-9).any():
        raise unfit(f"{output}: a hyperparameter is out of its bounds")
    if (a["low"] >= a["high"]).any():
        raise unfit(f"{output}: an input's range is empty")
    if log not in (0.0, 1.0) or abs(sign) != 1.0 or scale <= 0 or inflation <= 0 or r2 > 1.0 or error_sd < 0:
        raise unfit(f"{output}: a scale or score is none that a fit gives")
    try:
        process = gp.condition(a["theta"], a["u"], a["y"], a["noise"], objective)
    except np.linalg.LinAlgError as error:
        raise unfit(f"{output}: its runs carry no linear mean ({error})") from error
    return Emulator(
        output, a["log_inputs"], a["low"], a["high"], OutputScale(bool(log), offset, sign), shift, scale, inflation, r2,
        error_sd, process,
    )  # fmt: skip


def _check_common_range(emulators: EmulatorSet) -> None:
    """All outputs were learnt from the same runs: their inputs' ranges agree."""

    def ends(e: Emulator) -> FloatArray:
        with np.errstate(over="ignore"):
            return np.array([np.where(e.log_inputs, np.exp(np.where(e.log_inputs, v, 0.0)), v) for v in (e.low, e.high)])

    first = ends(emulators.emulators[0])
    for e in emulators.emulators:
        mine = ends(e)
        if not np.isfinite(mine).all() or (np.abs(mine - first) > 1e-6 * (first[1] - first[0])).any():
            raise unfit(f"{e.output}: its inputs' ranges are not those of {emulators.outputs[0]}")
