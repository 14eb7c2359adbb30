"""What labels mean: written by hand, by a set's name, and where vessels' labels meet the atrium's."""

from __future__ import annotations

import contextlib
import json
import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner, Result

from lacli.anatomy.inputs import labelled
from lacli.anatomy.inputs.image import Image
from lacli.anatomy.openings.candidate import VEIN
from lacli.base.errors import AnatomyError, UsageError
from lacli.cli.main import build


def test_names_numbers_and_pairs() -> None:
    said = labelled.read("la=2, lv=3,LAA=61,pv=7+8")
    assert (said.la, said.lv, said.wall) == (2, 3, None)
    assert said.vessels == {61: "appendage", 7: VEIN, 8: VEIN}


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("la", "'la' is not NAME=NUMBER"),
        ("la=2,vein=3", "'vein=3' is not NAME=NUMBER"),
        ("la=2,lv=2", "label 2 is la and lv"),
        ("la=2,la=3", "la is one label"),
        ("la=2+3", "la is one label"),
        ("la=0", "label 0 is the background"),
        ("la=-1", "is not NAME=NUMBER"),
        ("", "is not NAME=NUMBER"),
    ],
)
def test_what_is_no_meaning_is_said(text: str, words: str) -> None:
    with pytest.raises(UsageError, match=words.replace("+", r"\+")):
        labelled.read(text)


@given(st.dictionaries(st.integers(1, 999), st.sampled_from(sorted(labelled.VESSELS)), max_size=8), st.integers(1000, 2000))
def test_whatever_is_written_is_read(vessels: dict[int, str], la: int) -> None:
    text = ",".join([f"la={la}", *(f"{name}={value}" for value, name in vessels.items())])
    assert labelled.read(text) == labelled.Meaning(la, None, None, {v: labelled.VESSELS[n] for v, n in vessels.items()})


@given(st.text(max_size=30))
def test_any_text_is_read_or_refused(text: str) -> None:
    with contextlib.suppress(UsageError):
        labelled.read(text)


def test_every_set_is_readable_and_leaves_out_what_is_not_there() -> None:
    for name in labelled.PRESETS:
        assert labelled.preset(name, set()).la is not None
    assert labelled.preset("totalsegmentator", {2, 53}) == labelled.Meaning(2, None, None, {53: VEIN})
    with pytest.raises(UsageError, match="mmwhs"):
        labelled.preset("mmwsh", set())


def test_the_sets_are_printed_as_text_and_as_one_document() -> None:
    def shown(*words: str) -> Result:
        return CliRunner().invoke(build({"mesh"}), ["mesh", *words])

    for words in (("--presets", "--json"), ("--json", "--presets")):
        document = json.loads(shown(*words).stdout)
        assert document == {name: {"labels": labels, "of": of} for name, (labels, of) in labelled.PRESETS.items()}
    assert f"totalsegmentator: {labelled.PRESETS['totalsegmentator'][0]}" in shown("--presets").stdout
    said = shown("--json").exception
    assert isinstance(said, UsageError) and "give an INPUT" in str(said)


def block() -> Image:
    """A cube of label 1, 20 mm wide; on its x side two bars of label 7, 6 x 6 mm and 10 mm long; on its z side one of label 5."""
    array = np.zeros((50, 50, 50), dtype=np.uint8)
    array[10:30, 10:30, 10:30] = 1
    array[11:17, 11:17, 30:40] = 7
    array[23:29, 23:29, 30:40] = 7
    array[30:42, 15:21, 15:21] = 5
    return Image(array, np.ones(3), np.zeros(3), np.eye(3))


def test_each_place_where_a_vessel_meets_the_atrium_is_an_opening() -> None:
    found = labelled.candidates(block(), 1, {7: VEIN, 5: "lipv"})
    assert [c.said for c in found] == [VEIN, VEIN, "lipv"]
    # voxels' centres: the bars' first layer is x = 30, y = z = (11 + 16) / 2 and (23 + 28) / 2
    assert found[0].centre == pytest.approx([30.0, 13.5, 13.5]) and found[1].centre == pytest.approx([30.0, 25.5, 25.5])
    assert found[0].direction == pytest.approx([1, 0, 0]) and found[2].direction == pytest.approx([0, 0, 1])
    assert found[0].area_mm2 == pytest.approx(36.0) and found[2].length_mm == pytest.approx(11.0)


def test_specks_of_a_vessel_cost_no_memory() -> None:
    """658 specks in 8 MB of labels: an array of the image's size for each would be 5 GB."""
    array = np.zeros((200, 200, 200), dtype=np.uint8)
    array[:50, :50, :50] = block().array
    array[60::20, 60::20, 60::20] = 7
    array[100:190:18, 3:40:6, 100:190:10] = 7
    tracemalloc.start()
    found = labelled.candidates(Image(array, np.ones(3), np.zeros(3), np.eye(3)), 1, {7: VEIN, 5: "lipv"})
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    alone = labelled.candidates(block(), 1, {7: VEIN, 5: "lipv"})
    for one, other in zip(found, alone, strict=True):
        assert one.said == other.said and np.array_equal(one.centre, other.centre) and one.area_mm2 == other.area_mm2
        assert np.array_equal(one.direction, other.direction) and one.length_mm == other.length_mm
    assert peak < 150e6


def test_the_vessels_become_the_atriums_blood_and_strangers_are_pointed_at() -> None:
    joined = labelled.joined(block(), 1, {7: VEIN, 5: "lipv"})
    assert (joined.array == 1).sum() == 8000 + 2 * 360 + 432 and joined.array.max() == 1
    assert labelled.unnamed(block(), 1, {1, 5}) == [7]
    with pytest.raises(AnatomyError, match=r"label 9 \(lspv\) has no voxel"):
        labelled.joined(block(), 1, {9: "lspv"})
