"""The shelf: objects that the service makes, as files and over REST."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from deltalight.render_server.scene.mesh_loading import load_mesh
from deltalight.services.storage.asset_sandbox import probe
from deltalight.services.storage.shelf import SHELF, ShelfItem
from tests.services.api_samples import running_api, sentence

LARGEST_M = 0.2
HALF_BYTE = 0.5 / 255  # materials of files are bytes


@pytest.mark.parametrize("item", SHELF.values(), ids=lambda item: item.name)
def test_each_is_a_closed_shape_of_its_material(item: ShelfItem, tmp_path: Path) -> None:
    shape = item.shape()
    assert isinstance(shape, trimesh.Trimesh)
    assert shape.is_watertight
    assert shape.volume > 0, "its faces look outward"
    path = tmp_path / item.file_name
    path.write_bytes(item.glb())
    (mesh,) = load_mesh(path)
    low, high = mesh.bounds()
    height, *floor = (high - low)[[1, 0, 2]]
    assert max(height, *floor) < LARGEST_M
    np.testing.assert_allclose([*floor, height], shape.extents, atol=1e-6)
    assert np.abs(mesh.material.base_color - item.base_color).max() <= HALF_BYTE + 1e-6
    assert mesh.material.metallic == item.metallic
    assert mesh.material.roughness == pytest.approx(item.roughness)
    assert item.glb() == item.glb(), "the same asset each time"


def test_an_object_is_taken_from_the_shelf(tmp_path: Path) -> None:
    with running_api(tmp_path, probe=probe) as api:
        shelf = api.client.get("/shelf").json()
        assert [each["name"] for each in shelf] == list(SHELF)
        first, again = (api.client.post("/shelf/chrome-ball") for _ in range(2))
        assert (first.status_code, again.status_code) == (201, 200)
        assert first.json() == again.json()
        assert first.json()["names"] == ["Chrome ball.glb"]
        assert first.json()["facts"]["material"]["metallic"] == 1.0
        assert [each["asset"] for each in api.client.get("/assets").json()] == [first.json()["asset"]]
        assert "grey-ball" in sentence(api.client.post("/shelf/teapot"), 404)
