"""A .zip with one glTF and its files becomes one .glb; everything that archives are abused for is refused."""

import base64
import io
import json
import stat
import struct
import zipfile
from collections.abc import Iterator
from pathlib import Path

import cv2
import httpx
import numpy as np
import pytest

from deltalight.render_server.scene.mesh_loading import load_mesh
from deltalight.services.storage.asset_sandbox import probe
from deltalight.services.storage.assets import Asset
from deltalight.services.storage.faults import RejectedAssetError, TooLargeError
from deltalight.services.storage.store import Store
from tests.services.api_samples import UPLOAD, running_api, sentence

POSITIONS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], "<f4")
UV = np.array([[0, 0], [1, 0], [0, 1], [1, 1]], "<f4")
INDICES = np.array([0, 1, 2, 2, 1, 3], "<u2")
PIECES = (POSITIONS.tobytes(), UV.tobytes(), INDICES.tobytes())
RED_PNG = cv2.imencode(".png", np.full((2, 2, 3), (0, 0, 255), np.uint8))[1].tobytes()


def gltf(buffer_uri: str = "mesh%20data/quad.bin", image_uri: str = "../textures/red.png") -> bytes:
    """A textured square in `model/`, whose buffer and picture lie in other folders."""
    starts = np.cumsum([0, *map(len, PIECES)])
    views = [
        {"buffer": 0, "byteOffset": int(start), "byteLength": len(piece)}
        for start, piece in zip(starts, PIECES, strict=False)
    ]
    kinds = [(5126, "VEC3", 4), (5126, "VEC2", 4), (5123, "SCALAR", 6)]
    accessors = [
        {"bufferView": index, "componentType": kind, "type": shape, "count": count}
        for index, (kind, shape, count) in enumerate(kinds)
    ]
    accessors[0] |= {"min": [0, 0, 0], "max": [1, 1, 0]}
    primitive = {"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "indices": 2, "material": 0}
    document = {
        "asset": {"version": "2.0"},
        "buffers": [{"uri": buffer_uri, "byteLength": sum(map(len, PIECES))}],
        "bufferViews": views,
        "accessors": accessors,
        "images": [{"uri": image_uri}],
        "textures": [{"source": 0}],
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}, "metallicFactor": 0}}],
        "meshes": [{"primitives": [primitive]}],
        "nodes": [{"mesh": 0}],
        "scenes": [{"nodes": [0]}],
        "scene": 0,
    }
    return json.dumps(document).encode()


FILES: dict[str, bytes] = {
    "model/quad.gltf": gltf(),
    "model/mesh data/quad.bin": b"".join(PIECES),
    "textures/red.png": RED_PNG,
    "__MACOSX/model/._quad.gltf": b"litter",
    "readme.txt": b"thanks",
}


def packed(files: dict[str, bytes]) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(zipfile.ZipInfo(name), content, zipfile.ZIP_DEFLATED)
    return buffer.getvalue()


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    with Store(tmp_path / "data", probe=probe) as store:
        yield store


def keep(store: Store, content: bytes, name: str = "quad.zip", limit: int = 1 << 20) -> Asset:
    with store.assets.receiving(limit) as incoming:
        incoming.write(content)
        return store.assets.keep(incoming, name)[0]


def test_a_gltf_with_its_files_is_kept_as_one_glb(store: Store) -> None:
    asset = keep(store, packed(FILES))
    assert (asset.format.name, asset.names) == ("glb", ("quad.glb",))
    assert asset.facts["triangles"] == 2
    (mesh,) = load_mesh(store.assets.path(asset))
    texture = mesh.material.base_color_texture
    assert texture is not None
    assert np.allclose(texture[0, 0], [1, 0, 0], atol=1e-3)
    assert keep(store, packed(FILES), "other.zip").digest == asset.digest, "the same to the bit"
    assert not list((store.folder / "assets" / ".incoming").iterdir())


def test_by_rest_it_comes_back_as_glb_and_a_wrong_one_is_a_sentence(tmp_path: Path) -> None:
    with running_api(tmp_path, probe) as api:

        def sent(content: bytes) -> httpx.Response:
            return api.client.post("/assets?name=quad.zip", content=content, headers=UPLOAD)

        made = sent(packed(FILES))
        assert made.status_code == 201, made.text
        address = made.headers["location"].removeprefix("/api/v1")
        got = api.client.get(f"{address}/content")
        assert got.headers["content-type"] == "model/gltf-binary"
        assert got.content[:4] == b"glTF"
        assert api.client.get(f"{address}/thumbnail.png").content[:4] == b"\x89PNG"
        assert "pack it too" in sentence(sent(packed({"quad.gltf": gltf()})), 422)
        assert len(api.client.get("/assets").json()) == 1


def test_data_within_the_gltf_is_taken_too(store: Store) -> None:
    def uri(kind: str, content: bytes) -> str:
        return f"data:{kind};base64,{base64.b64encode(content).decode()}"

    alone = gltf(uri("application/octet-stream", b"".join(PIECES)), uri("image/png", RED_PNG))
    assert keep(store, packed({"quad.gltf": alone})).digest == keep(store, packed(FILES)).digest


def test_a_glb_in_a_zip_is_that_glb(store: Store) -> None:
    glb = store.assets.path(keep(store, packed(FILES))).read_bytes()
    assert store.assets.path(keep(store, packed({"a/quad.glb": glb}))).read_bytes() == glb


def with_attributes(name: str, attributes: int = 0, flags: int = 0) -> bytes:
    """An archive with one file more, which is a link or encrypted."""
    content = packed({**FILES, name: b"/etc/passwd"})
    place = content.rindex(b"PK\x01\x02")  # the directory's entry of the last file
    entry = bytearray(content[place:])
    struct.pack_into("<H", entry, 8, flags)
    struct.pack_into("<I", entry, 38, attributes)
    return content[:place] + bytes(entry)


LINK = with_attributes("link", (stat.S_IFLNK | 0o777) << 16)
LOCKED = with_attributes("secret", flags=1)


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (packed({**FILES, "../escape.bin": b""}), "outside its own folder"),
        (packed({**FILES, "/etc/x": b""}), "outside its own folder"),
        (packed({**FILES, "C:/x": b""}), "outside its own folder"),
        (packed({**FILES, "a\\..\\x": b""}), "outside its own folder"),
        (packed({**FILES, "two.gltf": gltf()}), "two or more glTF files"),
        (packed({"readme.txt": b"x"}), "no glTF file"),
        (packed({"quad.gltf": gltf()}), "which its glTF names; pack it too"),
        (packed({"quad.gltf": gltf("../../../etc/passwd")}), "does not hold"),
        (packed({"quad.gltf": gltf("file:///etc/passwd")}), "does not hold"),
        (packed({"quad.gltf": b"{"}), "no valid glTF 2 file"),
        (packed({"quad.gltf": b"[]"}), "no valid glTF 2 file"),
        (packed({f"{number}.bin": b"" for number in range(1001)}), "more than 1000 files"),
        (LINK, "holds the link"),
        (LOCKED, "encrypted"),
        (packed(FILES)[:-30], "damaged"),
        (b"PK\x03\x04" + bytes(100), "damaged"),
    ],
)
def test_what_archives_are_abused_for_is_refused(store: Store, content: bytes, expected: str) -> None:
    with pytest.raises(RejectedAssetError, match=expected) as refused:
        keep(store, content)
    assert "quad.zip" in str(refused.value)
    assert str(store.folder) not in str(refused.value)
    assert not store.assets.all()
    assert not list((store.folder / "assets" / ".incoming").iterdir())


def test_a_bomb_goes_off_nowhere(store: Store) -> None:
    zeros = bytes(64 << 20)
    with pytest.raises(RejectedAssetError, match="more than 1 MB unpacked"):
        keep(store, packed({**FILES, "big.bin": zeros}))
    # One that lies about its size: what comes out beyond that is not read, and its checksum is wrong.
    content = packed({"quad.gltf": gltf(), "mesh data/quad.bin": zeros, "textures/red.png": RED_PNG})
    lied = content.replace(struct.pack("<I", len(zeros)), struct.pack("<I", 100))
    assert lied != content
    with pytest.raises(RejectedAssetError, match="damaged"):
        keep(store, lied)


def test_what_is_too_large_as_glb_is_refused(store: Store) -> None:
    inflated = json.dumps({**json.loads(gltf()), "extras": "x" * 4000}).encode()
    archive = packed({**FILES, "model/quad.gltf": inflated})
    with pytest.raises((TooLargeError, RejectedAssetError)):
        keep(store, archive, limit=len(archive) + 100)
