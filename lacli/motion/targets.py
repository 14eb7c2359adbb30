"""Targets from a tracked motion: features at end-systole and in every frame, their standard deviations and covariance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import CubicSpline, PchipInterpolator

from lacli.anatomy.surface_features import Endocardium
from lacli.base.arrays import FloatArray
from lacli.base.errors import InputError, UsageError
from lacli.contracts.features import PUBLISHED, at_time
from lacli.contracts.priors import Prior
from lacli.contracts.targets import SAME_ES, Targets
from lacli.motion.errors.drift import frame_errors
from lacli.motion.errors.shrinkage import Shrinkage
from lacli.motion.errors.uncertainty import ErrorModel
from lacli.motion.phases import Phases, phases_of

PUBLISHED_VOLUME_SHARE = 0.05
# a frame this near to ES, as a share of the cycle, shows ES itself: it would be the same target twice
_NUGGET = 1e-4
_LEAST_RISE = 0.01
# end-diastole, before the reservoir and after the booster, is the atrium's least volume: a first frame above a later one is told
# from so many sd of a volume on, and refused where it is nearer to the largest volume than to the least
_TOLD_SD = 2.0
_GROSS = 0.5


@dataclass(frozen=True)
class Course:
    """The endocardium through the cycle: times (f,) from 0 below 1, positions (f, n, 3) mm, features per frame, phases.

    ``shrinkage``: of registration, where it has been undone in features and phases; positions are as they were tracked.
    ``closed``: whether what was left at a frame of end-diastole again has been spread over the cycle.
    """

    surface: Endocardium
    times: FloatArray
    positions: FloatArray
    features: list[dict[str, float]]
    phases: Phases
    shrinkage: Shrinkage | None = None
    closed: bool = False

    @classmethod
    def of(cls, surface: Endocardium, times: FloatArray, displacement: FloatArray, closed: bool = False) -> Course:
        """From the displacement (f, n, 3) mm of the bundle's points.

        InputError where the volume never rises from the first frame, or falls far below it: that is no end-diastole.
        """
        positions = surface.ed + displacement
        features = [surface.features(x) for x in positions]
        volume = np.array([row["volume_ml"] for row in features])
        if volume.max() < (1.0 + _LEAST_RISE) * volume[0]:
            raise InputError(
                f"the volume does not rise from the first frame ({volume[0]:.1f} mL, at most {volume.max():.1f} mL later): "
                "there is no end-systole. Is the first frame end-diastole, and the bundle made from it?"
            )
        least = int(np.argmin(volume))
        fall = float(volume[0] - volume[least])
        if fall > _GROSS * float(np.ptp(volume)) and fall > _LEAST_RISE * volume[0]:
            raise InputError(
                f"the first frame has {volume[0]:.1f} mL, frame {least} (time {times[least]:.3g}) {volume[least]:.1f} mL, the "
                f"largest {volume.max():.1f} mL: the first is not end-diastole, the atrium's least volume. Give the frame of "
                "least volume first, and mesh the bundle from it."
            )
        return cls(surface, times, positions, features, phases_of(times, volume), closed=closed)

    def doubts(self, model: ErrorModel) -> list[str]:
        """In words, whether a later frame's volume is below the first's by more than its error."""
        volume = np.array([row["volume_ml"] for row in self.features])
        least, sd = int(np.argmin(volume)), float(model.sd[model.keys.index("volume_ml")])
        if volume[0] - volume[least] <= _TOLD_SD * sd:
            return []
        return [
            f"the first frame has {volume[0]:.1f} mL, frame {least} (time {self.times[least]:.3g}) {volume[least]:.1f} mL "
            f"(sd {sd:.2g} mL): the first is not quite end-diastole, the atrium's least volume, and targets count from it. Give "
            "that frame first, and mesh the bundle from it, if it is end-diastole."
        ]

    def restored(self, shrinkage: Shrinkage | None) -> Course:
        """The same without the shrinkage of registration."""
        if shrinkage is None:
            return self
        features = [shrinkage.undone(row, self.features[0]) for row in self.features]
        phases = phases_of(self.times, np.array([row["volume_ml"] for row in features]))
        return replace(self, features=features, phases=phases, shrinkage=shrinkage)

    def positions_at(self, time: float) -> FloatArray:
        """(n, 3) mm at any time of the cycle: third-order spline per point through the frames, periodic."""
        closed = np.concatenate([self.positions, self.positions[:1]])
        spline = CubicSpline(np.append(self.times, 1.0), closed.reshape(len(closed), -1), axis=0, bc_type="periodic")
        return np.asarray(spline(time)).reshape(self.positions.shape[1:])

    def features_at(self, time: float) -> dict[str, float]:
        """All features at any time of the cycle."""
        row = self.tracked_at(time)
        return row if self.shrinkage is None else self.shrinkage.undone(row, self.features[0])

    def tracked_at(self, time: float) -> dict[str, float]:
        """The same as tracked, whatever registration has lost."""
        return self.surface.features(self.positions_at(time))

    def interpolation_error(self, time: float) -> dict[str, float]:
        """By how much a feature at a time depends on how one interpolates: cubic spline less monotone cubic; 0 at a frame."""
        t = np.concatenate([self.times - 1.0, self.times, self.times + 1.0])
        smooth = self.features_at(time)
        result = {}
        for key, value in smooth.items():
            course = np.array([row[key] for row in self.features])
            result[key] = value - float(PchipInterpolator(t, np.tile(course, 3))(time))
        return result

    def weights(self, time: float) -> FloatArray:
        """(f,): how much each frame counts in what is interpolated at a time."""
        one = np.eye(len(self.times))
        spline = CubicSpline(np.append(self.times, 1.0), np.vstack([one, one[:1]]), axis=0, bc_type="periodic")
        return np.asarray(spline(time))


@dataclass(frozen=True)
class Covaried:
    """Targets with the covariance (p, p) of their errors; ``time`` (p,) of each, None standing for end-systole."""

    targets: Targets
    covariance: FloatArray
    time: tuple[float | None, ...]

    def knowing(self, priors: tuple[Prior, ...] | None) -> Covaried:
        """With what is known of the simulator's inputs beside the images."""
        return replace(self, targets=replace(self.targets, priors=priors))


def measured(course: Course, model: ErrorModel, times: Sequence[float] | None = None) -> Covaried:
    """All features at ES (without a time in their names) and ``@<time>`` at every frame after ED, or at ``times``.

    Errors of one frame go together as ``model.correlation``, those of two frames by ``model.between``; end-diastole has none, and
    an interpolated time has those of the frames it is made from, and that of the interpolation. A drift that was corrected
    adds its own error (``errors.drift``). Where the course is restored from registration's shrinkage, what is
    not known of that moves all targets of a kind together.
    """
    es = course.phases.es
    wanted = [float(t) for t in (course.times[1:] if times is None else times)]
    wrong = [t for t in wanted if not 0.0 < t < 1.0]
    if wrong:
        raise UsageError(f"a target's time is a fraction of the RR interval between 0 and 1, got {wrong[0]:g}.")
    wanted = [t for t in wanted if abs(t - es) > SAME_ES]
    keys = [key for key in model.keys if key in course.features[0]]
    column = [model.keys.index(key) for key in keys]
    names: list[str] = []
    means: list[float] = []
    when: list[float | None] = []
    weights = []
    between = []
    changes = []
    for time in [None, *wanted]:
        at = es if time is None else time
        row = course.features_at(at)
        for key in keys:
            names.append(("esv_ml" if key == "volume_ml" else key) if time is None else at_time(key, time))
            means.append(row[key])
            changes.append(row[key] - course.features[0][key])
            when.append(time)
        weights.append(course.weights(at)[1:])
        missing = course.interpolation_error(at)
        between.append([missing[key] for key in keys])
    shared, own = frame_errors(course.times[1:], course.closed)
    w = np.array(weights)
    sd = model.sd[column]
    if course.shrinkage is not None:
        sd = sd * course.shrinkage.undoing(keys)
    common = np.broadcast_to(model.between, (len(model.keys),))[column]
    correlation = model.correlation[np.ix_(column, column)]
    covariance = np.zeros((len(names),) * 2)
    # an error is one that all frames have and one of its own; keys go together in each as the correlation says
    for over_time, part in ((np.outer(w @ shared, w @ shared), np.sqrt(common)), (w @ own @ w.T, np.sqrt(1.0 - common))):
        covariance += np.kron(over_time, correlation * np.outer(sd * part, sd * part))
    for i, error in enumerate(between):
        # what lies between frames is unknown for all features together
        part = slice(i * len(keys), (i + 1) * len(keys))
        covariance[part, part] += np.outer(error, error)
    if course.shrinkage is not None:
        covariance += course.shrinkage.covariance(keys * len(weights), np.array(changes))
    covariance[np.diag_indices_from(covariance)] *= 1.0 + _NUGGET
    targets = Targets(tuple(names), np.array(means), np.sqrt(np.diag(covariance)), es_time=es)
    return Covaried(targets, covariance, tuple(when))


def published(course: Course, ed_residual_mm: Mapping[str, float]) -> Covaried:
    """The seven of the published calibration: ESV (sd 5 % of ED volume) and mean displacements at ES (sd: what is left when
    end-diastole is registered to itself, by region), their errors independent, the motion as tracked, as there."""
    row = course.tracked_at(course.phases.es)
    values, sds = [], []
    for name in PUBLISHED:
        if name == "esv_ml":
            values.append(row["volume_ml"])
            sds.append(PUBLISHED_VOLUME_SHARE * course.phases.ed_volume_ml)
        else:
            region = name.removeprefix("d_").removesuffix("_mm")
            values.append(row[name])
            sds.append(max(ed_residual_mm[region], 1e-6))
    targets = Targets(PUBLISHED, np.array(values), np.array(sds), es_time=course.phases.es)
    return Covaried(targets, np.diag(targets.sd**2), (None,) * len(PUBLISHED))
