"""Emulators learnt from gradients as arrays of an .npz file: names and numbers, from which they are made again."""

from __future__ import annotations

from typing import Any

import numpy as np

from lacli.base.schema import Array, ArrayFile, unfit
from lacli.inference.emulation import gradient_process as process
from lacli.inference.emulation.gradient_gp import GradientEmulators
from lacli.inference.emulation.gradient_kernel import KINDS
from lacli.inference.emulation.gradient_process import Data, GradientGP

MARK = "gradients"  # the array whose presence tells these from others; its value is the format
FORMAT = 1
_HEAD = {
    "inputs": Array("text", ("d",), distinct=True),
    "outputs": Array("text", ("p",), distinct=True),
    "log_inputs": Array("bool", ("d",)),
    "low": Array(shape=("d",)),
    "high": Array(shape=("d",)),
    "shift": Array(shape=("p",)),
    "scale": Array(shape=("p",), least=0.0, open_=True),
    "weights": Array(shape=("p", "q")),
    "residual": Array(shape=("p",), least=0.0),
    "inflation": Array(shape=("p",), least=0.0, open_=True),
    "held_out_r2": Array(shape=("p",), most=1.0),
    "told_error": Array(shape=("n", "p"), least=0.0),
    "u": Array(shape=("n", "d"), least=-1.0 - 1e-6, most=1.0 + 1e-6),
}


def _each(c: int) -> dict[str, Array]:
    """Arrays of process number c; the number of its derivatives is its own."""
    kinds = f"{c} rows"
    return {
        f"{c}_kernel": Array("int", least=0, most=len(KINDS) - 1),
        f"{c}_theta": Array(shape=("theta",)),
        f"{c}_objective": Array(),
        f"{c}_active": Array("int", (f"{c} active",), rising=True, least=0),
        f"{c}_rows": Array("bool", (kinds, "n")),
        f"{c}_observed": Array(shape=(kinds, "n")),
        f"{c}_noise": Array(shape=("n",), least=0.0),
        f"{c}_slope_variance": Array(shape=(f"{c} active",), least=0.0, open_=True),
    }


def arrays(emulators: GradientEmulators) -> dict[str, Any]:
    """What is stored of the emulators, and determines them."""
    kept: dict[str, Any] = {MARK: np.array(FORMAT)}
    kept |= {name: np.asarray(getattr(emulators, name)) for name in _HEAD if name != "u"}
    kept["u"] = emulators.processes[0].data.u
    for c, g in enumerate(emulators.processes):
        kept |= {
            f"{c}_kernel": np.array(KINDS.index(g.kind)), f"{c}_theta": g.theta, f"{c}_objective": np.array(g.objective),
            f"{c}_active": g.data.active, f"{c}_rows": g.data.rows, f"{c}_observed": g.data.observed,
            f"{c}_noise": g.data.noise, f"{c}_slope_variance": g.data.slope_variance,
        }  # fmt: skip
    return kept


def read(file: ArrayFile) -> GradientEmulators:
    """The emulators of an open file. Raises what ``array_file`` turns into one message."""
    if (number := int(file.read({MARK: Array("int")})[MARK])) != FORMAT:
        raise unfit(f"format {number} of emulators with gradients, this program reads {FORMAT}")
    a = file.read(_HEAD)
    if not a["inputs"].size or not a["outputs"].size or not a["weights"].shape[1]:
        raise unfit("it names no input or no output, or holds no process")
    if (a["low"] >= a["high"]).any():
        raise unfit("an input's range is empty")
    each = [file.read(_each(c)) for c in range(a["weights"].shape[1])]
    file.check_seal()
    processes = tuple(_process(c, stored, a["u"]) for c, stored in enumerate(each))
    named = {name: value for name, value in a.items() if name not in ("inputs", "outputs", "u")}
    return GradientEmulators(tuple(a["inputs"].tolist()), tuple(a["outputs"].tolist()), **named, processes=processes)


def _process(c: int, stored: dict[str, Any], u: Any) -> GradientGP:
    a = {name.removeprefix(f"{c}_"): value for name, value in stored.items()}
    d = u.shape[1]
    if a["active"].size and a["active"][-1] >= d:
        raise unfit(f"process {c} has derivatives by input {a['active'][-1]} of {d}")
    if len(a["rows"]) != 1 + len(a["active"]):
        raise unfit(f"process {c} has {len(a['rows'])} kinds of rows for {len(a['active'])} derivatives")
    if not process.check_theta(a["theta"], d):
        raise unfit(f"process {c}: hyperparameters that no fit gives")
    if (size := int(a["rows"].sum())) > process.MOST_ROWS:
        raise unfit(f"process {c} has {size} rows, at most {process.MOST_ROWS} are worked with")
    data = Data(u, a["active"], a["rows"], a["observed"], a["noise"], a["slope_variance"])
    try:
        return process.condition(KINDS[int(a["kernel"])], a["theta"], data, float(a["objective"]))
    except np.linalg.LinAlgError as error:
        raise unfit(f"process {c}: its rows carry no linear mean ({error})") from error
