"""The shelf: objects that every service has, as files and over REST."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from deltalight.render_server.scene.mesh_loading import load_mesh
from deltalight.render_server.scene.triangle_mesh import TriangleMesh
from deltalight.services.storage.asset_sandbox import probe
from deltalight.services.storage.shelf import SHELF, ShelfItem
from deltalight.services.storage.shelf_helmet import LAMP_RADIANCE
from deltalight.services.storage.shelf_lantern import GLASS, GLOW_LINEAR, GLOW_RADIANCE
from tests.services.api_samples import running_api, sentence

LARGEST_M = 0.2
HALF_BYTE = 0.5 / 255  # materials of files are bytes
SHAPES = [item for item in SHELF.values() if isinstance(item, ShelfItem)]
MOST_BYTES = 1_000_000


def test_the_six_of_the_first_minute_are_there() -> None:
    wanted = {"chrome-ball", "matte-cube", "glazed-vase", "walking-figure", "glowing-lantern", "helmet"}
    assert wanted < set(SHELF)
    assert len(SHAPES) == 8


@pytest.mark.parametrize("item", SHAPES, ids=lambda item: item.name)
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


def meshes_of(name: str, folder: Path) -> list[TriangleMesh]:
    """The meshes of an object of the shelf, once its file is small, the same each time, and of a sensible size."""
    content = SHELF[name].glb()
    assert len(content) < MOST_BYTES
    assert content == SHELF[name].glb(), "the same asset each time"
    path = folder / SHELF[name].file_name
    path.write_bytes(content)
    meshes = load_mesh(path)
    low = np.min([mesh.bounds()[0] for mesh in meshes], axis=0)
    high = np.max([mesh.bounds()[1] for mesh in meshes], axis=0)
    assert 0.1 < max(high - low) < LARGEST_M
    assert low[1] == pytest.approx(0, abs=0.002), "it stands on the ground"
    return meshes


def test_the_lantern_glows(tmp_path: Path) -> None:
    meshes = {mesh.material.name: mesh for mesh in meshes_of("glowing-lantern", tmp_path)}
    glass = meshes.pop(GLASS)
    np.testing.assert_allclose(glass.material.emission, np.multiply(GLOW_LINEAR, GLOW_RADIANCE), rtol=1e-5)
    (frame,) = meshes.values()
    assert not frame.material.emission.any()
    (low, high), (glass_low, glass_high) = frame.bounds(), glass.bounds()
    assert (glass_low >= low).all()
    assert (glass_high <= high).all()


def test_the_helmet_has_its_detail_in_its_textures(tmp_path: Path) -> None:
    (mesh,) = meshes_of("helmet", tmp_path)
    material = mesh.material
    assert None not in (
        material.base_color_map,
        material.metallic_roughness_map,
        material.normal_map,
        material.emissive_map,
    )
    np.testing.assert_allclose(material.emission, LAMP_RADIANCE)
    front = mesh.positions[:, 2].argmax()
    assert mesh.normals[front, 2] > 0.95, "its faces look outward"
    middle = mesh.bounds()[0] / 2 + mesh.bounds()[1] / 2
    outward = np.einsum("ij,ij->i", mesh.normals, mesh.positions - middle)
    assert (outward > 0).mean() > 0.95


def test_the_figure_walks(tmp_path: Path) -> None:
    meshes_of("walking-figure", tmp_path)
    clips = [each["name"] for each in probe(tmp_path / "Walking figure.glb", "mesh", "a.glb")["clips"]]
    assert SHELF["walking-figure"].clip in clips


def test_an_object_is_taken_from_the_shelf(tmp_path: Path) -> None:
    with running_api(tmp_path, probe) as api:
        shelf = api.client.get("/shelf").json()
        assert [each["name"] for each in shelf] == list(SHELF)
        assert [each["clip"] for each in shelf] == [each.clip for each in SHELF.values()]
        first, again = (api.client.post("/shelf/chrome-ball") for _ in range(2))
        assert (first.status_code, again.status_code) == (201, 200)
        assert first.json() == again.json()
        assert first.json()["names"] == ["Chrome ball.glb"]
        assert first.json()["facts"]["material"]["metallic"] == 1.0
        assert [each["asset"] for each in api.client.get("/assets").json()] == [first.json()["asset"]]
        assert "grey-ball" in sentence(api.client.post("/shelf/teapot"), 404)
