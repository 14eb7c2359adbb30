"""Choosing numerics from measured errors."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from lacli.base.errors import InputError
from lacli.contracts.scene import Scene, build_scene
from lacli.mechanics.numerics import accuracy
from lacli.mechanics.numerics.tradeoff import Variant, errors, keep, recommend, reference


def scene(folder: Path, order: int) -> Scene:
    return build_scene({"anatomy": {"bundle": "b"}}, [f"numerics.order={order}"], folder=folder, where="test")


def bundle(folder: Path) -> Path:
    """A stand-in: enough for its digest."""
    (folder / "b").mkdir()
    (folder / "b" / "wall.vtu").write_bytes(b"wall")
    (folder / "b" / "boundary.vtp").write_bytes(b"boundary")
    return folder / "b"


def variant(folder: Path, mesh: str, order: int, roof: float, status: str = "done") -> Variant:
    features = {"esv_ml": 100 + roof, "d_roof_mm": roof} if status == "done" else {}
    chosen = scene(folder, order)
    return Variant(mesh, accuracy.numerics_name(chosen), chosen, status, None, features, 10.0 * order, 100.0)


def test_errors_are_kept_in_the_bundle_and_travel_with_the_result(tmp_path: Path) -> None:
    bundle(tmp_path)
    variants = [variant(tmp_path, "own", 1, 3.5), variant(tmp_path, "own", 2, 3.1), variant(tmp_path, "finer", 2, 3.0)]
    best = reference(variants)
    assert best.mesh == "finer"
    keep(variants, best)
    assert accuracy.known_errors(scene(tmp_path, 1)) == pytest.approx({"esv_ml": 0.5, "d_roof_mm": 0.5})
    assert accuracy.known_errors(scene(tmp_path, 2)) == pytest.approx({"esv_ml": 0.1, "d_roof_mm": 0.1})
    (tmp_path / "b" / "wall.vtu").write_bytes(b"another wall")
    assert accuracy.known_errors(scene(tmp_path, 2)) == {}, "another mesh has other errors"


def test_meshes_that_agree_by_chance_in_one_region_tell_no_small_error(tmp_path: Path) -> None:
    """Root mean square of .3, .1 and .0003 mm: sqrt((.09 + .01 + 9e-8) / 3) = .18257 mm. Volume, in mL, stands alone."""
    bundle(tmp_path)
    differences = {"esv_ml": 0.01, "d_roof_mm": 0.3, "d_septum_mm": 0.1, "d_lateral_mm": 0.0003}
    accuracy.record(scene(tmp_path, 1), differences, scene(tmp_path, 2))
    known = accuracy.known_errors(scene(tmp_path, 1))
    assert known == pytest.approx({"esv_ml": 0.01, "d_roof_mm": 0.3, "d_septum_mm": 0.18257, "d_lateral_mm": 0.18257}, rel=1e-4)
    assert accuracy.kept_errors(tmp_path / "b") == [("p1_q4", differences)], "what was measured is kept as it was"


def test_a_difference_of_quadrature_alone_is_no_discretisation_error(tmp_path: Path) -> None:
    """Without finer cells, or where those failed, the reference is quadratic on the same mesh: it tells of linear ones."""
    bundle(tmp_path)
    careful = build_scene({"anatomy": {"bundle": "b"}}, ["numerics.quadrature=14"], folder=tmp_path, where="test")
    best = Variant("own", "p2_q14", careful, "done", None, {"esv_ml": 103.0, "d_roof_mm": 3.0}, 30.0, 100.0)
    variants = [variant(tmp_path, "own", 1, 3.5), variant(tmp_path, "own", 2, 3.001), best]
    failed = variant(tmp_path, "finer", 2, 0.0, "failed")
    for some in (variants, [*variants, failed]):
        assert reference(some) is best
        keep(some, reference(some))
        assert accuracy.known_errors(scene(tmp_path, 1)) == pytest.approx({"esv_ml": 0.5, "d_roof_mm": 0.5})
        assert accuracy.known_errors(scene(tmp_path, 2)) == accuracy.known_errors(careful) == {}


def test_errors_of_one_state_do_not_stand_for_another(tmp_path: Path) -> None:
    """A run that seeks a second way to end-systole may take the other of two states."""
    bundle(tmp_path)
    seeking = build_scene({"anatomy": {"bundle": "b"}}, ["outputs.equilibria=true"], folder=tmp_path, where="test")
    accuracy.record(scene(tmp_path, 2), {"d_roof_mm": 0.1}, scene(tmp_path, 2))
    assert accuracy.known_errors(seeking) == {}
    accuracy.record(seeking, {"d_roof_mm": 0.4}, seeking)
    assert accuracy.known_errors(seeking) == {"d_roof_mm": 0.4}
    assert accuracy.known_errors(scene(tmp_path, 2)) == {"d_roof_mm": 0.1}


def test_errors_that_do_not_say_what_was_measured_are_not_used(tmp_path: Path) -> None:
    (bundle(tmp_path) / accuracy.FILE).write_text('{"p2_q4": {"d_roof_mm": 0.1}}')
    assert accuracy.known_errors(scene(tmp_path, 2)) == {}
    accuracy.record(scene(tmp_path, 2), {"d_roof_mm": 0.2}, scene(tmp_path, 2))
    accuracy.record(scene(tmp_path, 1), {"d_roof_mm": 0.9}, scene(tmp_path, 2))
    assert accuracy.known_errors(scene(tmp_path, 2)) == {"d_roof_mm": 0.2}
    assert accuracy.known_errors(scene(tmp_path, 1)) == {"d_roof_mm": 0.9}


@pytest.mark.parametrize("change", ["value", "name", "seal", "measured"])
def test_errors_that_were_edited_are_refused(tmp_path: Path, change: str) -> None:
    file = bundle(tmp_path) / accuracy.FILE
    accuracy.record(scene(tmp_path, 2), {"d_roof_mm": 0.2}, scene(tmp_path, 2))
    document = json.loads(file.read_text())
    (entry,) = document["entries"].values()
    if change == "seal":
        del entry["digest"]
    elif change == "measured":
        entry["measured"]["lacli"] = "99"
    else:
        entry["errors"] = {"d_roof_mm": 0.02} if change == "value" else {"d_septum_mm": 0.2}
    file.write_text(json.dumps(document))
    with pytest.raises(InputError, match=r"accuracy\.json: cannot be read \(the errors .* were changed.*lacli tradeoff"):
        accuracy.known_errors(scene(tmp_path, 2))


def test_the_cheapest_good_choice_is_recommended() -> None:
    differences = {"p1_q4": {"d_roof_mm": 0.5, "esv_ml": 3.0}, "p2_q4": {"d_roof_mm": 0.1}, "p2_q14": {"d_roof_mm": 0.0}}
    cpu = {"p1_q4": 1.0, "p2_q4": 5.0, "p2_q14": 9.0}
    assert recommend(differences, cpu, 0.22) == "p2_q4"
    assert recommend(differences, cpu, 0.6) == "p1_q4"
    assert recommend({"p1_q4": {"d_roof_mm": 0.5}}, cpu, 0.22) is None


def test_nothing_that_ended_is_no_reference(tmp_path: Path) -> None:
    failed = variant(tmp_path, "own", 1, 0.0, "failed")
    with pytest.raises(InputError, match="no choice"):
        reference([failed])
    ended = variant(tmp_path, "own", 2, 1.0)
    assert errors(ended, ended) == {"esv_ml": 0.0, "d_roof_mm": 0.0}
    (bundle(tmp_path) / accuracy.FILE).write_text("{")
    with pytest.raises(InputError, match="tradeoff"):
        accuracy.known_errors(scene(tmp_path, 1))
