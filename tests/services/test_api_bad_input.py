"""What a hostile or unlucky client sends: refused with one sentence, counted, and nothing half-written remains.

What else is refused, and how, is in test_api_assets.py, test_api_scenes.py, test_api_security.py and
test_gltf_zip.py.
"""

import gzip
import io
import json
import socket
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import httpx
import numpy as np
import pytest

from deltalight.protocol.message_fields import MAX_SENTENCE
from deltalight.protocol.radiance_files import write_exr
from deltalight.services import ports
from deltalight.services.api.problems import TYPE_PREFIX
from deltalight.services.storage.asset_sandbox import probe
from deltalight.services.storage.faults import StorageFaultError
from tests.services.api_samples import UPLOAD, RenderServer, RunningApi, running_api, sentence
from tests.services.record_samples import frames, write
from tests.services.storage_samples import TETRAHEDRON, glb

LIMIT_MB = 2
JSON = {"Content-Type": "application/json"}
TRIANGLE = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4").tobytes()
WORKERS = 16


@pytest.fixture(scope="module")
def api(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningApi]:
    with running_api(tmp_path_factory.mktemp("data"), probe, upload_limit_mb=LIMIT_MB) as running:
        yield running


def counted(client: httpx.Client, kind: str) -> float:
    """How many refusals of a kind Prometheus is told of."""
    start = f'deltalight_api_refused_total{{kind="{kind}"}} '
    lines = client.get("/metrics").text.splitlines()
    return next((float(line.removeprefix(start)) for line in lines if line.startswith(start)), 0.0)


def kept(api: RunningApi) -> set[Path]:
    """All files of the data folder but the database's own."""
    paths = api.store.folder.rglob("*")
    return {path for path in paths if path.is_file() and not path.name.startswith("store.sqlite3")}


@contextmanager
def refusing(api: RunningApi, kind: str) -> Iterator[None]:
    """The block makes one refusal of this kind; no file is left of it, and nothing failed inside the service."""
    before, files = counted(api.client, kind), kept(api)
    yield
    assert counted(api.client, kind) == before + 1
    assert kept(api) == files
    assert counted(api.client, "internal") == 0


def refused(api: RunningApi, answer: Callable[[], httpx.Response], status: int, kind: str) -> str:
    with refusing(api, kind):
        response = answer()
    text = sentence(response, status)
    assert response.json()["type"] == TYPE_PREFIX + kind
    assert text.endswith(".")
    assert "\n" not in text
    assert str(api.store.folder) not in text
    return text


def upload(client: httpx.Client, content: bytes, name: str) -> httpx.Response:
    return client.post("/assets", params={"name": name}, content=content, headers=UPLOAD)


def mesh(accessor: dict[str, object] | None = None, **parts: object) -> bytes:
    """A .glb of one triangle, with other keys in its accessor of positions and other parts in its document."""
    plain = {"bufferView": 0, "componentType": 5126, "type": "VEC3", "count": 3}
    return glb(
        {
            "asset": {"version": "2.0"},
            "buffers": [{"byteLength": len(TRIANGLE)}],
            "bufferViews": [{"buffer": 0, "byteLength": len(TRIANGLE)}],
            "accessors": [{**plain, **(accessor or {})}],
            "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
            "nodes": [{"mesh": 0}],
            "scenes": [{"nodes": [0]}],
            "scene": 0,
            **parts,
        },
        TRIANGLE,
    )


def png_bomb(edge: int = 30_000) -> bytes:
    """A white picture of one bit a pixel, whose colours take gigabytes once they are numbers."""
    packer = zlib.compressobj(1)
    row = b"\0" + b"\xff" * (edge // 8)
    data = b"".join(packer.compress(row) for _ in range(edge)) + packer.flush()
    head = struct.pack(">IIBBBBB", edge, edge, 1, 0, 0, 0, 0)
    chunks = ((b"IHDR", head), (b"IDAT", data), (b"IEND", b""))
    pieces = (
        struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
        for kind, body in chunks
    )
    return b"\x89PNG\r\n\x1a\n" + b"".join(pieces)


def textured_bomb() -> bytes:
    picture = png_bomb()
    uv = np.zeros((3, 2), "<f4").tobytes()
    pieces = [TRIANGLE, uv, picture]
    starts = np.cumsum([0, *map(len, pieces)])
    views = [
        {"buffer": 0, "byteOffset": int(start), "byteLength": len(piece)}
        for start, piece in zip(starts, pieces, strict=False)
    ]
    return glb(
        {
            "asset": {"version": "2.0"},
            "buffers": [{"byteLength": sum(map(len, pieces))}],
            "bufferViews": views,
            "accessors": [
                {"bufferView": 0, "componentType": 5126, "type": "VEC3", "count": 3},
                {"bufferView": 1, "componentType": 5126, "type": "VEC2", "count": 3},
            ],
            "images": [{"bufferView": 2, "mimeType": "image/png"}],
            "textures": [{"source": 0}],
            "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
            "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "material": 0}]}],
            "nodes": [{"mesh": 0}],
            "scenes": [{"nodes": [0]}],
            "scene": 0,
        },
        b"".join(pieces),
    )


def exr_bomb(folder: Path) -> bytes:
    """A small map whose head announces a hundred thousand times the pixels."""
    write_exr(folder / "map.exr", np.ones((8, 16, 3), np.float32))
    content = (folder / "map.exr").read_bytes()
    small, vast = struct.pack("<4i", 0, 0, 15, 7), struct.pack("<4i", 0, 0, 199_999, 99_999)
    assert content.count(small) == 2
    return content.replace(small, vast)


def zip_bomb() -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.gltf", json.dumps({"asset": {"version": "2.0"}}))
        archive.writestr("zeros.bin", bytes(4 << 20))
    return buffer.getvalue()


@pytest.mark.parametrize(
    ("content", "name", "expected"),
    [
        (b"\x89PNG\r\n\x1a\n" + bytes(64), "chair.glb", "not in a known format"),
        (b"%PDF-1.7\n", "chair.obj", "not in a known format"),
        (b"\x7fELF" + bytes(64), "room.exr", "not in a known format"),
        (mesh(), "chair.obj", "is a GLB file and not OBJ"),
        (zip_bomb(), "bomb.zip", "more than 2 MB unpacked"),
        (mesh({"count": -3}), "lie.glb", "where a count belongs"),
        (mesh({"count": 1e9}), "lie.glb", "where a count belongs"),
        (mesh({"count": 4}), "lie.glb", "bytes where 36 are"),
        (mesh({"byteOffset": 24}), "lie.glb", "bytes where 36 are"),
        (mesh({"bufferView": 7}), "lie.glb", "lie.glb"),
        (mesh({"componentType": 1}), "lie.glb", "lie.glb"),
        (mesh(bufferViews=[{"buffer": 0, "byteLength": 1 << 40}]), "lie.glb", "beyond its buffer"),
        (mesh(buffers=[{"byteLength": 1 << 40}]), "lie.glb", "holds only"),
        (mesh(nodes=[{"children": [0], "mesh": 0}]), "circle.glb", "circle.glb"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_wrong_and_lying_files(api: RunningApi, content: bytes, name: str, expected: str) -> None:
    assert expected in refused(api, lambda: upload(api.client, content, name), 422, "rejected-asset")


def test_pictures_that_unpack_to_gigabytes(api: RunningApi, tmp_path: Path) -> None:
    for content, name in ((textured_bomb(), "bomb.glb"), (exr_bomb(tmp_path), "bomb.exr")):
        assert len(content) < LIMIT_MB << 20
        assert name in refused(api, partial(upload, api.client, content, name), 422, "rejected-asset")


def request_head(api: RunningApi, *headers: str) -> bytes:
    host, port = api.client.base_url.host, api.client.base_url.port
    lines = ("POST /api/v1/assets?name=big.glb HTTP/1.1", f"Host: {host}:{port}", f"Content-Type: {OCTETS}")
    return "\r\n".join((*lines, *headers, "", "")).encode()


OCTETS = UPLOAD["Content-Type"]


@contextmanager
def connected(api: RunningApi) -> Iterator[socket.socket]:
    host, port = api.client.base_url.host, api.client.base_url.port
    assert port is not None
    with socket.create_connection((host, port), timeout=20) as connection:
        yield connection


def test_two_gigabytes_are_refused_before_the_first_of_them(api: RunningApi) -> None:
    with refusing(api, "too-large"), connected(api) as connection:
        connection.sendall(request_head(api, f"Content-Length: {2 << 30}"))
        answer = connection.makefile("rb").read().decode()  # to the end of the connection; no body was sent
    assert answer.startswith("HTTP/1.1 413")
    assert "connection: close" in answer.lower()
    assert f"The body is larger than {LIMIT_MB} MB; send less." in answer


def test_what_has_no_length_is_cut_off_at_the_limit(api: RunningApi) -> None:
    chunk, sent = bytes(64 << 10), 0
    piece = b"%x\r\n%s\r\n" % (len(chunk), chunk)
    with refusing(api, "too-large"), connected(api) as connection:
        connection.sendall(request_head(api, "Transfer-Encoding: chunked"))
        try:
            while sent < 2 << 30:
                connection.sendall(piece)
                sent += len(chunk)
        except OSError:  # the service closed the connection
            pass
    # What was on its way when it closed lies in the buffers of both sockets.
    assert sent < (LIMIT_MB + 30) << 20


@pytest.mark.parametrize("length", ["-1", "1e3", "9" * 5000, "5, 6", "\u0663"])
def test_lengths_that_are_none_end_the_connection(api: RunningApi, length: str) -> None:
    files = kept(api)
    with connected(api) as connection:
        connection.sendall(request_head(api)[:-2] + f"Content-Length: {length}\r\n\r\n".encode())
        assert connection.makefile("rb").read().startswith(b"HTTP/1.1 400")
    assert kept(api) == files
    assert counted(api.client, "internal") == 0


def test_yaml_that_is_a_trap(api: RunningApi) -> None:
    def sent(text: str) -> httpx.Response:
        return api.client.post("/scenes", content=text, headers={"Content-Type": "application/yaml"})

    laughs = "\n".join(
        ["a0: &a0 [x]", *(f"a{n}: &a{n} [{','.join([f'*a{n - 1}'] * 9)}]" for n in range(1, 12))]
    )
    for text in (
        laughs,
        "name: &a [*a]",
        "&a {name: x, lights: *a}",
        "name: !!python/object/apply:os.system [id]",
        "[" * 3000,
        "name: " + "9" * 5000,
        "name: 2020-13-45",
    ):
        refused(api, partial(sent, text), 422, "invalid")


@pytest.mark.parametrize("path", ["/scenes", "/recordings"])  # read by this service, and by its framework
def test_json_beyond_limits_is_not_called_malformed(api: RunningApi, path: str) -> None:
    for body, said in (
        (b'{"name": ' + b"9" * 5000 + b"}", "has a number of more than 4300 digits; give a shorter one."),
        (b'{"name": ' * 100_000, "is nested too deeply; give the keys that a document has."),
    ):
        post = partial(api.client.post, path, content=body, headers=JSON)
        assert refused(api, post, 400, "not-json") == f"The body {said}"


def test_names_that_postgresql_cannot_keep(api: RunningApi) -> None:
    client = api.client
    for send in (
        lambda: client.post("/scenes", json={"name": "a\0b"}),
        lambda: upload(client, mesh(), "a\0b.glb"),
    ):
        assert "must not hold a NUL character" in refused(api, send, 422, "invalid")


def test_text_that_no_encoding_has_and_long_keys(api: RunningApi) -> None:
    key = b'"\\ud800": 1'
    for path, body in (
        ("/scenes", b"{%s}" % key),
        ("/recordings", b"{%s}" % key),
        ("/snapshots", b'{"pictures": [{"name": "a", "method": {"name": "dvct", %s}}]}' % key),
        ("/scenes", b'{"name": "\\ud800"}'),
        ("/scenes", b'{"%s": 1}' % (b"x" * 100_000)),
    ):
        text = refused(api, partial(api.client.post, path, content=body, headers=JSON), 422, "invalid")
        assert len(text) <= MAX_SENTENCE


def test_stale_changes_and_assets_in_use(api: RunningApi) -> None:
    client = api.client
    reference = upload(client, mesh(), "used.glb").json()["asset"]
    scene = client.post("/scenes", json={"objects": [{"id": "a", "asset": reference}]}).json()
    address = f"/scenes/{scene['id']}"
    client.patch(address, json={"name": "newer"}).raise_for_status()
    stale = {"If-Match": '"1"'}
    for method, path, body in (
        ("PATCH", "", {"name": "older"}),
        ("PUT", "/lights", {"mode": "fisheye"}),
        ("PATCH", "/objects/a", {"visible": False}),
        ("DELETE", "/objects/a", None),
        ("POST", "/undo", None),
        ("DELETE", "", None),
    ):
        request = client.build_request(method, address + path, json=body, headers=stale)
        text = refused(api, partial(client.send, request), 409, "stale-revision")
        assert "the scene is at revision 2 and the change was made to 1" in text
    in_body = refused(api, lambda: client.put(address, json={"revision": 1}), 409, "stale-revision")
    assert "made to 1" in in_body
    assert "used by scene" in refused(api, lambda: client.delete(f"/assets/{reference}"), 409, "conflict")
    assert client.get(address).json()["revision"] == 2
    assert client.get(f"/assets/{reference}/content").content == mesh()


def test_tokens_that_nobody_knows_and_too_many_requests(tmp_path: Path) -> None:
    with running_api(tmp_path / "a") as api:  # where none is needed, a wrong one is refused all the same
        guess = {"Authorization": "Bearer guess"}
        for _ in range(10):
            refused(api, lambda: api.client.get("/scenes", headers=guess), 401, "token")
        refused(api, lambda: api.client.get("/scenes?ticket=guess"), 429, "wrong-tokens")
    with running_api(tmp_path / "b", requests_per_s=1) as api:
        statuses = [api.client.get("/settings").status_code for _ in range(6)]
        assert statuses.count(429) >= 3
        assert api.app.state.context.problems.counts["rate"] == statuses.count(429)  # type: ignore[attr-defined]


def test_ranges_that_a_file_does_not_have(api: RunningApi) -> None:
    address = "/assets/" + upload(api.client, TETRAHEDRON, "t.obj").json()["asset"] + "/content"
    for wanted, status in (("bytes=5000-", 416), ("bytes=a-b", 400)):
        refused(api, partial(api.client.get, address, headers={"Range": wanted}), status, "range")
    part = api.client.get(address, headers={"Range": "bytes=0-5"})
    assert (part.status_code, part.content) == (206, TETRAHEDRON[:6])


def test_many_that_delete_and_read_the_same_at_once(tmp_path: Path) -> None:
    """Each finds it or is told that it is gone; a poster, that its recording cannot be read any more."""
    with running_api(tmp_path / "data", requests_per_s=10_000) as api:
        recorded = frames(2)
        names = [f"take{n}" for n in range(8)]
        for name in names:
            write(api.store.folder / "recordings" / f"{name}.mcap", recorded)
        meshes = [TETRAHEDRON + b"# %d\n" % n for n in range(8)]
        digests = [upload(api.client, content, "t.obj").json()["asset"] for content in meshes]
        wanted = []
        for thing in [f"/recordings/{name}" for name in names] + [f"/assets/{each}" for each in digests]:
            reads = [("GET", thing), ("GET", f"{thing}/content"), ("GET", thing.rsplit("/", 1)[0])]
            wanted += [*reads, ("DELETE", thing), *reads, ("DELETE", thing), *reads]
        wanted += [("GET", f"/recordings/{name}/poster.jpg") for name in names]
        with ThreadPoolExecutor(WORKERS) as pool:
            answers = list(pool.map(lambda request: api.client.request(*request), wanted))
        statuses = [(*request, answer.status_code) for request, answer in zip(wanted, answers, strict=True)]
        assert {status for *_, status in statuses} <= {200, 204, 404, 422}, statuses
        assert counted(api.client, "internal") == 0
        assert not [path for path in kept(api) if path.suffix in (".mcap", ".obj")]


def test_a_disk_that_refuses_is_a_sentence(tmp_path: Path) -> None:
    with running_api(tmp_path / "data") as api:
        incoming = api.store.folder / "assets" / ".incoming"
        incoming.rmdir()
        text = refused(api, lambda: upload(api.client, TETRAHEDRON, "t.obj"), 503, "storage-fault")
        assert "cannot be kept" in text
        incoming.mkdir()
        assert upload(api.client, TETRAHEDRON, "t.obj").status_code == 201
        (api.store.folder / "snapshots").rmdir()
        text = refused(api, lambda: api.client.get("/snapshots"), 503, "storage-fault")
        assert "data folder cannot be used" in text


def test_tokens_that_cannot_be_read_let_nobody_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with running_api(tmp_path / "data", host="0.0.0.0") as api:

        def fail(_token: str) -> None:
            raise StorageFaultError("The database cannot be used now; free some space.")

        monkeypatch.setattr(api.store.tokens, "verify", fail)
        answer = api.client.get("/scenes", headers={"Authorization": "Bearer right"})
        assert "cannot be used now" in sentence(answer, 503)


def test_addresses_and_methods_that_there_are_not(api: RunningApi) -> None:
    assert "there is nothing at" in refused(api, lambda: api.client.get("/nothing"), 404, "not-found")
    text = refused(api, lambda: api.client.delete("/state"), 405, "method-not-allowed")
    assert "does not support that method" in text


def test_a_render_server_that_dies_holds_nobody_up(tmp_path: Path) -> None:
    """A snapshot may take two minutes; who asks a dead server for one waits a second."""
    (control_port,) = ports.private_ports(1)
    server = RenderServer(control_port)
    with running_api(tmp_path / "data", control=ports.endpoint(control_port)) as api:
        context = api.app.state.context  # type: ignore[attr-defined]
        assert context.link.command("ping")["revision"] == 7
        server.close()
        assert "answer" in refused(api, lambda: api.client.post("/snapshots", json={}), 503, "render-server")
        assert api.client.get("/health").json()["render_server"] == "silent"


@pytest.mark.parametrize("method", ["POST", "PATCH"])
def test_an_encoded_body_is_called_so(api: RunningApi, method: str) -> None:
    """Packed JSON is neither text nor JSON to a server that does not unpack it."""
    headers = {**JSON, "Content-Encoding": "gzip"}
    ask = partial(api.client.request, method, "/scenes", content=gzip.compress(b"{}"), headers=headers)
    said = refused(api, ask, 415, "content-encoding")
    assert said == "The body is encoded (gzip); send it as it is, without Content-Encoding."
    assert ask().headers["accept-encoding"] == "identity"


def test_what_is_missing_is_named(api: RunningApi) -> None:
    assert "`query.name` is missing; add it." in refused(
        api, lambda: api.client.post("/assets", content=b"x", headers=UPLOAD), 422, "invalid"
    )
