"""Features of a deformed endocardium against motions whose features are known by hand."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from lacli.anatomy.surface_features import Endocardium, cavity_volume_ml
from lacli.contracts.bundle import Bundle
from lacli.contracts.features import FEATURES, KEYS, at_time, parse
from lacli.contracts.labels import REGIONS
from lacli.geometry.quadrature import at_quadrature, tangents
from lacli.synthetic.atrium import synthesize


@pytest.fixture(scope="module")
def bundle() -> Bundle:
    return synthesize(1, volume_ml=70.0, cell_size_mm=8.0)[0]


@pytest.fixture(scope="module")
def surface(bundle: Bundle) -> Endocardium:
    return Endocardium.of(bundle)


def test_all_features_are_in_the_table_and_all_of_the_table_are_measured(surface: Endocardium) -> None:
    found = set(surface.features(surface.ed))
    assert found == set(KEYS) - {"edv_ml", "esv_ml"}  # those two are volume_ml at a named time
    assert len(KEYS) == len(FEATURES)


def test_scaling_stretches_every_direction_alike(bundle: Bundle, surface: Endocardium) -> None:
    found = surface.features(1.1 * surface.ed)
    assert found["volume_ml"] == pytest.approx(1.1**3 * cavity_volume_ml(bundle, bundle.points), rel=1e-12)
    for region in REGIONS:
        assert found[f"area_strain_{region}"] == pytest.approx(0.21, rel=1e-9)  # 1.1^2 - 1
        assert found[f"fibre_strain_{region}"] == pytest.approx(0.105, rel=1e-9)  # (1.1^2 - 1) / 2


def test_a_stretch_along_one_axis_is_felt_by_fibres_along_it_only(bundle: Bundle) -> None:
    """F = diag(1.2, 1, 1): E along a fibre f is (1.44 - 1) / 2 fx^2, f the fibre laid into the surface."""
    surface = Endocardium.of(bundle)
    found = surface.features(bundle.points * [1.2, 1.0, 1.0])
    for region, number in REGIONS.items():
        here = surface.region == number
        assert 0 <= found[f"fibre_strain_{region}"] <= 0.22
        assert surface.along is not None
        weight = surface.area[here]
        d1, d2 = tangents(surface.faces[here], surface.ed)
        fibre = surface.along[here][..., :1] * d1 + surface.along[here][..., 1:] * d2
        assert np.allclose(np.linalg.norm(fibre, axis=2), 1.0)
        assert found[f"fibre_strain_{region}"] == pytest.approx(0.22 * np.average(fibre[..., 0] ** 2, weights=weight), rel=1e-9)


def test_a_rigid_motion_strains_nothing_and_a_shift_has_its_length(bundle: Bundle, surface: Endocardium) -> None:
    turned = Rotation.from_rotvec([0.2, -0.1, 0.3]).apply(bundle.points)
    for name, value in surface.features(turned).items():
        if "strain" in name:
            assert value == pytest.approx(0.0, abs=1e-12)
    shift = np.array([2.0, -1.0, 2.0])  # length 3
    found = surface.features(bundle.points + shift)
    assert found["volume_ml"] == pytest.approx(cavity_volume_ml(bundle, bundle.points), rel=1e-9)
    for region in REGIONS:
        assert found[f"d_{region}_mm"] == pytest.approx(3.0, rel=1e-12)
        assert abs(found[f"n_{region}_mm"]) < 3.0


def test_the_normal_points_out_of_the_cavity_and_the_tangents_lie_in_the_wall(surface: Endocardium) -> None:
    assert surface.alpha is not None and surface.beta is not None
    centre = surface.ed[surface.faces].mean(axis=(0, 1))
    outward = (at_quadrature(surface.faces, surface.ed - centre) * surface.normal).sum(2)
    assert (surface.area * np.sign(outward)).sum() > 0.8 * surface.area.sum()
    for tangent in (surface.alpha, surface.beta):
        assert np.abs((tangent * surface.normal).sum(2)).max() < 1e-9
        assert np.allclose(np.linalg.norm(tangent, axis=2), 1.0)
    grown = surface.features(surface.ed + 0.05 * (surface.ed - centre))
    assert all(grown[f"n_{region}_mm"] > 0 for region in REGIONS)


def test_tangents_lead_from_septum_to_lateral_wall_and_from_back_to_front(bundle: Bundle, surface: Endocardium) -> None:
    """A small step along the tangent makes the coordinate grow by its gradient."""
    assert bundle.uac is not None and surface.alpha is not None
    d1, d2 = tangents(surface.faces, surface.ed)
    s1, s2 = tangents(surface.faces, bundle.uac)
    for tangent, k in ((surface.alpha, 0), (surface.beta, 1)):
        assert tangent is not None
        # tangent = c1 d1 + c2 d2; growth = c1 ds1 + c2 ds2
        basis = np.stack([d1, d2], axis=-1)
        share = np.linalg.lstsq(basis.reshape(-1, 3, 2)[0], tangent.reshape(-1, 3)[0], rcond=None)[0]
        growth = share @ [s1[..., k].ravel()[0], s2[..., k].ravel()[0]]
        assert growth > 0


@given(st.sampled_from(sorted(KEYS)), st.floats(0, 1))
def test_a_name_with_a_time_is_read_back(key: str, time: float) -> None:
    feature, read = parse(at_time(key, time))
    assert feature.key == key and read == pytest.approx(time, abs=5.1e-5)
    assert at_time(key, read) == at_time(key, time)


@pytest.mark.parametrize("name", ["nonsense", "d_roof", "d_roof_mm@", "d_roof_mm@1.5", "d_roof_mm@nan", "@0.1"])
def test_other_names_are_refused(name: str) -> None:
    with pytest.raises(ValueError):
        parse(name)
