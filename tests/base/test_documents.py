"""Documents within bounds: whatever stands in a file, one message within two seconds."""

from __future__ import annotations

import json
import time
import tomllib
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lacli.base import documents
from lacli.base.errors import InputError, SceneError

READERS = {".toml": documents.read_toml, ".json": documents.read_json}
HOSTILE: dict[str, tuple[bytes, bytes]] = {  # TOML, JSON
    "deep brackets": (b"a = " + b"[" * 100_000, b"[" * 100_000),
    "deep brackets, closed": (b"a = " + b"[" * 400 + b"]" * 400, b"[" * 400 + b"]" * 400),
    "deep tables": (b"a = " + b"{a=" * 20_000 + b"1" + b"}" * 20_000, b'{"a":' * 20_000 + b"1" + b"}" * 20_000),
    "dotted key": (b".".join([b"a"] * 5000) + b" = 1", b'{"a":' * 900 + b"1" + b"}" * 900),
    "dotted key of 50": (b".".join([b"a"] * 50) + b" = 1", b'{"a":' * 50 + b"1" + b"}" * 50),
    "dotted header": (b"[" + b" . ".join([b'"a"'] * 60_000) + b"]", b"{" * 60_000),
    "digits": (b"a = " + b"9" * 5000, b'{"a": ' + b"9" * 5000 + b"}"),
    "400 digits": (b"a = " + b"9" * 400, b'{"a": [1, ' + b"9" * 400 + b"]}"),
    "minus 400 digits": (b"[b]\na = -" + b"9" * 400, b'{"b": {"a": -' + b"9" * 400 + b"}}"),
    "many keys": (
        b"\n".join(b"k%d = 1" % i for i in range(1_500_000)),
        b"{" + b",".join(b'"%d":1' % i for i in range(700_000)) + b"}",
    ),
    "many values below the size": (b"a = [" + b"1," * 250_000 + b"]", b"[" + b"1," * 300_000 + b"1]"),
    "many dotted keys": (b"\n".join(b"a." * 40 + b"k%d = 1" % i for i in range(4_500)), b"[" + b"[1]," * 200_000 + b"1]"),
    "too large": (b"# " + b"x" * (40 << 20), b" " * (40 << 20)),
    "one long word": (b"x" * (500 << 10), b"x" * (7 << 20)),
    "open string": (b'a = "' + b"x." * (200 << 10), b'{"a": "' + b"x." * (4 << 20)),
    "latin-1": ("name = 'M\xfcller'".encode("latin-1"), '{"n": "M\xfcller"}'.encode("latin-1")),
    "utf-16": ("a = 1".encode("utf-16"), '{"a": 1}'.encode("utf-16")),
    "NUL": (b"a = 1\0", b'{"a": 1}\0'),
    "binary": (bytes(range(256)) * 100, bytes(range(256)) * 100),
    "cut short": (b"[a", b'{"a": '),
    "duplicate": (b"a = 1\na = 2", b"{,}"),
}


@pytest.mark.parametrize("name", HOSTILE)
@pytest.mark.parametrize("suffix", READERS)
def test_hostile_documents_end_in_one_message_at_once(tmp_path: Path, name: str, suffix: str) -> None:
    file = tmp_path / f"x{suffix}"
    file.write_bytes(HOSTILE[name][suffix == ".json"])
    start = time.process_time()
    with pytest.raises(SceneError) as caught:
        READERS[suffix](file, error=SceneError)
    assert time.process_time() - start < 2.0
    words = str(caught.value)
    assert words.startswith(f"{file}: ") and words.count("\n") == 0 and len(words) < 400


@pytest.mark.parametrize("suffix", READERS)
def test_what_is_no_file(tmp_path: Path, suffix: str) -> None:
    for path in (tmp_path / f"none{suffix}", tmp_path, Path(f"a\0{suffix}"), tmp_path / ("n" * 300 + suffix)):
        with pytest.raises(InputError):
            READERS[suffix](path)


def test_a_byte_order_mark_is_taken_off(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_bytes(b"\xef\xbb\xbfa = 1\n")
    (tmp_path / "a.json").write_bytes(b'\xef\xbb\xbf{"a": 1}')
    assert documents.read_toml(tmp_path / "a.toml") == {"a": 1} == documents.read_json(tmp_path / "a.json")


@pytest.mark.parametrize(("given_", "allowed"), [(2**63 - 1, True), (-(2**63), True), (2**63, False), (-(2**63) - 1, False)])
def test_whole_numbers_have_64_bits(tmp_path: Path, given_: int, allowed: bool) -> None:
    (tmp_path / "a.toml").write_text(f"[b]\na = {given_}\n")
    if allowed:
        assert documents.read_toml(tmp_path / "a.toml") == {"b": {"a": given_}}
        return
    with pytest.raises(InputError, match=r"b\.a: a whole number"):
        documents.read_toml(tmp_path / "a.toml")


@pytest.mark.parametrize(("depth", "allowed"), [(documents.MOST_DEPTH, True), (documents.MOST_DEPTH + 1, False)])
def test_the_depth_allowed(tmp_path: Path, depth: int, allowed: bool) -> None:
    (tmp_path / "a.json").write_text("[" * depth + "]" * depth)
    if allowed:
        documents.read_json(tmp_path / "a.json")
        return
    with pytest.raises(InputError, match="nested"):
        documents.read_json(tmp_path / "a.json")


@given(st.binary(max_size=200))
def test_any_bytes_are_read_as_the_libraries_do_or_refused(tmp_path_factory: pytest.TempPathFactory, content: bytes) -> None:
    folder = tmp_path_factory.mktemp("bytes")
    for suffix, reader in READERS.items():
        (folder / f"x{suffix}").write_bytes(content)
        library: Any = tomllib.loads if suffix == ".toml" else json.loads
        try:
            found = reader(folder / f"x{suffix}")
        except InputError:
            continue
        assert repr(found) == repr(library(content.decode("utf-8-sig")))


@given(
    st.dictionaries(
        st.text(st.characters(categories=["Ll"]), min_size=1), st.integers(-(2**63), 2**63 - 1) | st.floats() | st.text()
    )
)
def test_what_is_written_is_read(tmp_path_factory: pytest.TempPathFactory, table: dict[str, Any]) -> None:
    file = tmp_path_factory.mktemp("json") / "x.json"
    file.write_text(json.dumps(table), encoding="utf-8")
    assert repr(documents.read_json(file)) == repr(json.loads(json.dumps(table)))


@pytest.mark.parametrize("value", ["x" * 10_000, [1] * 10_000, 10**5000, 10**400, {"a": 10**5000}, None, 1.5], ids=range(7))
def test_values_in_messages_are_short(value: Any) -> None:
    assert len(documents.brief(value)) < 120
