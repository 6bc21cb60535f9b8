"""The Python client against a real service, and the examples of its page as they stand there."""

import re
import textwrap
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.scene import SceneDocument
from deltalight.protocol.scene_method import DlpvMethod
from deltalight.protocol.source import open_source
from deltalight.services import ports
from deltalight.services.client import ApiError, Client
from deltalight.services.live_message import unpack
from tests.services.api_samples import RunningApi, running_api
from tests.services.conftest import HEIGHT, ROOT, WIDTH
from tests.services.live_samples import StandInStream, wait_for_frames
from tests.services.record_samples import frames, write
from tests.services.render_server_samples import Recorder
from tests.services.storage_samples import TETRAHEDRON, upload

PAGE = ROOT / "docs" / "python-client.md"
PRINTED_ADDRESS = "http://127.0.0.1:8000"
LIGHT = {"type": "sphere", "position_m": [1, 0, 1], "intensity": 5}


@dataclass(frozen=True)
class Service:
    """A service with pictures, and its address."""

    api: RunningApi
    server: Recorder
    address: str


@contextmanager
def serving(folder: Path, **settings: object) -> Iterator[Service]:
    """A service whose render server and node are stand-ins; a scene with an object is shown."""
    control_port, stream_port = ports.private_ports(2)
    endpoints = {"control": ports.endpoint(control_port), "subscribe": [ports.endpoint(stream_port)]}
    server, stream = Recorder(control_port), StandInStream(stream_port)
    try:
        with running_api(folder, **endpoints, **settings) as api:
            upload(api.store, TETRAHEDRON, "knot.obj")
            scene = {"name": "room", "objects": [{"id": "knot", "asset": "knot.obj"}]}
            api.store.scenes.activate(api.store.scenes.create(scene).head.id)
            wait_for_frames(f"{ports.LOOPBACK}:{api.client.base_url.port}")
            yield Service(api, server, str(api.client.base_url).removesuffix("/api/v1/"))
    finally:
        stream.close()
        server.close()


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    with serving(tmp_path_factory.mktemp("data")) as running:
        yield running


@pytest.fixture
def client(service: Service) -> Iterator[Client]:
    with Client(service.address) as connected:
        yield connected


def example(number: int) -> str:
    """The code under the page's heading `## NUMBER. ...`."""
    section = re.split(r"^## ", PAGE.read_text(), flags=re.MULTILINE)[number]
    assert section.startswith(f"{number}. ")
    (code,) = re.findall(r"^```python\n(.*?)^```", section, re.MULTILINE | re.DOTALL)
    return textwrap.dedent(code)


def run_example(number: int, address: str) -> None:
    code = example(number)
    assert PRINTED_ADDRESS in code
    exec(compile(code.replace(PRINTED_ADDRESS, address), f"{PAGE.name}, example {number}", "exec"), {})


def test_the_page_has_three_examples() -> None:
    blocks = re.findall(r"^```python\n(.*?)^```", PAGE.read_text(), re.MULTILINE | re.DOTALL)
    assert blocks[1:] == [example(number) for number in (1, 2, 3)]
    exec(compile(blocks[0], PAGE.name, "exec"), {})  # connects to nobody yet


def test_an_object_walks_in_a_circle(service: Service, client: Client) -> None:
    before = client.active_scene()
    run_example(1, service.address)
    after = client.active_scene()
    assert after.revision == before.revision + 24
    assert after.document.replaced(revision=before.revision) == before.document
    history = client.request("GET", f"/scenes/{after.id}/revisions", params={"limit": 24})
    assert [each["what"] for each in history] == ["undo"] * 12 + ["knot: pose changed"] * 12
    way = [
        client.request("GET", f"/scenes/{after.id}/revisions/{each['revision']}")["document"]["objects"][0]
        for each in history[12:]
    ]
    places = {tuple(round(x, 4) for x in step["pose"]["translation_m"]) for step in way}
    assert len(places) == 12
    for _ in range(200):  # a busy machine's render server may have been silent for a second
        if after.picture == ("shown", ""):
            break
        time.sleep(0.05)
        after.refresh()
    assert after.picture == ("shown", "")


def test_a_model_and_light_of_ones_own(
    service: Service,
    client: Client,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "chair.glb").write_bytes((ROOT / "services" / "demo_assets" / "object.glb").read_bytes())
    before = client.active_scene()
    run_example(2, service.address)
    assert "triangles" in capsys.readouterr().out
    after = client.active_scene()
    assert [item.id for item in after.document.objects] == ["knot"]
    assert after.revision == before.revision + 3
    assert after.document.lights.mode == "manual"
    assert "chair.glb" in [name for asset in client.assets() for name in asset.names]


def test_methods_are_compared_and_the_stream_watched(
    service: Service, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    run_example(3, service.address)
    lines = capsys.readouterr().out.splitlines()
    assert lines[:3] == ["compared/cones.png", "compared/volumes.png", "compared/camera.png"]
    assert all((tmp_path / line).read_bytes()[:4] == b"\x89PNG" for line in lines[:3])
    (order,) = service.server.payloads("snapshot")
    assert order["exr"] is True
    assert 1 <= len(lines[3:]) <= 5
    assert all(re.fullmatch(rf"\d+ \d+ ms \S+ \({HEIGHT}, {WIDTH}, 3\)", line) for line in lines[3:])


def test_names_of_objects_may_hold_what_addresses_may_not(client: Client) -> None:
    scene = client.create_scene(SceneDocument(name="names"))
    for name in ("a?b#c", "a/b", "50 % ü"):
        assert scene.add_object("knot.obj", id=name) == name
        scene.move(name, translation_m=(1.0, 0.0, 0.0))
        (item,) = scene.document.objects
        assert (item.id, item.pose.translation_m) == (name, (1, 0, 0))
        scene.remove_object(name)
    scene.delete()


def test_a_scene_is_made_changed_and_deleted(client: Client) -> None:
    scene = client.create_scene(SceneDocument(name="made here"))
    assert (scene.revision, scene.document.name, scene.picture) == (1, "made here", None)
    added = scene.add_object("knot.obj")
    scene.move(added, translation_m=(1.0, 2.0, 3.0))
    scene.move(added, rotation_wxyz=(0.0, 0.0, 0.0, 1.0))
    scene.change_object(added, visible=False)
    (item,) = scene.document.objects
    assert (item.pose.translation_m, item.pose.rotation_wxyz, item.visible) == (
        (1, 2, 3),
        (0, 0, 0, 1),
        False,
    )
    scene.set_method("dlpv")
    scene.set_output(view="delta")
    scene.set_lights(mode="manual", manual=[LIGHT])
    document = scene.document
    assert isinstance(document.method, DlpvMethod)
    assert (document.output.view, document.lights.mode) == ("delta", "manual")
    scene.undo()
    assert scene.document.lights != document.lights
    scene.redo()
    assert scene.document.lights == document.lights
    scene.replace(scene.document.replaced(name="another"))
    assert client.scene(scene.id).document.name == "another"
    assert scene.id in [each["id"] for each in client.scenes()]
    scene.delete()
    with pytest.raises(ApiError, match="no scene") as gone:
        scene.refresh()
    assert (gone.value.status, gone.value.kind) == (404, "not-found")


def test_who_wants_to_be_alone_hears_of_others(client: Client) -> None:
    mine = client.create_scene({"name": "shared"})
    others = client.scene(mine.id)
    others.set_output(view="delta")
    with pytest.raises(ApiError) as refused, mine.exclusively():
        mine.set_output(view="camera")
    assert (refused.value.status, refused.value.kind, refused.value.revision) == (409, "stale-revision", 2)
    mine.set_output(antialiasing=True)  # to the newest revision, whoever made it
    assert (mine.document.output.view, mine.document.output.antialiasing) == ("delta", True)


def test_events_tell_of_changes(client: Client) -> None:
    events = client.events()
    assert next(events)["type"] == "hello"
    scene = client.create_scene({"name": "heard of"})
    told = next(event for event in events if event["type"] == "scene" and event["id"] == scene.id)
    assert (told["revision"], told["name"]) == (1, "heard of")


def test_recordings_are_downloaded_whole_or_not_at_all(
    service: Service, client: Client, tmp_path: Path
) -> None:
    write(service.api.store.folder / "recordings" / "take.mcap", frames(3))
    client.download_recording("take", tmp_path / "copy.mcap")
    assert len(open_source(tmp_path / "copy.mcap")) == 3
    with pytest.raises(ApiError, match="no recording"):
        client.download_recording("none", tmp_path / "none.mcap")
    with pytest.raises(ApiError, match="no recording"):
        client.stop_recording("none")
    with pytest.raises(DeltalightError, match="cannot be written"):
        client.download_recording("take", tmp_path / "absent" / "copy.mcap")
    assert [path.name for path in tmp_path.iterdir()] == ["copy.mcap"]


def test_with_a_token_everything_works_streams_too(tmp_path: Path) -> None:
    with serving(tmp_path, host="0.0.0.0") as service:
        token = service.api.store.tokens.create("me", "control")
        with Client(service.address, token) as client:
            assert client.active_scene().document.name == "room"
            assert next(client.frames()).picture().shape == (HEIGHT, WIDTH, 3)
            assert next(client.events())["role"] == "control"
        with Client(service.address, "guess") as client:
            for attempt in (client.state, lambda: next(client.frames())):
                with pytest.raises(ApiError, match="is unknown") as refused:
                    attempt()
                assert (refused.value.status, refused.value.kind) == (401, "token")
        with Client(service.address) as client, pytest.raises(DeltalightError, match="401"):
            next(client.frames())


@pytest.mark.parametrize("message", [b"", b"\x02\0\0\0{}\xff\xd8", b"\xff\xff\0\0{}"])
def test_a_picture_without_a_valid_header_is_a_sentence(message: bytes) -> None:
    with pytest.raises(DeltalightError, match="valid header"):
        unpack(message)


def test_faults_are_sentences(service: Service, client: Client, tmp_path: Path) -> None:
    (free,) = ports.private_ports(1)
    with Client(f"http://{ports.LOOPBACK}:{free}") as nobody:
        for attempt in (nobody.state, lambda: next(nobody.frames())):
            with pytest.raises(DeltalightError, match=rf"{ports.LOOPBACK}:{free}.*;"):
                attempt()
    with (
        Client(f"{ports.LOOPBACK}:{free}") as unfinished,
        pytest.raises(DeltalightError, match="correct the address"),
    ):
        unfinished.state()
    with pytest.raises(DeltalightError, match="is not an address"):
        Client("http://host:port")
    with (
        Client(f"{service.address}/api/v1/live.jpg?") as picture,
        pytest.raises(DeltalightError, match="is not a Deltalight service"),
    ):
        picture.state()
    with pytest.raises(DeltalightError, match="cannot be read"):
        client.upload(tmp_path / "absent.glb")
    (tmp_path / "wrong.glb").write_bytes(b"MZ")
    with pytest.raises(ApiError, match="not in a known format") as refused:
        client.upload(tmp_path / "wrong.glb")
    assert (refused.value.status, refused.value.kind) == (422, "rejected-asset")


def test_what_is_too_large_says_so_in_spite_of_the_closed_connection(tmp_path: Path) -> None:
    with running_api(tmp_path / "data", upload_limit_mb=1) as api:
        path = tmp_path / "large.glb"
        path.write_bytes(bytes(32 << 20))
        address = str(api.client.base_url).removesuffix("/api/v1/")
        with Client(address) as client, pytest.raises(ApiError, match="larger than 1 MB") as refused:
            client.upload(path)
        assert refused.value.kind == "too-large"
