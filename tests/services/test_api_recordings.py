"""Recordings over REST: real recorders at a real node's streams, downloads, killed recorders, wrong requests."""

import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import httpx
import numpy as np
import psutil
import pytest

from deltalight.protocol.scene import SceneDocument
from deltalight.protocol.source import open_source
from deltalight.services import ports
from deltalight.services.api.routes import recording_videos
from deltalight.services.video_file import VideoWriter
from tests.services.api_samples import RunningApi, running_api, sentence
from tests.services.record_samples import HEIGHT, WIDTH, Feed, feeding, frames, write


def wait_for(condition: Callable[[], bool]) -> None:
    for _ in range(600):
        if condition():
            return
        time.sleep(0.05)
    pytest.fail("it never came")


@contextmanager
def fed_api(folder: Path) -> Iterator[tuple[RunningApi, Feed]]:
    with feeding() as (endpoint, feed), running_api(folder, subscribe=[endpoint]) as api:
        yield api, feed


@pytest.fixture(scope="module")
def api(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningApi]:
    """With a node that sends thirty frames a second."""
    with fed_api(tmp_path_factory.mktemp("data")) as (running, _):
        yield running


@pytest.fixture
def client(api: RunningApi) -> httpx.Client:
    return api.client


def grows(client: httpx.Client, name: str) -> Callable[[], bool]:
    return lambda: bool((client.get(f"/recordings/{name}").json().get("frames") or 0) > 3)


def recorders() -> list[psutil.Process]:
    return [child for child in psutil.Process().children() if "record" in child.cmdline()]


def test_a_take_is_recorded_listed_downloaded_and_deleted(api: RunningApi, client: httpx.Client) -> None:
    scene = client.post("/scenes", json={"name": "two lamps"}).json()
    client.post(f"/scenes/{scene['id']}/activate").raise_for_status()
    begun = client.post("/recordings", json={"name": "take-1", "node": "cam"})
    assert begun.status_code == 201, begun.text
    address = begun.headers["location"].removeprefix("/api/v1")
    assert begun.json()["state"] == "waiting"
    wait_for(grows(client, "take-1"))
    assert client.get(address).json()["state"] == "recording"
    for name in ("take-1", "take-2"):
        answer = client.post("/recordings", json={"name": name, "node": "cam"})
        assert "is being recorded already, as take-1" in sentence(answer, 409)
    for action in ("content", "poster.jpg"):
        assert "still being recorded" in sentence(client.get(f"{address}/{action}"), 409)
    assert "still being recorded" in sentence(client.delete(address), 409)
    stopped = client.post(f"{address}/stop")
    assert stopped.status_code == 200, stopped.text
    take = stopped.json()
    assert (take["state"], take["scene"], take["detail"]) == ("finished", "two lamps", "")
    assert take["frames"] > 3
    assert take["streams"]["/color/image"]["messages"] == take["frames"]
    assert take["duration_s"] == pytest.approx((take["frames"] - 1) / 30, rel=1)
    assert client.get("/recordings").json()[0] == take == client.get(address).json()
    assert not recorders()

    whole = client.get(f"{address}/content")
    assert whole.headers["content-disposition"].endswith('filename="take-1.mcap"')
    assert len(whole.content) == take["size_bytes"]
    part = client.get(f"{address}/content", headers={"Range": "bytes=0-7"})
    assert (part.status_code, part.content) == (206, whole.content[:8])
    kept = open_source(api.store.folder / "recordings" / "take-1.mcap")
    assert len(kept) == take["frames"]
    assert isinstance(kept.scene, SceneDocument)
    poster = client.get(f"{address}/poster.jpg")
    assert poster.headers["content-type"] == "image/jpeg"
    picture = cv2.imdecode(np.frombuffer(poster.content, np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None
    assert picture.shape == (HEIGHT, WIDTH, 3)
    assert np.abs(picture[..., ::-1].astype(int) - kept[0].color).mean() < 6
    assert client.delete(address).status_code == 204
    assert "no recording" in sentence(client.get(address), 404)
    assert not list((api.store.folder / "recordings").glob("**/take-1*"))


def test_it_ends_by_itself_after_its_time(client: httpx.Client) -> None:
    name = client.post("/recordings", json={"duration_s": 0.3}).json()["id"]
    assert name.startswith("take-")
    wait_for(lambda: client.get(f"/recordings/{name}").json().get("state") == "finished")
    assert "no recording" in sentence(client.post(f"/recordings/{name}/stop"), 404)
    taken = client.post("/recordings", json={"name": name})
    assert "choose another name" in sentence(taken, 409)


def test_relit_pictures_are_kept_where_wanted_and_downloaded_as_a_video(tmp_path: Path) -> None:
    av = pytest.importorskip("av")

    def frames_of(api: RunningApi, name: str) -> bool:
        return bool(api.client.get(f"/recordings/{name}").json()["frames"])

    with feeding(relights=True) as (endpoint, _), running_api(tmp_path, subscribe=[endpoint]) as relit:
        for name, body in (("plain", {}), ("both", {"composites": True})):
            relit.client.post("/recordings", json={"name": name, **body}).raise_for_status()
            wait_for(partial(frames_of, relit, name))
            time.sleep(0.3)
            relit.client.post(f"/recordings/{name}/stop").raise_for_status()
        both, plain = (relit.client.get(f"/recordings/{name}").json() for name in ("both", "plain"))
        assert plain["composites"] == 0
        assert both["composites"] >= 2
        assert "no relit pictures" in sentence(relit.client.get("/recordings/plain/video.mp4"), 409)
        video = relit.client.get("/recordings/both/video.mp4")
        assert (video.status_code, video.headers["content-type"]) == (200, "video/mp4")
        (tmp_path / "a.mp4").write_bytes(video.content)
        with av.open(str(tmp_path / "a.mp4")) as container:
            assert sum(1 for _ in container.decode(video=0)) == both["composites"]
        part = relit.client.get("/recordings/both/video.mp4", headers={"Range": "bytes=0-3"})
        assert (part.status_code, part.content) == (206, video.content[:4])
        relit.client.delete("/recordings/both").raise_for_status()
        assert not list((tmp_path / "recordings").glob("**/both*"))


def test_a_video_is_made_in_the_background_and_can_be_stopped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With an encoder that stands still after the first picture, until it is told to go on."""
    pytest.importorskip("av")
    folder, go_on, is_encoding = tmp_path / "recordings", threading.Event(), threading.Event()
    folder.mkdir()
    write(folder / "take.mcap", frames(4))
    added = VideoWriter.add

    def add(self: VideoWriter, *picture: Any) -> None:  # noqa: ANN401
        added(self, *picture)
        is_encoding.set()
        assert go_on.wait(60)

    monkeypatch.setattr(VideoWriter, "add", add)
    monkeypatch.setattr(recording_videos, "WAIT_S", 0.1)
    with running_api(tmp_path) as api:
        path, get = "/recordings/take/video", api.client.get
        assert get(path).json() == {"state": "absent", "progress": 0.0, "detail": ""}
        assert api.client.post(path).json()["state"] == "making"
        assert is_encoding.wait(60)
        waiting = get(f"{path}.mp4")
        assert "is being made" in sentence(waiting, 503)
        assert waiting.headers["retry-after"] == "5"
        threading.Timer(0.1, go_on.set).start()
        assert api.client.delete(path).status_code == 204
        assert not list((folder / ".cache").glob("*take*mp4"))
        assert get(path).json()["state"] == "absent"
        monkeypatch.setattr(recording_videos, "WAIT_S", 20.0)
        video = get(f"{path}.mp4")
        assert (video.status_code, video.content[4:8]) == (200, b"ftyp")
        assert get(path).json() == {"state": "ready", "progress": 1.0, "detail": ""}
        assert api.client.delete(path).status_code == 204
        assert get(path).json()["state"] == "absent"


def test_an_end_of_the_service_leaves_nothing_of_a_video(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("av")
    folder, is_encoding = tmp_path / "recordings", threading.Event()
    (folder / ".cache").mkdir(parents=True)
    write(folder / "take.mcap", frames(100))  # 20 s
    (folder / ".cache" / ".take.1.tmp.mp4").write_bytes(b"of a killed process")
    added = VideoWriter.add

    def add(self: VideoWriter, *picture: Any) -> None:  # noqa: ANN401
        added(self, *picture)
        is_encoding.set()
        time.sleep(0.2)

    monkeypatch.setattr(VideoWriter, "add", add)
    with running_api(tmp_path) as api:
        api.client.post("/recordings/take/video").raise_for_status()
        assert is_encoding.wait(60)
    assert not list((folder / ".cache").glob("*.mp4"))


def test_a_video_without_pyav_is_one_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "av", None)
    (tmp_path / "recordings").mkdir()
    write(tmp_path / "recordings" / "take.mcap", frames(3))
    with running_api(tmp_path) as api:
        said = sentence(api.client.get("/recordings/take/video.mp4"), 422)
    assert "pip install av. Or download the .mcap file" in said


@pytest.mark.parametrize(
    ("body", "expected"),
    [
        ({"composites": 1}, "composites"),
        ({"name": "../take"}, "not a valid recording name"),
        ({"name": "a.mcap"}, "not a valid recording name"),
        ({"name": ""}, "not a valid recording name"),
        ({"name": "/etc/take"}, "not a valid recording name"),
        ({"duration_s": 0}, "duration_s"),
        ({"duration": 3}, "the nearest known key is `duration_s`"),
        ({"node": "a b"}, "node"),
        ([], "object with keys"),
    ],
)
def test_wrong_wishes_are_one_sentence(client: httpx.Client, body: object, expected: str) -> None:
    assert expected in sentence(client.post("/recordings", json=body), 422)
    assert not recorders()


@pytest.mark.slow
def test_without_frames_it_says_why_and_leaves_nothing(tmp_path: Path) -> None:
    (nobody,) = ports.private_ports(1)
    with running_api(tmp_path, subscribe=[ports.endpoint(nobody)]) as api:
        client = api.client
        client.post("/recordings", json={"name": "empty"}).raise_for_status()
        wait_for(lambda: "No frame came from" in client.get("/recordings/empty").json()["detail"])
        assert client.get("/recordings").json()[0]["state"] == "waiting"
        answer = client.post("/recordings/empty/stop")
        assert "start a node there or name its endpoint" in sentence(answer, 409)
        assert client.get("/recordings").json() == []


def test_a_killed_recorder_leaves_a_recording_that_is_mended(api: RunningApi, client: httpx.Client) -> None:
    client.post("/recordings", json={"name": "torn"}).raise_for_status()
    wait_for(grows(client, "torn"))
    (recorder,) = recorders()
    recorder.kill()
    wait_for(lambda: bool(client.get("/recordings/torn").json()["state"] == "interrupted"))
    listed: dict[str, Any] = next(each for each in client.get("/recordings").json() if each["id"] == "torn")
    assert listed["frames"] > 0
    assert "interrupted; recover it" in sentence(client.get("/recordings/torn/content"), 409)
    assert client.get("/recordings/torn/poster.jpg").status_code == 200
    mended = client.post("/recordings/torn/recover")
    assert mended.status_code == 200, mended.text
    assert (mended.json()["state"], mended.json()["frames"]) == ("finished", listed["frames"])
    assert not list((api.store.folder / "recordings").glob("torn*.active"))
    assert "nothing to recover" in sentence(client.post("/recordings/torn/recover"), 409)


def test_a_service_that_ends_finishes_what_grows(tmp_path: Path) -> None:
    with fed_api(tmp_path) as (api, _):
        api.client.post("/recordings", json={"name": "last"}).raise_for_status()
        wait_for(grows(api.client, "last"))
    assert len(open_source(tmp_path / "recordings" / "last.mcap")) > 3
    assert not recorders()


def test_a_recorder_that_stops_answering_does_not_hold_the_service(tmp_path: Path) -> None:
    with fed_api(tmp_path) as (api, feed):
        api.client.post("/recordings", json={"name": "slow"}).raise_for_status()
        wait_for(grows(api.client, "slow"))
        feed.paused.set()
        (recorder,) = recorders()
        os.kill(recorder.pid, signal.SIGSTOP)
        assert api.client.get("/recordings/slow").json()["state"] == "recording"
        os.kill(recorder.pid, signal.SIGCONT)
        assert api.client.post("/recordings/slow/stop").json()["state"] == "finished"


def test_what_lies_in_the_folder_is_listed_as_it_is(tmp_path: Path) -> None:
    folder = tmp_path / "recordings"
    folder.mkdir()
    write(folder / "good.mcap", frames(3))
    (folder / "bad.mcap").write_bytes(b"no recording")
    (folder / "notes.txt").touch()
    (folder / "..mcap").touch()
    (folder / "good.mcap.active").write_bytes(b"what it was mended from")
    old, new = folder / ".torn.17.tmp.mcap.active", folder / ".torn.18.tmp.mcap"
    for each in (old, new):
        each.touch()
    os.utime(old, (0, 0))
    with running_api(tmp_path) as api:
        found = {each["id"]: each for each in api.client.get("/recordings").json()}
        assert sorted(found) == ["bad", "good"]
        assert found["good"]["frames"] == 3
        assert (found["bad"]["frames"], found["bad"]["state"]) == (None, "finished")
        assert "not an MCAP recording" in found["bad"]["detail"]
        assert str(tmp_path) not in str(found)
        assert str(tmp_path) not in api.client.get("/recordings/bad/poster.jpg").text
        for name in ("notes", "..", "%2e%2e", "good.mcap"):
            assert api.client.get(f"/recordings/{name}").status_code in (404, 422)
        api.client.delete("/recordings/bad").raise_for_status()
        assert sorted(each["id"] for each in api.client.get("/recordings").json()) == ["good"]
        api.client.delete("/recordings/good").raise_for_status()
        assert api.client.get("/recordings").json() == []
        assert not old.exists()
        assert new.exists(), "it may still grow"
