"""The runs of a calibration that seeks the posterior: asked for within a budget, held against the targets that runs can tell."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from lacli.base.arrays import FloatArray
from lacli.base.errors import LacliError
from lacli.calibration.sequential import branches
from lacli.calibration.sequential.evidence import Evidence, factor, gather, narrowed
from lacli.calibration.sequential.fidelity import correction as fidelities
from lacli.calibration.sequential.fidelity.correction import Correction, corrected, fit_correction, pairs
from lacli.calibration.sequential.fidelity.error_factor import ErrorFactor, error_factor
from lacli.calibration.sequential.scale import Scale
from lacli.contracts.targets import Targets
from lacli.inference.box import Box
from lacli.inference.runs import STATUS, RunLog, Simulator
from lacli.inference.sampling import posterior as mcmc


@dataclass(frozen=True)
class Settings:
    """How far the search goes.

    starts of the search (>= 4); first_runs around the most probable point, drawn from a Gaussian ``widening`` times as wide
    as the posterior's, then ``batch`` at a time; end when the emulator's error moves the posterior's mean by less than
    ``share`` of its sd in every input, or at max_runs. mode_runs: at most so many to rule out other modes. reference_runs: at
    most so many of the reference, where the others are cheap; they end when the correction's error moves the mean by less than
    ``correction_share``. infer_errors: errors that were added to the targets' are taken for larger where the misfit says so.
    """

    starts: int = 4
    first_runs: int = 12
    widening: float = 1.6
    batch: int = 4
    share: float = 0.1
    mode_runs: int = 12
    max_runs: int = 60
    reference_runs: int = 12
    correction_share: float = 0.2
    infer_errors: bool = True
    seed: int = 0
    mcmc: mcmc.Settings = field(default_factory=mcmc.Settings)


@dataclass(frozen=True)
class Status:
    """Where a calibration stands: its stage, runs done of those asked for, and the runs so far in all."""

    stage: str
    done: int
    total: int
    runs: int


Monitor = Callable[[Status], None]


@dataclass(frozen=True)
class Reference:
    """The simulations that the answer is of, where the others are cheap ones; their log."""

    simulator: Simulator
    log: RunLog


class Search:
    """The runs so far, with what asks for more. targets: those that runs can tell; notes: what a user must know; reference: the
    dear simulations that correct the others, run at ``dear`` (k, d)."""

    def __init__(
        self,
        simulator: Simulator,
        box: Box,
        targets: Targets,
        settings: Settings,
        log: RunLog,
        monitor: Monitor,
        reference: Reference | None = None,
    ) -> None:
        self.simulator, self.box, self.given, self.settings = simulator, narrowed(box, targets), targets, settings
        self.targets = targets
        self.log, self.monitor = log, monitor
        self.scale = Scale.of(self.box)
        self.x = np.empty((0, box.d))
        self.stages: dict[str, int] = {}
        self.notes: list[str] = []
        self.strays = self.torn = 0
        self.reference, self.dear = reference, np.empty((0, box.d))
        self.error_factor: ErrorFactor | None = None
        self._correction: tuple[object, Correction | None] = (None, None)
        self._was_corrected = False

    def run(self, z: FloatArray, stage: str) -> Evidence:
        """Run the points z (k, d) that the budget allows; the evidence of all runs."""
        self._make(self._inside(z)[: max(0, self.left)], stage)
        return self.evidence()

    def refer(self, z: FloatArray, stage: str) -> Evidence:
        """Run the points z (k, d) that the budgets allow with both fidelities; the evidence of all runs, corrected."""
        assert self.reference is not None, "there is one fidelity"
        x = self._inside(z)[: max(0, min(self.dear_left, self.left))]
        self._make(x, stage)
        x = np.array([row for row in x if self.log.rows[tuple(row.tolist())][STATUS] == "done"]).reshape(-1, self.box.d)
        if len(x):
            of, before = f"{stage}: reference", len(self.dear)
            tell = self.monitor
            self.reference.log.run(self.reference.simulator, x, lambda done, total: tell(Status(of, done, total, len(self.x))))
            self.dear = _joined(self.dear, x)
            self.stages[of] = self.stages.get(of, 0) + len(self.dear) - before
        return self.evidence()

    def _inside(self, z: FloatArray) -> FloatArray:
        x = self.scale.to_x(z)
        return x[self.box.contains(x)]

    def _make(self, x: FloatArray, stage: str) -> None:
        """Have the cheap runs at x (k, d) in the log."""
        if len(x):
            before = len(self.x)
            self.log.run(self.simulator, x, lambda done, total: self.monitor(Status(stage, done, total, before + done)))
            self.x = _joined(self.x, x)
            self.stages[stage] = self.stages.get(stage, 0) + len(self.x) - before

    def evidence(self) -> Evidence:
        """Of all runs so far but for those on another branch; targets of frames that have several are left out from now on.

        Raises LacliError where no runs are left that correct the cheap ones, which some did before.
        """
        while True:
            found = gather(self.log, self.x, self.targets, self.scale)
            dear = gather(self.reference.log, self.dear, self.targets, self.scale) if self.reference and len(self.dear) else None
            if not len(found.z):
                return found
            looked = [branches.look(found, self.targets, fidelities.far_from_best(found, dear))]
            if dear is not None and len(dear.z):
                looked.append(branches.look(dear, self.targets))
            times = tuple(time for seen in looked for time in seen.times)
            if not times and dear is not None and len(dear.z) and _too_few(found, dear, looked):
                times = tuple(time for seen in looked for time in seen.jumped)  # rather than be without a correction
            if not times:
                break
            self.targets = branches.without(self.targets, times)
        self.strays = sum(int((seen.strays & ~seen.torn).sum()) for seen in looked)
        self.torn = sum(int((seen.strays & seen.torn).sum()) for seen in looked)
        if dear is None or not len(dear.z):
            return found.take(~looked[0].strays)
        learnt, kept, dear = fidelities.sound(found, dear, (looked[0].strays, looked[1].strays))
        known = (self.targets.names, learnt.x[pairs(learnt, dear)[:, 0]].tobytes())
        if self._correction[0] != known:
            self._correction = known, fit_correction(learnt, dear)
            if self._was_corrected and self._correction[1] is None:
                raise LacliError(
                    f"calibrate: of {len(self.dear)} runs of the reference fewer than {fidelities.LEAST} are left that tell "
                    "derivatives and lie on one branch with the others: nothing corrects the cheap runs. Look at "
                    f"{self.told.path}, or let all runs be the scene's own (--cheap none)."
                )
        correction = self._correction[1]
        self._was_corrected |= correction is not None
        return learnt if correction is None else corrected(kept, dear, correction)

    def infer_errors(self, evidence: Evidence) -> Evidence:
        """The evidence with the errors that were added to the targets' as large as the best run's misfit says."""
        if not self.settings.infer_errors or self.targets.errors is None or not self.targets.errors.any():
            return evidence
        # a correction's own error is no error of the model's: the factor is read off a run that none told
        row = evidence.best
        p, whitening = evidence.targets, factor(self.targets)
        self.error_factor = error_factor(
            whitening @ evidence.residual[row, :p], whitening @ evidence.jacobian[row, :p],
            whitening @ whitening.T - self.targets.errors, self.targets.errors,
            (evidence.residual[row, p:], evidence.jacobian[row, p:]),
        )  # fmt: skip
        if self.error_factor.value == 1.0:
            return evidence
        self.targets = self.targets.with_errors_times(self.error_factor.value)
        self._correction = (None, None)  # it is in the targets' standard deviations
        return self.evidence()

    @property
    def left(self) -> int:
        """Runs that the budget still allows."""
        return self.settings.max_runs - len(self.x)

    @property
    def dear_left(self) -> int:
        """Runs of the reference that its budget still allows; 0 where there is none."""
        return self.settings.reference_runs - len(self.dear) if self.reference else 0

    @property
    def told(self) -> RunLog:
        """The log of the runs that the answer is of."""
        return self.log if self.reference is None else self.reference.log

    @property
    def left_out(self) -> tuple[str, ...]:
        """Names of the targets that the runs cannot tell."""
        return tuple(name for name in self.given.names if name not in self.targets.names)

    def say(self, stage: str) -> None:
        """Tell the monitor of a stage without runs."""
        self.monitor(Status(stage, 0, 0, len(self.x)))


def _too_few(found: Evidence, dear: Evidence, looked: list[branches.Branches]) -> bool:
    """Whether so few pairs of both fidelities lie on one branch that nothing is learnt from them, though enough were run."""
    paired = pairs(found, dear)
    told = found.told[paired[:, 0]] & dear.told[paired[:, 1]]
    off = looked[0].strays[paired[:, 0]] | looked[1].strays[paired[:, 1]]
    return bool(told.sum() >= fidelities.LEAST > (told & ~off).sum())


def _joined(x: FloatArray, more: FloatArray) -> FloatArray:
    """Both, each point once, in order."""
    return np.array(list(dict.fromkeys(tuple(row) for row in np.vstack([x, more]).tolist())))
