"""Snapshots over REST: what is ordered, what is kept, what is never listed."""

import shutil
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from deltalight.services.api.snapshot_store import SnapshotStore
from tests.services.api_samples import RunningApi, running_api, sentence
from tests.services.render_server_samples import Recorder
from tests.services.test_api_scenes import wait_for


@pytest.fixture(scope="module")
def api(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningApi]:
    with running_api(tmp_path_factory.mktemp("data")) as running:
        yield running


@pytest.fixture
def server(api: RunningApi) -> Iterator[Recorder]:
    server = Recorder(api.control_port)
    wait_for(lambda: bool(server.asked))
    wait_for(lambda: api.client.get("/state").json()["render_server"] == "answers")
    yield server
    server.close()


@pytest.fixture
def folder(api: RunningApi) -> Iterator[Path]:
    """Of the snapshots, empty."""
    folder = api.store.folder / "snapshots"
    yield folder
    for path in folder.iterdir():
        shutil.rmtree(path)


@pytest.mark.usefixtures("server")
def test_every_view_is_taken_by_default_and_kept(api: RunningApi, folder: Path) -> None:
    client = api.client
    scene = client.post("/scenes", json={"name": "room"}).json()
    client.post(f"/scenes/{scene['id']}/activate").raise_for_status()
    made = client.post("/snapshots", json={})
    assert made.status_code == 201, made.text
    snapshot = made.json()
    assert client.get(made.headers["location"].removeprefix("/api/v1")).json() == snapshot
    assert (snapshot["frame_id"], snapshot["scene_id"], snapshot["scene_revision"]) == (17, scene["id"], 1)
    assert snapshot["recording"] is None
    views = {picture["view"]: picture for picture in snapshot["pictures"]}
    assert {"camera", "composite", "delta", "volume", "effects", "lights"} < set(views)
    assert views["rsm"]["file"] is None
    assert "no shadow maps" in views["rsm"]["detail"]
    assert "rsm.png" not in snapshot["files"]
    answer = client.get(f"/snapshots/{snapshot['id']}/delta.png")
    assert answer.headers["content-type"] == "image/png"
    picture = cv2.imdecode(np.frombuffer(answer.content, np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None
    assert picture.shape == (4, 6, 3)
    moving = client.get(f"/snapshots/{snapshot['id']}/before-after.gif")
    assert (moving.status_code, moving.headers["content-type"]) == (200, "image/gif")
    assert Image.open(BytesIO(moving.content)).size == (6, 4)
    pytest.importorskip("av")
    video = client.get(f"/snapshots/{snapshot['id']}/before-after.mp4")
    assert (video.status_code, video.headers["content-type"], video.content[4:8]) == (
        200,
        "video/mp4",
        b"ftyp",
    )
    assert not list(folder.parent.glob(".video-*"))
    assert sorted(path.name for path in folder.iterdir()) == [snapshot["id"]]
    assert client.delete(f"/snapshots/{snapshot['id']}").status_code == 204
    assert not list(folder.iterdir())


def test_the_order_names_views_and_methods(api: RunningApi, server: Recorder, folder: Path) -> None:
    wanted = [
        {"name": "paper", "method": {"name": "dvct", "operator": "paper"}},
        {"name": "d", "view": "delta"},
    ]
    answer = api.client.post("/snapshots", json={"pictures": wanted, "exr": True})
    assert answer.status_code == 201, answer.text
    order = server.payloads("snapshot")[-1]
    first, second = order["pictures"]
    assert (first["name"], first["view"], first["method"]["operator"]) == ("paper", "composite", "paper")
    assert second == {"name": "d", "view": "delta", "method": None}
    assert order["exr"] is True
    assert str(folder) in str(order["folder"])
    listed = api.client.get("/snapshots").json()
    assert [each["files"] for each in listed] == [["paper.png", "d.png"]]
    refused = api.client.get(f"/snapshots/{listed[0]['id']}/before-after.gif")
    assert "no picture of view `camera`; take one that has" in sentence(refused, 404)


@pytest.mark.usefixtures("server", "folder")
def test_before_and_after_are_found_by_their_views(api: RunningApi) -> None:
    wanted = [{"name": "after", "view": "composite"}, {"name": "plate", "view": "camera"}]
    taken = api.client.post("/snapshots", json={"pictures": wanted})
    assert taken.status_code == 201, taken.text
    moving = api.client.get(f"/snapshots/{taken.json()['id']}/before-after.gif")
    assert moving.status_code == 200, moving.text


@pytest.mark.parametrize(
    ("body", "expected"),
    [
        ({"pictures": [{"name": "../x"}]}, "name"),
        ({"pictures": [{"name": "a"}, {"name": "a"}]}, "the same name"),
        ({"pictures": [{"name": "a", "view": "side"}]}, "composite"),
        ({"pictures": [{"name": "a", "method": {"name": "none", "cones": 3}}]}, "cones"),
        ({"pictures": [{"name": f"p{number}"} for number in range(17)]}, "at most 16"),
        ({"pictures": []}, "at least 1"),
        ({"picture": []}, "the nearest known key is `pictures`"),
    ],
)
def test_wrong_orders_are_one_sentence(api: RunningApi, body: object, expected: str) -> None:
    assert expected in sentence(api.client.post("/snapshots", json=body), 422)


def test_a_refusal_leaves_nothing(api: RunningApi, server: Recorder, folder: Path) -> None:
    server.fault = "No frame has come yet; take the snapshot when there is a picture."
    assert "No frame has come yet" in sentence(api.client.post("/snapshots", json={}), 422)
    server.fault = None
    only_faults = {"pictures": [{"name": "a", "view": "rsm"}]}
    assert "no shadow maps" in sentence(api.client.post("/snapshots", json=only_faults), 502)
    assert not list(folder.iterdir())
    assert api.client.get("/snapshots").json() == []


@pytest.mark.usefixtures("server")
def test_what_is_not_whole_or_not_a_snapshot_is_not_listed(api: RunningApi, folder: Path) -> None:
    ids = [api.client.post("/snapshots", json={}).json()["id"] for _ in range(3)]
    (folder / ids[0] / "snapshot.json").write_text('{"id": ')
    (folder / ".20261121-101500-3fa2c1.part").mkdir()
    (folder / "20261121-101500-3fa2c1").mkdir()
    assert [each["id"] for each in api.client.get("/snapshots").json()] == sorted(ids[1:], reverse=True)
    for address in (ids[0], "none", "20261121-101500-3fa2c1", f"{ids[1]}/snapshot.json", f"{ids[1]}/rsm.png"):
        assert api.client.get(f"/snapshots/{address}").status_code in (404, 422)
    SnapshotStore(folder)
    assert (folder / ".20261121-101500-3fa2c1.part").is_dir(), "it may still grow"


def test_without_a_render_server_it_says_so_at_once(api: RunningApi) -> None:
    wait_for(lambda: api.client.get("/state").json()["render_server"] == "silent")
    assert "does not answer" in sentence(api.client.post("/snapshots", json={}), 503)
