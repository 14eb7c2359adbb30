"""A synthesized folder that was changed since is told by name."""

from __future__ import annotations

from pathlib import Path

import pytest

from lacli.base.errors import AnatomyError
from lacli.synthetic.kept import FILES, check, digests


def test_every_file_but_the_description_is_held_to_its_content(tmp_path: Path) -> None:
    (tmp_path / "sub").mkdir()
    for name in ("a.txt", "sub/b.txt", "c.txt", "d.txt", "about.json"):
        (tmp_path / name).write_text(name)
    info = {FILES: digests(tmp_path, "about.json")}
    assert sorted(info[FILES]) == ["a.txt", "c.txt", "d.txt", "sub/b.txt"]
    check(tmp_path, info)
    (tmp_path / "new.txt").write_text("of the user's")
    check(tmp_path, info)
    (tmp_path / "sub" / "b.txt").write_text("other")
    with pytest.raises(AnatomyError, match=r"sub/b\.txt changed since"):
        check(tmp_path, info)
    for name in ("a.txt", "c.txt", "d.txt"):
        (tmp_path / name).unlink()
    with pytest.raises(AnatomyError, match=r"a\.txt, c\.txt, d\.txt and 1 more changed"):
        check(tmp_path, info)
    with pytest.raises(AnatomyError, match="its description is damaged"):
        check(tmp_path, {FILES: ["a.txt"]})
    check(tmp_path, {})
