"""Tracking: frames and times, fields, phases, errors and their covariance, given motions, and the command on bad input."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from lacli.anatomy.inputs.image import Image, write
from lacli.anatomy.surface_features import Endocardium
from lacli.base.arrays import FloatArray
from lacli.base.errors import InputError, LacliError, StorageError, TableError, UsageError
from lacli.cli.main import build
from lacli.contracts.bundle import Bundle, save
from lacli.contracts.motion import load_motion
from lacli.contracts.targets import Targets, read_targets
from lacli.inference.sampling.likelihood import gaussian_log_likelihood
from lacli.motion import given as given_motion
from lacli.motion.errors import uncertainty
from lacli.motion.errors.stated import stated_model
from lacli.motion.field import Field, write_field
from lacli.motion.patient import from_given, smoothed
from lacli.motion.phases import phases_of
from lacli.motion.targets import Course, measured, published
from lacli.synthetic.atrium import synthesize


def quiet(*_: object) -> None:
    """A monitor that says nothing."""


@pytest.fixture(scope="module")
def bundle() -> Bundle:
    return synthesize(1, volume_ml=40.0, cell_size_mm=8.0, order=1, descent_mm=4.0)[0]


@pytest.fixture(scope="module")
def surface(bundle: Bundle) -> Endocardium:
    return Endocardium.of(bundle)


def grown(bundle: Bundle, times: FloatArray, most: float = 0.1) -> FloatArray:
    """Displacement (f, n, 3) of a heart that grows about its centre by ``most`` at the middle of the cycle."""
    course = most * 0.5 * (1.0 - np.cos(2.0 * np.pi * times))
    return course[:, None, None] * (bundle.points - bundle.points.mean(axis=0))


def constant_field(vector: tuple[float, float, float], size: int = 12, spacing: float = 2.0) -> Field:
    u = np.broadcast_to(np.array(vector, dtype=np.float32), (size, size, size, 3)).copy()
    return Field(u, np.full(3, spacing), np.zeros(3), np.eye(3))


# --- phases -----------------------------------------------------------------------------------------------------------------


def test_end_systole_lies_between_frames() -> None:
    """1 - cos about a peak at 0.43 of a smooth cycle: found to a hundredth from ten frames, the nearest frame 0.03 away."""
    times = np.arange(10) / 10
    warped = np.interp(times, [0, 0.43, 1.0], [0, np.pi, 2 * np.pi])
    phases = phases_of(times, 100.0 + 20.0 * (1 - np.cos(warped)))
    assert phases.es == pytest.approx(0.43, abs=0.015)
    assert phases.es_gap == pytest.approx(abs(phases.es - 0.4), abs=1e-12)
    assert phases.es_volume_ml == pytest.approx(140.0, abs=0.5)


def test_a_plateau_is_diastasis_and_without_one_conduit_meets_booster() -> None:
    times = np.arange(20) / 20
    plateau = np.interp(times, [0, 0.4, 0.55, 0.8, 1.0], [0.0, 40.0, 18.0, 17.0, 0.0])
    phases = phases_of(times, 60.0 + plateau)
    assert phases.diastasis and phases.conduit_end < 0.65 and 0.7 < phases.booster_start < 0.9
    assert [phases.name(t) for t in (0.0, 0.2, 0.45, 0.7, 0.95)] == ["ed", "reservoir", "conduit", "diastasis", "booster"]
    fast = phases_of(times, 100.0 + 20.0 * (1 - np.cos(2 * np.pi * times)))
    assert not fast.diastasis


def test_a_volume_that_never_rises_is_no_cycle(bundle: Bundle) -> None:
    times = np.arange(4) / 4
    with pytest.raises(InputError, match="does not rise"):
        from_given(bundle, times, -grown(bundle, times), (0.1, 0.1), "fields")


# --- errors and covariance ---------------------------------------------------------------------------------------------------


@given(st.integers(0, 10**6))
def test_the_covariance_is_one_whatever_the_errors(seed: int) -> None:
    """Any sample of errors gives a symmetric positive correlation of unit diagonal."""
    rng = np.random.default_rng(seed)
    keys = [f"{k}_{r}_mm" for k in "dnab" for r in ("roof", "septum")] + ["volume_ml"]
    common = rng.normal(size=3)
    model = uncertainty.error_model([dict(zip(keys, c + rng.normal(size=len(keys)), strict=True)) for c in common])
    assert np.allclose(model.correlation, model.correlation.T) and np.allclose(np.diag(model.correlation), 1.0)
    assert np.linalg.eigvalsh(model.correlation).min() > 0 and (model.sd > 0).all()
    assert np.all((model.between >= 0) & (model.between < 1))


def test_the_error_model_recovers_what_errors_were_drawn_from() -> None:
    """2000 motions, sd 0.3: frames are independent, regions correlate by 0.5."""
    rng = np.random.default_rng(5)
    keys = ["n_roof_mm", "n_septum_mm", "n_lateral_mm"]
    cov = 0.09 * (0.5 * np.eye(3) + 0.5)
    draws = rng.multivariate_normal(np.zeros(3), cov, 2000)
    model = uncertainty.error_model([dict(zip(keys, row, strict=True)) for row in draws])
    assert model.sd == pytest.approx([0.3] * 3, rel=0.05)
    assert model.correlation[0, 1] == pytest.approx(0.5, abs=0.05)
    # frames share nothing of what is seen, and half of what true motions err by beyond, 1 - 1 / 1.9^2 of the variance
    assert model.between == pytest.approx(np.full(3, 0.5 * (1 - 1 / 1.9**2)), abs=0.02)


def test_the_template_loses_the_noise_of_flat_places_and_keeps_edges() -> None:
    """Nine frames of a step of 300 HU with noise of sd 20: away from the step a fifth of the mean's 6.7 is left at most; the step
    stays, and the noise is told as 20."""
    rng = np.random.default_rng(7)
    still = Field(np.zeros((24, 24, 24, 3), np.float32), np.ones(3), np.zeros(3), np.eye(3))
    step = np.where(np.arange(24) < 12, 0.0, 300.0)

    def frame() -> Image:
        return Image((step + rng.normal(0, 20.0, (24, 24, 24))).astype(np.float32), np.ones(3), np.zeros(3), np.eye(3))

    found = uncertainty.template(frame(), [frame() for _ in range(9)], [still] * 9)
    assert found.noise_hu == pytest.approx(20.0, rel=0.05)
    assert found.image.array[..., :9].std() < 20.0 / 3.0 / 5.0
    middle = found.image.array.mean(axis=(0, 1))
    assert middle[13] - middle[10] == pytest.approx(300.0, abs=5.0)
    assert uncertainty.noisy(found.image, found, rng).array[..., :9].std() == pytest.approx(20.0, rel=0.06)


def test_surface_error_splits_a_shift_along_the_normal_from_one_along_the_wall(bundle: Bundle, surface: Endocardium) -> None:
    from lacli.motion.axes import nodal_axes

    axes = nodal_axes(bundle, surface)
    along = uncertainty.surface_error(surface, 0.5 * axes["normal"])
    across = uncertainty.surface_error(surface, 0.5 * axes["alpha"])
    assert along.normal["global"] > 0.4 and along.tangential["global"] < 0.2
    assert across.tangential["global"] > 0.4 and across.normal["global"] < 0.2
    assert along.whole["global"] <= 0.5 + 1e-9
    # an error of a known motion is made a true one's: 1.9 times along the normal, 1.4 times across
    normal = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 0.0]])
    error = uncertainty.as_of_a_true_motion(np.array([[1.0, 0.0, 2.0], [1.0, 0.0, 2.0]]), normal)
    assert error == pytest.approx(np.array([[1.4, 0.0, 3.8], [1.4, 0.0, 2.8]]))


def test_targets_have_the_features_of_the_motion_and_a_proper_covariance(bundle: Bundle, surface: Endocardium) -> None:
    times = np.arange(8) / 8
    course = Course.of(surface, times, grown(bundle, times))
    model = stated_model(bundle, course, 0.2, 0.4)
    found = measured(course, model)
    value = dict(zip(found.targets.names, found.targets.mean, strict=True))
    assert course.phases.es == pytest.approx(0.5, abs=1e-6)
    assert value["esv_ml"] == pytest.approx(1.1**3 * surface.features(bundle.points)["volume_ml"], rel=1e-9)
    assert value["area_strain_roof"] == pytest.approx(0.21, rel=1e-9)  # 1.1^2 - 1
    assert value["area_strain_roof@0.25"] == pytest.approx(1.05**2 - 1, rel=1e-9)
    assert not any(name.endswith("@0.5") for name in value)  # the frame at ES is ES
    np.linalg.cholesky(found.covariance)
    assert found.targets.sd == pytest.approx(np.sqrt(np.diag(found.covariance)))
    at = list(found.targets.names)
    i, j = at.index("n_roof_mm@0.25"), at.index("n_roof_mm@0.75")
    assert found.covariance[i, j] == pytest.approx(0.5 * 0.2**2, rel=1e-3)  # half is shared between frames


def test_what_lies_between_frames_is_less_certain(bundle: Bundle, surface: Endocardium) -> None:
    times = np.arange(4) / 4
    course = Course.of(surface, times, grown(bundle, times))
    model = stated_model(bundle, course, 0.1, 0.1)
    found = measured(course, model, [0.25, 0.4])
    sd = dict(zip(found.targets.names, found.targets.sd, strict=True))
    assert sd["d_roof_mm@0.4"] > sd["d_roof_mm@0.25"]


def test_the_published_seven(bundle: Bundle, surface: Endocardium) -> None:
    times = np.arange(8) / 8
    course = Course.of(surface, times, grown(bundle, times))
    residual = {name: 0.1 + 0.1 * i for i, name in enumerate(("global", "anterior", "posterior", "septum", "lateral", "roof"))}
    found = published(course, residual)
    assert found.targets.names == ("esv_ml", "d_global_mm", *(f"d_{r}_mm" for r in list(residual)[1:]))
    assert found.targets.sd[0] == pytest.approx(0.05 * course.phases.ed_volume_ml)
    assert found.targets.sd[1:] == pytest.approx(list(residual.values()))


def test_smoothing_keeps_a_motion_of_few_harmonics_and_end_diastole(bundle: Bundle) -> None:
    times = np.arange(10) / 10
    moved = grown(bundle, times)
    assert np.allclose(smoothed(times, moved, 2), moved, atol=1e-9)
    rough = moved + np.random.default_rng(0).normal(0, 0.2, moved.shape) * (times > 0)[:, None, None]
    assert np.abs(smoothed(times, rough, 2) - moved).mean() < np.abs(rough - moved).mean()
    with pytest.raises(UsageError):
        smoothed(times, moved, 5)


def test_a_closure_is_spread_over_the_cycle(bundle: Bundle) -> None:
    times = np.array([0.0, 0.25, 0.5, 1.0])
    drift = times[:, None, None] * np.array([0.4, 0.0, 0.0])
    right = grown(bundle, times)
    tracked = from_given(bundle, times, right + drift, (0.1, 0.1), "fields")
    assert tracked.closure_mm == pytest.approx(0.4)
    assert np.abs(tracked.course.positions - bundle.points - right[:-1]).max() < 1e-12


def test_a_correlated_likelihood_is_the_density_of_the_normal_distribution() -> None:
    from scipy.stats import multivariate_normal

    rng = np.random.default_rng(2)
    a = rng.normal(size=(4, 4))
    cov = a @ a.T + np.eye(4)
    targets = Targets(("a", "b", "c", "d"), rng.normal(size=4), np.sqrt(np.diag(cov)), cov)
    mean, variance = rng.normal(size=(6, 4)), rng.uniform(0, 1, (6, 4))
    got = gaussian_log_likelihood(mean, variance, targets)
    want = [multivariate_normal(targets.mean, cov + np.diag(v)).logpdf(m) for m, v in zip(mean, variance, strict=True)]
    assert got == pytest.approx(want)
    independent = Targets(targets.names, targets.mean, targets.sd, np.diag(targets.sd**2))
    plain = Targets(targets.names, targets.mean, targets.sd)
    assert gaussian_log_likelihood(mean, variance, independent) == pytest.approx(gaussian_log_likelihood(mean, variance, plain))


# --- given motions and the command -------------------------------------------------------------------------------------------


def run(*arguments: str) -> str:
    result = CliRunner().invoke(build({"track"}), ["track", *arguments], catch_exceptions=False)
    assert result.exit_code == 0
    return result.stdout


@pytest.fixture
def folder(bundle: Bundle, tmp_path: Path) -> Path:
    save(bundle, tmp_path / "bundle")
    return tmp_path


def surfaces_of(bundle: Bundle, folder: Path, displacement: FloatArray, suffix: str = ".vtp", sign: float = 1.0) -> None:
    import pyvista as pv

    triangles = bundle.cavity_triangles()[:, :3]
    used, local = np.unique(triangles, return_inverse=True)
    cells = np.column_stack([np.full(len(triangles), 3), local.reshape(-1, 3)]).ravel()
    folder.mkdir()
    for number, u in enumerate(displacement):
        pv.PolyData((bundle.points + u)[used] * [sign, sign, 1.0], cells).save(folder / f"s{number}{suffix}")


@pytest.mark.parametrize(("suffix", "axes"), [(".vtp", "lps"), (".ply", "lps"), (".vtk", "ras")])
def test_surfaces_with_the_same_points_give_their_motion(bundle: Bundle, folder: Path, suffix: str, axes: str) -> None:
    times = np.arange(5) / 5
    surfaces_of(bundle, folder / "frames", grown(bundle, times), suffix, -1.0 if axes == "ras" else 1.0)
    options = ["--bundle", str(folder / "bundle"), "--out", str(folder / "m"), "--no-figures", "--json"]
    answer = json.loads(
        run(str(folder / "frames"), *options, "--motion", "surfaces", "--axes", axes, "--error-mm", "0.2,0.4", "--update-bundle")
    )
    assert answer["targets"]["area_strain_roof@0.4"]["mean"] == pytest.approx((1 + 0.1 * 0.9045) ** 2 - 1, rel=2e-3)
    motion = load_motion(folder / "bundle")
    assert np.abs(motion.positions[0] - bundle.points[motion.wall_point]).max() < 1e-9
    targets = read_targets(folder / "m" / "targets.toml")
    assert targets.covariance is not None and targets.covariance.shape == (len(targets.names),) * 2
    assert (folder / "m" / "frames" / "series.pvd").is_file() and (folder / "m" / "transients.csv").is_file()
    (folder / "m" / "targets_covariance.npz").write_bytes(b"PK\x03\x04")
    with pytest.raises(TableError, match="not a covariance"):
        read_targets(folder / "m" / "targets.toml")


def test_surfaces_with_other_points_give_the_normal_motion(bundle: Bundle, surface: Endocardium) -> None:
    import pyvista as pv

    times = np.arange(4) / 4
    moved = grown(bundle, times)
    triangles = bundle.cavity_triangles()[:, :3]
    meshes = []
    for u in moved:
        cells = np.column_stack([np.full(len(triangles), 3), triangles]).ravel()
        fine = pv.PolyData(bundle.points + u, cells).clean().subdivide(1, "linear")
        meshes.append((np.asarray(fine.points, dtype=float), fine.faces.reshape(-1, 4)[:, 1:]))
    found = given_motion._other_points(bundle, surface, meshes, quiet)
    for u, right in zip(found[1:], moved[1:], strict=True):
        got, want = surface.features(bundle.points + u), surface.features(bundle.points + right)
        assert got["volume_ml"] == pytest.approx(want["volume_ml"], rel=0.02)
        assert all(abs(got[f"n_{r}_mm"] - want[f"n_{r}_mm"]) < 0.3 for r in ("anterior", "posterior", "roof"))


def test_given_fields(bundle: Bundle, folder: Path) -> None:
    low, high = bundle.points.min(axis=0) - 5, bundle.points.max(axis=0) + 5
    size = np.ceil((high - low) / 4.0).astype(int) + 1
    for number, shift in enumerate((1.0, 2.0, 1.0)):
        u = np.zeros((*size[::-1], 3), dtype=np.float32)
        u[..., 2] = shift
        write_field(Field(u, np.full(3, 4.0), low, np.eye(3)), folder / "fields" / f"u{number}.nrrd")
    found = given_motion.displacement(bundle, "fields", [folder / "fields"], "lps", None, quiet)
    assert found[:, :, 2].mean(axis=1) == pytest.approx([0, 1, 2, 1])
    with pytest.raises(InputError, match="covers"):
        shifted = Field(np.zeros((8, 8, 8, 3), np.float32), np.ones(3), np.full(3, 900.0), np.eye(3))
        write_field(shifted, folder / "far.nrrd")
        given_motion.displacement(bundle, "fields", [folder / "far.nrrd"], "lps", None, quiet)


def frames_of(bundle: Bundle, folder: Path, growth: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)) -> list[Path]:
    """Small frames: blood where the cavity is about, ``growth`` mm wider in each, darker around, some noise."""
    rng = np.random.default_rng(0)
    low, high = bundle.points.min(axis=0) - 12, bundle.points.max(axis=0) + 12
    spacing = 2.0
    size = np.ceil((high - low) / spacing).astype(int)
    import pyvista as pv

    triangles = bundle.cavity_triangles()[:, :3][:, ::-1]
    mesh = pv.PolyData(bundle.points, np.column_stack([np.full(len(triangles), 3), triangles]).ravel()).clean()
    grid = pv.ImageData(dimensions=tuple(size), spacing=(spacing,) * 3, origin=tuple(low))
    distance = grid.compute_implicit_distance(mesh)["implicit_distance"].reshape(size[::-1])
    paths = []
    for number, more in enumerate(growth):
        hu = 350.0 - 410.0 / (1.0 + np.exp(more - distance)) + rng.normal(0, 15, distance.shape)
        path = folder / f"f{number}.nrrd"
        write(Image(hu.astype(np.int16), np.full(3, spacing), low, np.eye(3)), path)
        paths.append(path)
    return paths


def _damage(kind: str, paths: list[Path]) -> list[str]:
    """Spoil one of the frames; further options of the command."""
    from lacli.anatomy.inputs.image import read

    image = read(paths[2])
    if kind == "size":
        write(image.with_array(image.array[:-1]), paths[2])
    elif kind == "spacing":
        write(Image(image.array, image.spacing * 1.1, image.origin, image.direction), paths[2])
    elif kind == "origin":
        write(Image(image.array, image.spacing, image.origin + 3.0, image.direction), paths[2])
    elif kind == "corrupt":
        paths[2].write_bytes(paths[2].read_bytes()[:200])
    elif kind == "missing":
        paths[2].unlink()
    elif kind == "labels":
        write(image.with_array((image.array > 100).astype(np.int16)), paths[2])
    elif kind == "elsewhere":
        for path in paths:
            write(Image(image.array, image.spacing, image.origin + 400.0, image.direction), path)
    elif kind == "not its image":
        for path in paths:
            write(image.with_array(image.array[::-1, ::-1, ::-1].copy() * -1), path)
    elif kind == "times":
        return ["--times", "0,20,10,30"]
    return []


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("size", "f2.nrrd: .* voxels, but"),
        ("spacing", "f2.nrrd: voxels of"),
        ("origin", "f2.nrrd: lies"),
        ("corrupt", "f2.nrrd: "),
        ("missing", "f2.nrrd: no such frame"),
        ("labels", "f2.nrrd: has only .* label map"),
        ("elsewhere", "f0.nrrd: the bundle's atrium lies outside"),
        ("not its image", "f0.nrrd: only .* is not the image the bundle was made from"),
        ("times", "do not increase: frame 2"),
    ],
)
def test_bad_input_gets_one_message_and_leaves_nothing(bundle: Bundle, folder: Path, kind: str, message: str) -> None:
    paths = frames_of(bundle, folder)
    more = _damage(kind, paths)
    with pytest.raises(LacliError, match="(?s)" + message.replace(" ", r"\s")):
        run(*map(str, paths), "--bundle", str(folder / "bundle"), "--out", str(folder / "m"), *more)
    assert not (folder / "m").exists()
    assert not [p for p in folder.iterdir() if p.name.startswith(".")]


def test_a_folder_with_frames_of_ones_own_is_not_replaced(bundle: Bundle, folder: Path) -> None:
    """A synthetic patient has its CT in frames/, where tracking would put its surfaces."""
    (folder / "p" / "frames").mkdir(parents=True)
    paths = frames_of(bundle, folder / "p" / "frames")
    with pytest.raises(StorageError, match="holds frames that"):
        run(str(folder / "p" / "frames"), "--bundle", str(folder / "bundle"), "--out", str(folder / "p"))
    assert all(path.is_file() for path in paths)


@pytest.mark.slow
def test_a_small_case_is_tracked_and_a_rerun_registers_nothing(bundle: Bundle, folder: Path) -> None:
    """A cavity 2 mm wider in the middle of the cycle: it grows by about its area times 2 mm; a rerun finds all registrations."""
    paths = [str(path) for path in frames_of(bundle, folder, (0.0, 1.0, 2.0, 1.0))]
    options = ["--bundle", str(folder / "bundle"), "--out", str(folder / "m"), "--json", "--known-motions", "2", "--no-figures"]
    first = json.loads(run(*paths, *options))
    assert first["registrations_kept"] == 0 and first["registrations"] == 6
    assert first["phases"]["es"] == pytest.approx(0.5, abs=0.1)
    normal = [first["targets"][f"n_{region}_mm"]["mean"] for region in ("anterior", "posterior", "septum", "lateral", "roof")]
    assert np.mean(normal) == pytest.approx(2.0, abs=0.6)
    second = json.loads(run(*paths, *options))
    assert second["registrations_kept"] == 6
    assert second["targets"] == first["targets"]
