"""The emulator of the residuals as one of the targets' features, in their units: what other parts ask of emulators."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lacli.base.arrays import FloatArray
from lacli.base.errors import InputError
from lacli.base.threads import single_threaded
from lacli.calibration.sequential import branches
from lacli.calibration.sequential.emulator import Components
from lacli.calibration.sequential.evidence import factor, gather
from lacli.calibration.sequential.fidelity.corrected import emulate
from lacli.calibration.sequential.fidelity.correction import corrected, far_from_best, fit_correction, sound
from lacli.calibration.sequential.scale import Scale
from lacli.contracts.targets import Targets
from lacli.inference.box import Box
from lacli.inference.runs import RunLog

LOG, CHEAP = "runs.csv", "runs_cheap.csv"  # the second is there where runs of the first correct cheap ones
SIMULATED, SIMULATED_CHEAP = "simulated.toml", "simulated_cheap.toml"  # the scenes that these are runs of


@dataclass(frozen=True)
class Features:
    """components: of the residuals against ``targets``; outputs: the features asked for, of the targets' names."""

    components: Components
    scale: Scale
    targets: Targets
    outputs: tuple[str, ...]

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the inputs."""
        return self.scale.box.names

    def training_inputs(self) -> FloatArray:
        """Inputs (n, d) of the runs, in their units."""
        return self.scale.to_x(self.components.z)

    def select(self, outputs: Sequence[str]) -> Features:
        """Of the named features, in that order."""
        return replace(self, outputs=tuple(outputs))

    def predict(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean and variance (m, p) of the features at x (m, d), in their units and squares."""
        mean, variance = self.components.predict(self.scale.to_z(x))
        return self._features(mean), variance @ (self.back() ** 2).T

    def left_out(self) -> tuple[FloatArray, FloatArray]:
        """R2 and the share of the runs within two standard deviations (independent standard errors), (p,) each, by leaving runs
        out one after the other with their derivatives. NaN of what is the same in all runs."""
        error, share = self.components.left_out()
        back = self.back()
        off = error @ back.T
        sd = np.sqrt(share[:, None] * (self.components.variance @ (back**2).T))
        # the process goes through its runs, but for its nugget
        y = self._features(self.components.mean(self.components.z))
        about = ((y - y.mean(axis=0)) ** 2).sum(axis=0)
        r2 = 1.0 - (off**2).sum(axis=0) / np.where(about > 0, about, np.nan)
        return r2, np.where(about > 0, (np.abs(off) < 2.0 * sd).mean(axis=0), np.nan)

    def _features(self, components: FloatArray) -> FloatArray:
        """(m, p) of components (m, P): residual = U c, feature = target + L residual."""
        chosen = [self.targets.names.index(name) for name in self.outputs]
        return np.asarray(self.targets.mean[chosen] + components @ self.back().T)

    def back(self) -> FloatArray:
        """(p, P): features by component."""
        chosen = [self.targets.names.index(name) for name in self.outputs]
        return np.asarray(factor(self.targets)[chosen] @ self.components.rotation[: len(self.targets.names)])

    predict_truth = predict  # runs are taken for exact: their own error is in the targets' covariance


@dataclass(frozen=True)
class Told:
    """Runs that emulators learn from: their log, and the points x (n, d) of it that count."""

    log: RunLog
    x: FloatArray


@single_threaded
def features_of(file: Path, box: Box, targets: Targets) -> Features:
    """The emulator of all runs in a calibration's ``runs.csv``, which correct those of ``runs_cheap.csv`` where there are any.

    targets: with the errors that the calibration held them with: by these it is judged which runs lie on another branch.

    Raises InputError where none tells derivatives.
    """
    beside = file.with_name(CHEAP)
    cheap = _all_of(beside, box, targets) if beside.is_file() else None
    return features_from(_all_of(file, box, targets), cheap, box, targets)


@single_threaded
def features_from(own: Told, cheap: Told | None, box: Box, targets: Targets) -> Features:
    """As ``features_of``, of these runs of the scene's own and cheap ones."""
    scale = Scale.of(box)
    plain = replace(targets, priors=None)
    evidence = gather(own.log, own.x, plain, scale)
    off = branches.look(evidence, plain).strays
    if not evidence.told.any():
        raise InputError(f"{own.log.path}: no run in it tells derivatives; calibrate again.")
    if cheap is not None:
        beside = gather(cheap.log, cheap.x, plain, scale)
        of_cheap = branches.look(beside, plain, far_from_best(beside, evidence)).strays
        learnt, kept, dear = sound(beside, evidence, (of_cheap, off))
        if (correction := fit_correction(learnt, dear)) is None:
            raise InputError(
                f"{own.log.path}: too few runs that tell derivatives are in {cheap.log.path.name} too; calibrate again."
            )
        return Features(emulate(corrected(kept, dear, correction)), scale, plain, targets.names)
    return Features(emulate(evidence.take(~off)), scale, plain, targets.names)


def _all_of(file: Path, box: Box, targets: Targets) -> Told:
    log = RunLog(file, box.names, targets.names, None)
    return Told(log, np.array(list(log.rows)))
