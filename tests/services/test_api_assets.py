"""Uploads over REST: every format through the real check in a child process, and what is refused."""

import gzip
import hashlib
import socket
import struct
from collections.abc import Iterator
from pathlib import Path

import cv2
import httpx
import numpy as np
import pytest

from deltalight.protocol.radiance_files import write_exr
from deltalight.protocol.scene_objects import PrecomputedMaterial
from deltalight.render_server.scene.gaussian_brdf import RISE_TERMS, GaussianBrdf
from deltalight.render_server.scene.material_file import write_material
from deltalight.render_server.scene.polynomial_texture import TERMS, PolynomialTexture
from deltalight.render_server.scene.texture_stack import LAYERS, TextureStack
from deltalight.services.storage.asset_sandbox import probe
from deltalight.services.storage.faults import RejectedAssetError
from tests.services.api_samples import UPLOAD, RunningApi, running_api, sentence
from tests.services.conftest import ROOT
from tests.services.storage_samples import TETRAHEDRON, glb, lying_glb
from tests.services.test_api_scenes import wait_for

PLY = b"""ply
format ascii 1.0
element vertex 3
property float x
property float y
property float z
element face 1
property list uchar int vertex_indices
end_header
0 0 0
1 0 0
0 1 0
3 0 1 2
"""
STL_TEXT = b"""solid shape
facet normal 0 0 1
outer loop
vertex 0 0 0
vertex 1 0 0
vertex 0 1 0
endloop
endfacet
endsolid shape
"""
STL_BINARY = b"\0" * 80 + struct.pack("<I", 1) + struct.pack("<12fH", 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0)


def glb_naming(uri: str) -> bytes:
    return glb({"asset": {"version": "2.0"}, "buffers": [{"uri": uri, "byteLength": 9}]})


@pytest.fixture(scope="module")
def api(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningApi]:
    with running_api(tmp_path_factory.mktemp("data"), probe, upload_limit_mb=2) as running:
        yield running


def upload(client: httpx.Client, content: bytes, name: str) -> httpx.Response:
    return client.post("/assets", params={"name": name}, content=content, headers=UPLOAD)


def hdr(width: int, height: int) -> bytes:
    picture = np.random.default_rng(1).uniform(0, 4, (height, width, 3)).astype(np.float32)
    return cv2.imencode(".hdr", picture)[1].tobytes()


def exr(folder: Path) -> bytes:
    write_exr(folder / "map.exr", np.ones((8, 16, 3), np.float32))
    return (folder / "map.exr").read_bytes()


@pytest.mark.slow
def test_meshes_are_taken_and_described(api: RunningApi) -> None:
    before = api.client.get("/assets").json()
    glb_file = (ROOT / "services" / "demo_assets" / "object.glb").read_bytes()
    answer = upload(api.client, glb_file, "knot.glb")
    assert answer.status_code == 201, answer.text
    found = answer.json()
    assert (found["kind"], found["format"], found["names"]) == ("mesh", "glb", ["knot.glb"])
    assert found["facts"]["triangles"] > 100
    assert found["size_bytes"] == len(glb_file)
    for content, name in ((TETRAHEDRON, "a.obj"), (PLY, "a.ply"), (STL_BINARY, "a.stl"), (STL_TEXT, "a")):
        answer = upload(api.client, content, name)
        assert answer.status_code == 201, answer.text
        assert answer.json()["facts"]["maximum"][:2] == [1.0, 1.0]
    listed = api.client.get("/assets").json()
    assert [each["format"] for each in listed[:5]] == ["stl", "stl", "ply", "obj", "glb"]
    assert listed[5:] == before


def test_maps_are_taken_and_must_be_twice_as_wide_as_high(api: RunningApi, tmp_path: Path) -> None:
    for content, name in ((hdr(32, 16), "room.hdr"), (exr(tmp_path), "room.exr")):
        answer = upload(api.client, content, name)
        assert answer.status_code == 201, answer.text
        assert (answer.json()["kind"], answer.json()["facts"]["width"] > 8) == ("map", True)
    assert "twice as wide as it is high" in sentence(upload(api.client, hdr(20, 16), "room.hdr"), 422)
    scene = api.client.post(
        "/scenes", json={"lights": {"mode": "environment", "environment": {"map": "room.hdr"}}}
    )
    assert scene.status_code == 201


def paint(folder: Path) -> bytes:
    """A measured paint: a red base under one white lobe."""
    made = GaussianBrdf(np.array([0.4, 0.1, 0.1]), np.array([0.2]), np.full((1, RISE_TERMS, 3), 0.05))
    write_material(folder / "paint.dlmat", made)
    return (folder / "paint.dlmat").read_bytes()


def sealed(arrays: bytes) -> bytes:
    """A material's file of any content, with its right hash."""
    return b"deltalight material 1 " + hashlib.sha256(arrays).hexdigest().encode() + b"\n" + arrays


def test_precomputed_materials_are_taken_and_used_by_scenes(api: RunningApi, tmp_path: Path) -> None:
    answer = upload(api.client, paint(tmp_path), "paint.dlmat")
    assert answer.status_code == 201, answer.text
    found = answer.json()
    assert (found["kind"], found["format"], found["facts"]["model"]) == ("material", "dlmat", "measured_brdf")
    assert found["facts"]["base_color"][0] > 0.4  # the base, and what the lobe reflects
    assert upload(api.client, paint(tmp_path), "paint.dlmat").status_code == 200
    mesh = upload(api.client, TETRAHEDRON + b"# painted\n", "painted.obj").json()["asset"]
    item = {"id": "ball", "asset": mesh, "material": {"precomputed": "paint.dlmat"}}
    scene = api.client.post("/scenes", json={"objects": [item]}).json()
    assert scene["document"]["objects"][0]["material"] == {"precomputed": found["asset"]}
    local = api.store.assets.localised(api.store.scenes.get(scene["id"]).document).objects[0].material
    assert isinstance(local, PrecomputedMaterial)
    assert Path(local.precomputed).read_bytes() == paint(tmp_path)
    assert f"used by scene {scene['id']}" in sentence(api.client.delete(f"/assets/{found['asset']}"), 409)
    for place, wrong in (
        ({"asset": found["asset"]}, "needs a mesh"),
        ({"material": {"precomputed": mesh}}, "needs a material"),
    ):
        refused = api.client.patch(f"/scenes/{scene['id']}/objects/ball", json=place)
        assert wrong in sentence(refused, 422)


def test_a_polynomial_texture_map_is_taken(api: RunningApi, tmp_path: Path) -> None:
    texels = np.zeros((TERMS, 4, 6, 3), np.float16)
    texels[0] = 0.5
    write_material(tmp_path / "coin.dlmat", PolynomialTexture(texels))
    found = upload(api.client, (tmp_path / "coin.dlmat").read_bytes(), "coin.dlmat").json()
    assert (found["facts"]["model"], found["facts"]["width"], found["facts"]["height"]) == (
        "polynomial_texture",
        6,
        4,
    )


def test_a_texture_stack_is_taken_and_a_false_one_refused(api: RunningApi, tmp_path: Path) -> None:
    path = tmp_path / "studs.dlmat"
    write_material(path, TextureStack(np.full((LAYERS, 4, 6, 3), 0.5, np.float16), 0.04, 0.5))
    found = upload(api.client, path.read_bytes(), "studs.dlmat").json()
    facts = found["facts"]
    assert (facts["model"], facts["width"], facts["height"]) == ("texture_stack", 6, 4)
    assert facts["base_color"] == pytest.approx([1, 1, 1])
    write_material(path, TextureStack(np.full((LAYERS, 4, 6, 3), 1e4, np.float16)))
    refused = upload(api.client, path.read_bytes(), "studs.dlmat")
    assert "holds no material that can be drawn" in sentence(refused, 422)


def test_the_same_file_again_is_200_and_comes_back_byte_for_byte(api: RunningApi) -> None:
    content = TETRAHEDRON + b"# again\n"
    first, second = (upload(api.client, content, name) for name in ("one.obj", "../../two.obj"))
    assert (first.status_code, second.status_code) == (201, 200)
    assert second.json()["names"] == ["one.obj", "two.obj"]
    address = second.headers["location"].removeprefix("/api/v1")
    download = api.client.get(f"{address}/content")
    assert download.content == content
    assert download.headers["x-content-type-options"] == "nosniff"
    assert api.client.get(address).json()["names"] == ["one.obj", "two.obj"]


def test_an_asset_in_use_is_not_deleted(api: RunningApi) -> None:
    reference = upload(api.client, TETRAHEDRON + b"# used\n", "used.obj").json()["asset"]
    scene = api.client.post("/scenes", json={"objects": [{"asset": reference}]}).json()
    assert f"used by scene {scene['id']}" in sentence(api.client.delete(f"/assets/{reference}"), 409)
    api.client.delete(f"/scenes/{scene['id']}").raise_for_status()
    assert api.client.delete(f"/assets/{reference}").status_code == 204
    assert "no asset" in sentence(api.client.get(f"/assets/{reference}"), 404)
    assert "no asset" in sentence(api.client.get(f"/assets/{reference}/content"), 404)


@pytest.mark.parametrize(
    ("content", "name", "expected"),
    [
        (lying_glb(), "bomb.glb", "wants 2400000000 bytes where 36 are"),
        (
            glb_naming("../../store.sqlite3"),
            "a.glb",
            "outside its own folder",
        ),
        (
            glb_naming("other.bin"),
            "a.glb",
            "missing",
        ),
        (glb({"asset": {"version": "2.0"}})[:-3], "cut.glb", "cut.glb"),
        (b'{"asset": {"version": "2.0"}}', "chair.gltf", "pack them in a .zip"),
        (gzip.compress(bytes(1 << 20)), "chair.glb", "not in a known format"),
        (b"MZ" + bytes(100), "chair.glb", "not in a known format"),
        (PLY.replace(b"vertex 3", b"vertex 900000000"), "bomb.ply", "announces more elements"),
        (PLY, "chair.glb", "is a PLY file and not GLB"),
        (b"v 0 0 0\nf 1 2 3\n", "gap.obj", "gap.obj"),
        (b"v 0 0 1e30\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "far.obj", "beyond 10 km"),
        (b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 30000 +X 60000\n" + bytes(100), "bomb.hdr", "bomb.hdr"),
        (b"deltalight material 1 0000\nPK", "paint.dlmat", "paint.dlmat is damaged or cut short"),
        (b"deltalight material 9 0000\nPK", "paint.dlmat", "version 9, and this release reads version 1"),
        (b"deltalight material \xff\xfe\n", "paint.dlmat", "paint.dlmat is not a precomputed material"),
        (sealed(b"PK\x03\x04"), "paint.dlmat", "holds no material that can be drawn"),
        (b"deltalight material 1 0\n", "chair.glb", "is a DLMAT file and not GLB"),
        (b"", "empty.glb", "not in a known format"),
        (TETRAHEDRON, "/", "needs the file's own name"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_wrong_files_are_refused_in_a_sentence(
    api: RunningApi, content: bytes, name: str, expected: str
) -> None:
    before = api.client.get("/assets").json()
    text = sentence(upload(api.client, content, name), 422)
    assert expected in text
    assert str(api.store.folder / "assets") not in text  # no path of this machine
    assert api.client.get("/assets").json() == before


def test_uploads_beyond_the_limit_are_cut_off(api: RunningApi) -> None:
    assert "larger than 2 MB" in sentence(upload(api.client, bytes((2 << 20) + 1), "big.glb"), 413)

    def endless() -> Iterator[bytes]:  # sent without a length
        for _ in range(64):
            yield bytes(100_000)

    try:
        answer = api.client.post("/assets?name=big.glb", content=endless(), headers=UPLOAD)
    except httpx.TransportError:  # the answer may be overtaken by the closed connection
        pass
    else:
        assert "larger than 2 MB" in sentence(answer, 413)
    assert api.client.get("/state").json()["refused"]["too-large"] >= 2
    assert left_over(api) == []


def test_an_upload_that_breaks_off_leaves_nothing(api: RunningApi) -> None:
    host, port = api.client.base_url.host, api.client.base_url.port
    assert port is not None
    with socket.create_connection((host, port)) as connection:
        connection.sendall(
            f"POST /api/v1/assets?name=a.glb HTTP/1.1\r\nHost: {host}:{port}\r\nContent-Length: 1000\r\n"
            "Content-Type: application/octet-stream\r\n\r\nglTF".encode()
        )
        wait_for(lambda: left_over(api) != [])
    wait_for(lambda: left_over(api) == [])
    assert "internal" not in api.client.get("/state").json()["refused"]


def left_over(api: RunningApi) -> list[Path]:
    return list((api.store.folder / "assets" / ".incoming").iterdir())


def test_other_media_types_and_names_are_refused(api: RunningApi) -> None:
    form = api.client.post("/assets?name=a.obj", files={"file": TETRAHEDRON})
    assert "application/octet-stream" in sentence(form, 415)
    assert "name" in sentence(api.client.post("/assets", content=TETRAHEDRON, headers=UPLOAD), 422)
    for digest in ("..", "%2e%2e%2fstore.sqlite3", "sha256:" + "0" * 64):
        assert api.client.get(f"/assets/{digest}/content").status_code == 404


def test_a_file_that_needs_more_memory_than_allowed_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "map.hdr"
    path.write_bytes(hdr(2048, 1024))
    assert probe(path, "map", "map.hdr") == {"width": 2048, "height": 1024}
    with pytest.raises(RejectedAssetError, match=r"map\.hdr"):
        probe(path, "map", "map.hdr", memory_bytes=200 << 20)
