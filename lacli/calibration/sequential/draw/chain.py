"""Sampling through the emulator of the residuals: uniform prior on the box, Gaussian likelihood with the emulator's variance."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np

from lacli.base.arrays import FloatArray
from lacli.calibration.sequential.emulator import Components
from lacli.calibration.sequential.scale import Scale
from lacli.contracts.identity import parse_identity
from lacli.contracts.targets import Targets
from lacli.inference.emulation.emulator_set import EmulatorSet
from lacli.inference.matching.matching import Region
from lacli.inference.sampling import posterior as mcmc
from lacli.inference.sampling.likelihood import Density


@dataclass(frozen=True)
class _Outputs:
    """The components as a set of emulators over the box: what sampling asks of one."""

    components: Components
    scale: Scale

    def predict(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean and variance (m, p) at x (m, d)."""
        return self.components.predict(self.scale.to_z(x))

    predict_truth = predict  # runs are taken for exact here; their own error is in the targets' covariance

    def predict_mean(self, x: FloatArray) -> FloatArray:
        """Mean (m, p) alone, at a tenth of the cost."""
        return self.components.mean(self.scale.to_z(x))

    @property
    def log_share(self) -> FloatArray:
        """(d,): 1 for inputs taken as logarithms, else 0."""
        return self.scale.logged.astype(float)


def density(components: Components, scale: Scale) -> Density:
    """The posterior's: residuals are 0 +- 1 where the run is the truth, their components too, and independent."""
    components = components.reduced()
    p = len(components.variance)
    targets = Targets(tuple(f"component {k + 1}" for k in range(p)), np.zeros(p), np.ones(p))
    return Density(cast(EmulatorSet, _Outputs(components, scale)), targets, Region(scale.box))


def sample(components: Components, scale: Scale, settings: mcmc.Settings, start: FloatArray, file: Path | None) -> mcmc.Chain:
    """The chain; kept in ``file`` and gone on with, where one is given."""
    of = density(components, scale)
    previous = None
    if file is not None and file.is_file():
        previous = mcmc.load_chain(file)
        if parse_identity(previous.key) != mcmc.chain_identity(of, settings):
            previous = None
    return mcmc.sample_posterior(
        of, settings, start, previous, None if file is None else lambda chain: mcmc.save_chain(file, chain)
    )
