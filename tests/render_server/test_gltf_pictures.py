"""Pictures in glTF files that lie or are damaged, extensions, and what is said of what is left out."""

import io
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from deltalight.benchmarks.gltf_plate import Plate, even
from deltalight.protocol.errors import DeltalightError
from deltalight.render_server.scene import texture_maps
from deltalight.render_server.scene.mesh_loading import load_asset
from deltalight.render_server.scene.texture_maps import TextureMap, map_edge
from deltalight.services.storage.asset_facts import mesh_facts
from tests.render_server.gltf_samples import edited

SLOTS: dict[str, Callable[[dict[str, Any], dict[str, Any]], Any]] = {
    "base colour": lambda m, info: m.update(pbrMetallicRoughness={"baseColorTexture": info}),
    "roughness": lambda m, info: m.update(pbrMetallicRoughness={"metallicRoughnessTexture": info}),
    "normal": lambda m, info: m.update(normalTexture=info),
    "occlusion": lambda m, info: m.update(occlusionTexture=info),
    "emission": lambda m, info: m.update(emissiveTexture=info),
}


def png_header(width: int, height: int) -> bytes:
    """A PNG of that size, says its header; it holds one row."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    rows = zlib.compress(bytes(1 + 3 * 16))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


def jpeg() -> bytes:
    data = io.BytesIO()
    Image.fromarray(np.random.default_rng(0).integers(0, 255, (64, 64, 3), np.uint8)).save(data, "JPEG")
    return data.getvalue()


LIES = [
    ("bomb", png_header(60_000, 60_000), "image/png", r"image 0 cannot be read|pixels is too large"),
    ("large", png_header(9000, 9000), "image/png", "9000x9000 pixels is too large"),
    ("size", png_header(500, 400), "image/png", "cannot be decoded"),
    ("truncated", jpeg()[:900], "image/jpeg", "cannot be decoded"),
    ("kind", jpeg(), "image/png", "is called image/png and holds JPEG"),
    ("none", b"no picture at all", "image/png", "image 0 cannot be read"),
]


@pytest.mark.parametrize("slot", SLOTS)
@pytest.mark.parametrize(
    ("data", "mime", "sentence"), [lie[1:] for lie in LIES], ids=[lie[0] for lie in LIES]
)
def test_a_picture_that_lies_is_refused_in_a_sentence(
    tmp_path: Path, slot: str, data: bytes, mime: str, sentence: str
) -> None:
    plate = Plate(1, 1)
    SLOTS[slot](plate.material, plate.encoded(data, mime=mime))
    with pytest.raises(DeltalightError, match=sentence) as caught:
        load_asset(plate.write(tmp_path / "plate.glb"))
    assert "plate.glb" in str(caught.value)
    assert "\n" not in str(caught.value)


def textured(**info: Any) -> Plate:  # noqa: ANN401
    plate = Plate(1, 1)
    plate.material["emissiveTexture"] = plate.texture(even(255, 255, 255), {"wrapS": 10497}, **info)
    return plate


FAULTS: list[tuple[Callable[[dict[str, Any]], Any], str]] = [
    (lambda d: d["textures"][0].update(source=3), "not a valid glTF 2 file"),
    (lambda d: d["textures"][0].update(sampler=3), "not a valid glTF 2 file"),
    (lambda d: d["samplers"][0].update(wrapS=5), "not a valid glTF 2 file"),
    (lambda d: d["images"][0].update(bufferView=99), "not a valid glTF 2 file"),
    (lambda d: d["materials"][0].update(alphaMode="HALF"), "not a valid glTF 2 file"),
    (lambda d: d["bufferViews"][-2].update(byteLength=10**6), "reaches beyond its buffer"),
    (lambda d: d["materials"][0]["emissiveTexture"].update(texCoord=2), "texture coordinates 2"),
    (lambda d: d["materials"][0].update(emissiveFactor=[-1, 0, 0]), "below 0"),
    (lambda d: d.update(extensionsRequired=["KHR_texture_basisu"]), "KHR_texture_basisu that it requires"),
    (lambda d: d.update(extensionsRequired=["KHR_materials_fur"]), "KHR_materials_fur that it requires"),
]


@pytest.mark.parametrize(("edit", "sentence"), FAULTS)
def test_textures_that_are_described_wrongly_are_refused_in_a_sentence(
    tmp_path: Path, edit: Callable[[dict[str, Any]], Any], sentence: str
) -> None:
    path = edited(textured().write(tmp_path / "plate.glb"), edit)
    with pytest.raises(DeltalightError, match=sentence):
        load_asset(path)


def test_the_pixels_of_a_file_are_limited(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(texture_maps, "MAX_FILE_PIXELS", 31)
    plate = textured()
    load_asset(plate.write(tmp_path / "one.glb"))
    plate = textured()
    plate.material["normalTexture"] = plate.texture(even(128, 128, 255))
    with pytest.raises(DeltalightError, match="million pixels"):
        load_asset(plate.write(tmp_path / "two.glb"))


def test_large_pictures_are_reduced_in_linear_light(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whole pixels first, then areas; a few rows at a time, and all of them."""
    monkeypatch.setattr(texture_maps, "MAX_TEXTURE_EDGE", 16)
    monkeypatch.setattr(texture_maps, "_DECODED_ROWS", 200)
    plate = Plate(1, 1)
    codes = (np.indices((40, 72)).sum(axis=0) % 2 * 255)[..., None].repeat(3, axis=2)
    plate.material["emissiveTexture"] = plate.texture(codes)
    plate.material["normalTexture"] = plate.texture(codes)
    (mesh,) = load_asset(plate.write(tmp_path / "plate.glb")).meshes
    glow, normal = mesh.material.emissive_map, mesh.material.normal_map
    assert glow is not None
    assert normal is not None
    assert glow.texels.shape == normal.texels.shape == (9, 16, 3)
    assert glow.texels.astype(float) == pytest.approx(np.full((9, 16, 3), 0.5), abs=2e-3)
    assert np.abs(normal.texels.astype(int) - 127.5).max() <= 1


def test_many_textures_lose_resolution_rather_than_memory() -> None:
    def maps(count: int, edge: int) -> list[TextureMap]:
        return [TextureMap(np.broadcast_to(np.float16(0), (edge, edge, 3)))] * count

    assert map_edge(maps(1, 300), 8) == 512
    assert map_edge(maps(60, 1024), 8) == 1024
    assert map_edge(maps(100, 1024), 8) == 512
    assert map_edge([], 8) == 1


def test_what_is_left_out_is_named_once(tmp_path: Path) -> None:
    plate = textured()
    plate.glb.document["extensionsUsed"] = ["KHR_materials_ior", "KHR_materials_iridescence", "ACME_fur"]
    plate.glb.document["extensionsRequired"] = ["KHR_materials_iridescence"]
    path = plate.write(tmp_path / "plate.glb")
    assert load_asset(path).left_out == f"{path} is shown without KHR_materials_iridescence, ACME_fur."
    assert load_asset(textured().write(tmp_path / "other.glb")).left_out is None


def test_facts_of_an_asset_hold_the_means_of_its_textures(tmp_path: Path) -> None:
    """Overriding a material begins with them: a lamp on a box must not make all of the box glow."""
    plate = Plate(1, 1)
    lamp = even(0, 0, 0, size=8)
    lamp[:2, :4] = 255
    plate.material |= {
        "emissiveTexture": plate.texture(lamp),
        "emissiveFactor": [1, 0.5, 0],
        "pbrMetallicRoughness": {"metallicRoughnessTexture": plate.texture(even(0, 51, 102))},
    }
    facts = mesh_facts(plate.write(tmp_path / "plate.glb"))["material"]
    assert facts["emission"] == pytest.approx([0.125, 0.0625, 0])
    assert (facts["roughness"], facts["metallic"]) == (0.2, 0.4)


@pytest.mark.filterwarnings("error")
def test_a_palette_with_transparency_is_read_without_a_warning(tmp_path: Path) -> None:
    """Khronos' CesiumLogoFlat.png has one; an opaque material shows its colours, transparent or not."""
    picture = Image.new("P", (2, 1))
    picture.putpalette([255, 0, 0, 0, 0, 255])
    picture.putdata([0, 1])
    data = io.BytesIO()
    picture.save(data, "PNG", transparency=bytes([0, 128]))
    plate = Plate(1, 1)
    plate.material["pbrMetallicRoughness"] = {"baseColorTexture": plate.encoded(data.getvalue())}
    (mesh,) = load_asset(plate.write(tmp_path / "plate.glb")).meshes
    shown = mesh.material.base_color_map
    assert shown is not None
    assert shown.texels[0, :, :3].tolist() == [[1, 0, 0], [0, 0, 1]]
