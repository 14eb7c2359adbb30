"""Products of a run: whatever was changed in them since they were written is noticed."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from lacli.base.errors import StorageError
from lacli.base.files import write_json
from lacli.contracts.identity import run_key
from lacli.contracts.scene import Scene
from lacli.mechanics.store import check_products, find_run, open_run

SceneOf = Callable[..., Scene]

PRODUCTS = {"features.json": b'{"edv_ml": 80.5}', "transients.csv": b"time,volume_ml\n0,80.5\n", "fields/es.vtu": bytes(300_000)}


def stored(scene: Scene, root: Path) -> None:
    with open_run(root, run_key(scene)) as run:
        for name, content in PRODUCTS.items():
            (run.folder / name).parent.mkdir(exist_ok=True)
            (run.folder / name).write_bytes(content)
        run.finish(products=list(PRODUCTS))


@pytest.mark.parametrize("name", sorted(PRODUCTS))
@pytest.mark.parametrize("at", [0, 0.5, 1])
def test_a_product_changed_at_equal_size_is_noticed(
    scene_of: SceneOf, tmp_path: Path, name: str, at: float, caplog: pytest.LogCaptureFixture
) -> None:
    scene, root = scene_of(), tmp_path / "runs"
    stored(scene, root)
    run = find_run(root, run_key(scene))
    assert run is not None
    check_products(run, PRODUCTS)
    content = bytearray(PRODUCTS[name])
    content[int(at * (len(content) - 1))] ^= 1
    (run.folder / name).write_bytes(content)
    with pytest.raises(StorageError, match=f"{name} was changed since it was written"):
        check_products(run, PRODUCTS)
    if name == "fields/es.vtu":  # large: looked at when it is used
        assert find_run(root, run.key) is not None
        return
    assert find_run(root, run.key) is None
    stored(scene, root)
    assert f"{name} was changed since it was written; the run is made again" in caplog.text
    assert (run.folder / name).read_bytes() == PRODUCTS[name]


def test_a_manifest_of_sizes_alone_is_read_as_before(scene_of: SceneOf, tmp_path: Path) -> None:
    scene, root = scene_of(), tmp_path / "runs"
    stored(scene, root)
    file = root / run_key(scene) / "manifest.json"
    manifest = json.loads(file.read_text())
    assert set(manifest.pop("sha256")) == set(PRODUCTS) and manifest.pop("digest")
    write_json(file, manifest)
    run = find_run(root, run_key(scene))
    assert run is not None
    check_products(run, PRODUCTS)
    (run.folder / "features.json").write_text("{}")
    assert find_run(root, run.key) is None


@pytest.mark.parametrize("name", ["status", "kind", "message", "started", "wall_s", "products", "sha256", "versions", "machine"])
def test_a_manifest_that_was_edited_is_no_result(scene_of: SceneOf, tmp_path: Path, name: str) -> None:
    scene, root = scene_of(), tmp_path / "runs"
    stored(scene, root)
    file = root / run_key(scene) / "manifest.json"
    manifest = json.loads(file.read_text())
    old = manifest[name]
    manifest[name] = {**old, "x": 1} if isinstance(old, dict) else f"{old} and more"
    write_json(file, manifest)
    assert find_run(root, run_key(scene)) is None


def test_a_run_of_another_freefem_is_made_again_and_says_so(
    scene_of: SceneOf, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    scene, root = scene_of(), tmp_path / "runs"
    with open_run(root, run_key(scene), solver="4.9") as run:
        (run.folder / "features.json").write_text("{}")
        run.finish("done", products=["features.json"], versions={"freefem": "4.9"})
    for same in ("4.9", None):  # None: no FreeFEM here, what is stored can be looked at all the same
        with open_run(root, run_key(scene), solver=same) as run:
            assert run.stored is not None
    assert not caplog.text
    with open_run(root, run_key(scene), solver="4.15") as run:
        assert run.stored is None
    assert "it was made with FreeFEM 4.9, this is 4.15; the run is made again" in caplog.text
