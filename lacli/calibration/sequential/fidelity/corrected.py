"""The emulator of runs that were corrected: its variance is the emulator's and the correction's."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import numpy as np

from lacli.base.arrays import FloatArray
from lacli.calibration.sequential.emulator import STILL, Components, Part, fit
from lacli.calibration.sequential.evidence import Evidence


@dataclass(frozen=True)
class Corrected(Components):
    """delta: the correction's process; mix (p, P): its components' part in these; own (P,): its variance in these, of which
    share(z) is not known. Between components its covariance is left out: to first order in it the likelihood takes the same."""

    delta: Components
    mix: FloatArray
    own: FloatArray

    @classmethod
    def of(cls, components: Components, delta: Components) -> Corrected:
        """The emulator of corrected runs, and delta of their first p residuals."""
        mix = delta.rotation.T @ components.rotation[: len(delta.rotation)]
        plain = {field.name: getattr(components, field.name) for field in fields(components)}
        return cls(**plain, delta=delta, mix=mix, own=delta.variance @ mix**2)

    def predict(self, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean and variance (m, P) of the components."""
        mean, variance = super().predict(z)
        return mean, variance + self.delta.share(z)[:, None] * self.own

    def errors(self, z: FloatArray, of: Part) -> Callable[[np.random.Generator], FloatArray]:
        """Draws of the errors (m, P) that the mean may have at z (m, d), jointly at all points."""
        none = np.zeros((len(z), len(self.variance)))
        of_runs = super().errors(z, of) if of != "correction" else lambda rng: none
        of_delta = self.delta.errors(z, of) if of != "emulator" else lambda rng: np.zeros((len(z), len(self.mix)))
        return lambda rng: np.asarray(of_runs(rng) + of_delta(rng) @ self.mix)

    def part(self, of: Part) -> Components:
        """The process whose runs lessen one part of the error, with its variance in these components."""
        return replace(self.delta, variance=self.own) if of == "correction" else self

    def reduced(self) -> Corrected:
        """The same misfit from fewer components."""
        lively = (self.variance > STILL) | (self.own > STILL)
        few = self._of(lively)
        more = len(few.variance) - int(lively.sum())
        kept = np.hstack([self.mix[:, lively], np.zeros((len(self.mix), more))])
        plain = {field.name: getattr(few, field.name) for field in fields(Components)}
        return replace(self, **plain | {"mix": kept, "own": np.r_[self.own[lively], np.zeros(more)]})

    def of_runs(self) -> Components:
        """The emulator of the corrected runs, as if the correction were known."""
        return Components(**{field.name: getattr(self, field.name) for field in fields(Components)})


def emulate(evidence: Evidence, start: Components | None = None) -> Components:
    """The emulator of runs; where they are corrected ones, with the correction's variance. start: as of ``emulator.fit``."""
    found = fit(evidence.z, evidence.residual, evidence.jacobian, start)
    return found if evidence.correction is None else Corrected.of(found, evidence.correction.delta)
