"""Registration engines behind one interface: two images on one grid -> the displacement of the first's points in the second.

An engine runs in a process of its own (``python -m lacli.motion.registration``): it can be stopped, its memory is its own, and
what its library prints goes into a log.
"""

from __future__ import annotations

import io
import os
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from lacli.anatomy.inputs.image import Image, read
from lacli.base.errors import LacliError
from lacli.base.processes.process import supervise
from lacli.motion.field import Field, from_sitk, read_field, to_sitk, write_field

TIMEOUT_S = 1800.0
# correlation in patches of 5 voxels, three levels, an update smoothed by 5 voxels and the whole by .7: a whole that is
# smoothed more falls short of large motions, by a tenth at the mitral annulus (docs/methods.md)
GREEDY = ("-m", "NCC", "2x2x2", "-n", "60x40x60", "-s", "5.0vox", "0.7vox", "-noise", "0")
# white noise, of the range of HU, so that the correlation in flat patches is defined: greedy's own is another at every call, and
# moved a displacement of 2 mm by 0.1 mm, now and then by 0.7
NOISE = 1e-3
DEMONS_LEVELS, DEMONS_STEPS, DEMONS_SD = (4, 2, 1), 60, 1.5
HU_WINDOW = (-150.0, 400.0)


@dataclass(frozen=True)
class Engine:
    """``name`` on the command line, ``settings`` that determine its result, ``register`` (fixed, moving) -> Field, in-process."""

    name: str
    settings: str
    register: Callable[[Image, Image], Field]


@dataclass(frozen=True)
class Registered:
    """A field and what it cost: CPU seconds and peak memory (MB) of the engine's process."""

    field: Field
    cpu_s: float
    peak_memory_mb: float


def greedy(fixed: Image, moving: Image, settings: Sequence[str] = GREEDY) -> Field:
    """Greedy's field with ``settings`` (its own command line's). Raises LacliError where it is not installed."""
    try:
        from picsl_greedy import GreedyFloat3D
    except ImportError as error:
        raise LacliError("the engine greedy is not installed: pip install picsl-greedy, or choose --engine demons.") from error
    engine: Any = GreedyFloat3D()
    command = " ".join(["-i fixed moving -o warp -threads 1", *settings])
    one, other = (to_sitk(_with_noise(image, seed)) for seed, image in enumerate((fixed, moving)))
    engine.execute(command, out=io.StringIO(), err=io.StringIO(), fixed=one, moving=other, warp=None)
    return from_sitk(engine["warp"])


def _with_noise(image: Image, seed: int) -> Image:
    values = image.array.astype(np.float32)
    noise = np.random.default_rng([20261126, seed]).standard_normal(values.shape, dtype=np.float32)
    return replace(image, array=values + NOISE * float(np.ptp(values)) * noise)


def _demons(fixed: Image, moving: Image) -> Field:
    import SimpleITK as sitk

    sitk.ProcessObject_SetGlobalDefaultNumberOfThreads(1)
    low, high = HU_WINDOW
    a, b = (sitk.Clamp(to_sitk(image), sitk.sitkFloat32, low, high) for image in (fixed, moving))
    demons = sitk.DiffeomorphicDemonsRegistrationFilter()
    demons.SetNumberOfIterations(DEMONS_STEPS)
    demons.SetStandardDeviations(DEMONS_SD)
    field = None
    for shrink in DEMONS_LEVELS:
        smooth = [sitk.DiscreteGaussian(i, (0.5 * shrink * i.GetSpacing()[0]) ** 2) if shrink > 1 else i for i in (a, b)]
        fixed_, moving_ = (sitk.Shrink(i, [shrink] * 3) for i in smooth)
        if field is not None:
            field = sitk.Resample(field, fixed_, sitk.Transform(), sitk.sitkLinear, 0.0, sitk.sitkVectorFloat64)
            field = demons.Execute(fixed_, moving_, field)
        else:
            field = demons.Execute(fixed_, moving_)
    return from_sitk(field)


ENGINES: dict[str, Engine] = {
    "greedy": Engine("greedy", f"float {' '.join(GREEDY)} noise {NOISE}", greedy),
    "demons": Engine("demons", f"diffeomorphic {DEMONS_LEVELS} {DEMONS_STEPS} {DEMONS_SD} {HU_WINDOW}", _demons),
}


def register_apart(engine: str, fixed: Path, moving: Path, out: Path, timeout_s: float = TIMEOUT_S) -> Registered:
    """Register two images on one grid in a process of its own; the field is written to ``out`` and returned.

    Raises LacliError with the engine's last words where it fails or takes longer than ``timeout_s``.
    """
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "ITK_GLOBAL_DEFAULT_NUMBER_OF_THREADS": "1"}
    command = [sys.executable, "-m", __name__, engine, str(fixed.absolute()), str(moving.absolute()), str(out.absolute())]
    with tempfile.TemporaryDirectory(prefix="lacli-track-") as scratch:
        ended = supervise(command, cwd=Path(scratch), env=environment, log=Path(scratch) / "log.txt", timeout_s=timeout_s)
    if ended.cut is not None or ended.exit_code != 0:
        why = {"timeout": f"it took more than {timeout_s:.0f} s", "out_of_memory": "the machine's memory ran out"}
        last = ended.last_lines[-1] if ended.last_lines else f"exit code {ended.exit_code}"
        raise LacliError(f"registration ({engine}) failed: {why.get(ended.cut or '', last)}.")
    return Registered(read_field(out), ended.cpu_s, ended.peak_memory_mb)


def _main(arguments: list[str]) -> int:
    engine, fixed, moving, out = arguments
    try:
        write_field(ENGINES[engine].register(read(Path(fixed)), read(Path(moving))), Path(out))
    except (LacliError, RuntimeError) as error:
        sys.stdout.write(f"{' '.join(str(error).split())}\n")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(_main(sys.argv[1:]))
