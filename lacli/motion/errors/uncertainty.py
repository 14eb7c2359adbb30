"""How far tracking errs on this patient: a known motion like the tracked one is applied to the patient's own image and tracked.

Errors of the features, and how they go together between frames and regions, are read from that. Lengths mm.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from lacli.anatomy.inputs.image import Image
from lacli.anatomy.surface_features import Endocardium
from lacli.base.arrays import FloatArray
from lacli.contracts.features import kind_of
from lacli.contracts.labels import REGIONS
from lacli.contracts.tables.error_groups import Groups
from lacli.geometry.quadrature import at_quadrature
from lacli.motion.errors.shrinkage import Shrinkage, shrinkage_of, slope_of
from lacli.motion.field import Field, pull
from lacli.motion.tracking import Pair

SEED = 20260420
# The applied motion is a tracked one, already as smooth as the engine makes it, and is found more easily than the true one was:
# true errors over those of known motions, along the normal and tangential, of the training cases (docs/methods.md).
EASIER = (1.9, 1.4)
_NORMAL = ("n", "volume")  # kinds whose errors are of the normal; of others most is tangential
_UNCORRELATED = 0.02
_WINDOW = 5  # voxels of the local mean and variance
_PRIOR_SAMPLES = 8.0
# motions' worth of independence: few motions do not tell what combinations of errors are impossible (a correlation drawn towards
# independence, as Schaefer, Strimmer 2005, Stat Appl Genet Mol Biol 4:32; figures in docs/methods.md)
_APART = 2.0
# of what known motions do not show (they are smooth as tracked ones are), taken for shared between frames: it may be all of it or
# nothing, as of a motion whose error is stated
SHARED = 0.5


@dataclass(frozen=True)
class SurfaceError:
    """Area-weighted means over the endocardium of |e|, of |e . n| and of the tangential |e|, mm; by region and for "global"."""

    whole: dict[str, float]
    normal: dict[str, float]
    tangential: dict[str, float]


def surface_error(surface: Endocardium, error: FloatArray) -> SurfaceError:
    """Of an error e (n, 3) mm at the bundle's points."""
    e = at_quadrature(surface.faces, error)
    along = (e * surface.normal).sum(axis=2)
    sizes = [np.linalg.norm(e, axis=2), np.abs(along), np.linalg.norm(e - along[..., None] * surface.normal, axis=2)]
    result: list[dict[str, float]] = []
    for size in sizes:
        means = {"global": float((surface.area * size).sum() / surface.area.sum())}
        for name, number in REGIONS.items():
            here = surface.region == number
            if here.any():
                means[name] = float((surface.area[here] * size[here]).sum() / surface.area[here].sum())
        result.append(means)
    return SurfaceError(*result)


def as_of_a_true_motion(error: FloatArray, normal: FloatArray) -> FloatArray:
    """The error (n, 3) mm that a true motion would have where the known one has ``error``; normal (n, 3): unit or 0."""
    along = (error * normal).sum(axis=1, keepdims=True) * normal
    return EASIER[0] * along + EASIER[1] * (error - along)


@dataclass(frozen=True)
class Template:
    """The patient's end-diastole with next to no noise: mean of all frames pulled back to it, cleaned; the noise of one frame,
    sd (HU), and its correlation over a voxel's step."""

    image: Image
    noise_hu: float
    correlation: float


def template(ed: Image, frames: Sequence[Image], fields: Sequence[Field]) -> Template:
    """From the frames after end-diastole and their fields."""
    total = np.zeros(ed.array.shape)
    for frame, field in zip(frames, fields, strict=True):
        total += pull(frame, field).array
    mean = total / len(frames)
    rest = ed.array - mean
    rest = rest - np.median(rest)
    # the median is of the many voxels where nothing but noise differs, not of the borders
    size = 1.4826 * float(np.median(np.abs(rest))) / np.sqrt(1.0 + 1.0 / len(frames))
    small = np.abs(rest) < 3.0 * max(size, 1e-9)
    both = small[..., 1:] & small[..., :-1]
    lag = (
        float((rest[..., 1:] * rest[..., :-1])[both].mean() / max(float((rest[small] ** 2).mean()), 1e-12)) if both.any() else 0.0
    )
    lag = float(np.clip(lag, 0.0, 0.9))
    return Template(ed.with_array(cleaned(mean, size / np.sqrt(len(frames)))), size, lag)


def cleaned(array: NDArray[Any], noise: float) -> NDArray[np.float32]:
    """Without noise of that sd where the local variance is no more than its own (Lee 1980, IEEE Trans PAMI 2:165).

    Noise that the mean of the frames still has would move with the known motion, as the tissue does; inside blood and muscle,
    where there is nothing else, it would be what the engine tracks, and the error would be found too small.
    """
    x = array.astype(np.float64)
    mean = ndimage.uniform_filter(x, _WINDOW)
    variance = np.maximum(ndimage.uniform_filter((x - mean.mean()) ** 2, _WINDOW) - (mean - mean.mean()) ** 2, 1e-9)
    return np.asarray(mean + np.maximum(1.0 - noise**2 / variance, 0.0) * (x - mean), dtype=np.float32)


def _width(correlation: float) -> float:
    """s of smoothed white noise from its correlation exp(-1 / (4 s^2)) over a step."""
    return float(np.sqrt(-1.0 / (4.0 * np.log(correlation)))) if correlation > _UNCORRELATED else 0.0


def noisy(image: Image, of: Template, rng: np.random.Generator) -> Image:
    """The image with fresh noise like a frame's."""
    noise = rng.normal(size=image.array.shape).astype(np.float32)
    if of.correlation > _UNCORRELATED:
        noise = ndimage.gaussian_filter(noise, _width(of.correlation))
        noise /= noise.std()
    return image.with_array(image.array + np.float32(of.noise_hu) * noise)


@dataclass(frozen=True)
class Known:
    """A pair whose motion is known: displacement (n, 3) mm of the bundle's points from the first image to the second."""

    pair: Pair
    displacement: FloatArray


def known_pair(name: str, of: Template, field: Field | None, points: FloatArray, seed: int) -> Known:
    """The template at rest and moved by the field (None: not moved), each with its own noise.

    At rest it is one image for all seeds: a patient's frames are all registered to one end-diastole, whose noise they share.
    """
    rng = np.random.default_rng([SEED, seed, 1])
    rest = noisy(of.image, of, np.random.default_rng(SEED))
    if field is None:
        return Known(Pair(name, rest, noisy(of.image, of, rng)), np.zeros_like(points))
    back = _on_grid(field.inverse(), of.image)
    moved = pull(of.image, back)
    # the moved image is the template at y + v(y): what was at x is now at x + w(x), w the inverse of v, exactly
    w = back.solve_inverse_at(points, field.at(points))
    return Known(Pair(name, rest, noisy(moved, of, rng)), w)


def _on_grid(field: Field, image: Image) -> Field:
    """The field on the voxels of the image, linear between its own."""
    step = field.spacing / image.spacing
    index = np.meshgrid(*(np.arange(n) / s for n, s in zip(image.array.shape, step[::-1], strict=True)), indexing="ij")
    u = np.stack([ndimage.map_coordinates(field.u[..., i], index, order=1, mode="nearest") for i in range(3)], axis=-1)
    return Field(u.astype(np.float32), image.spacing, image.origin, image.direction)


def chosen_frames(count: int, most: int) -> list[int]:
    """Which of ``count`` fields a known motion is made of: all, or ``most`` spread evenly."""
    return sorted({round(i) for i in np.linspace(0, count - 1, min(count, most))}) if most > 0 else []


@dataclass(frozen=True)
class ErrorModel:
    """Errors of features: sd by key, correlation (k, k) between keys of one frame, ``between`` frames (one number, or by key).

    ``shrinkage``, by key: what registration finds of a change, less the change, over it (-0.03: 3 % too little), and its sd.
    """

    keys: tuple[str, ...]
    sd: FloatArray
    correlation: FloatArray
    between: FloatArray | float
    samples: int
    shrinkage: Shrinkage | None = None


def error_model(errors: Sequence[Mapping[str, float]], changes: Sequence[Mapping[str, float]] | None = None) -> ErrorModel:
    """From the features' errors in several known motions, and their changes since end-diastole there.

    With changes, the part of the errors that goes with them is the shrinkage, and the rest the error. A region's sd is drawn
    towards that of its kind over all regions, since few motions tell it. Correlations are means over regions and motions for
    each two kinds, within a region and between two. What frames share is, by kind, the mean product of one feature's errors in
    two motions; of what known motions do not show it is a half.
    """
    keys = tuple(errors[0])
    e = np.array([[row[key] for key in keys] for row in errors])
    found, taken = None, np.zeros(len(keys))
    kinds = [kind_of(key) for key in keys]
    names = [kind for kind, _ in kinds]
    if changes is not None:
        change = np.array([[row[key] for key in keys] for row in changes])
        found = shrinkage_of(keys, e, change)
        for kind in set(names):
            here = np.array([name == kind for name in names])
            # the slope goes along with the errors that it is fitted to, and takes this much of their square away
            taken[here] = slope_of(e[:, here], change[:, here])[1] * (change[:, here] ** 2).mean(axis=0)
        e = e - found.share * change
    own = (e**2).mean(axis=0) + taken
    pooled = {kind: float(np.mean(own[[i for i, n in enumerate(names) if n == kind]])) for kind in set(names)}
    prior = np.array([pooled[name] for name in names])
    sd = np.sqrt((len(e) * own + _PRIOR_SAMPLES * prior) / (len(e) + _PRIOR_SAMPLES))
    sd = np.maximum(sd, 1e-9)
    z = e / sd
    groups = Groups.of_features(keys, whole_with_all=True)
    correlation = groups.correlation(groups.means(z.T @ z / len(e)), len(e) / (len(e) + _APART))
    return ErrorModel(keys, sd, correlation, _between(z, names), len(e), found)


def _between(z: FloatArray, names: Sequence[str]) -> FloatArray:
    """(k,): the correlation between frames of each key's error, one for all keys of a kind, from errors over their sd (m, k)."""
    pairs = np.zeros(z.shape[1])
    if len(z) > 1:
        pairs = (z.sum(axis=0) ** 2 - (z**2).sum(axis=0)) / (len(z) * (len(z) - 1))
    result = np.zeros(len(names))
    for kind in set(names):
        here = np.array([name == kind for name in names])
        shown = 1.0 / EASIER[0 if kind in _NORMAL else 1] ** 2
        result[here] = shown * np.clip(pairs[here].mean(), 0.0, 0.95) + (1.0 - shown) * SHARED
    return result
