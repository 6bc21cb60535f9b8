"""A room with two cameras as real processes: each has its own picture of one world, and goes on without the other."""

import os
import signal
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
import trimesh
from jaxtyping import UInt8

import deltalight as dl
from deltalight.benchmarks.rooms.installation import Installation, installed
from deltalight.benchmarks.rooms.processes import PATIENCE_S, wait_for
from deltalight.protocol.files import write_png
from deltalight.protocol.pictures import decode_rgb
from deltalight.protocol.recording_writer import RecordingWriter
from deltalight.protocol.scene import SceneDocument
from deltalight.sensor_node.cameras.synthetic import FRAMES_PER_ROUND, SyntheticCamera, default_camera
from tests.services.dashboard_samples import SCREENSHOTS

pytestmark = pytest.mark.slow

SIZE = 320, 240
FRAMES, PERIOD_NS = 10, 200_000_000
APART = FRAMES_PER_ROUND // 3
ROOM = "/rooms/hall"
ROOMS = """
nodes: {left: {source: left.mcap}, right: {source: right.mcap}}
rooms: {hall: {nodes: [left, right], scene: scene.json}}
"""
SCENE: dict[str, Any] = {
    "name": "box",
    "objects": [{"asset": "box.glb", "pose": {"translation_m": [0.1, -0.1, 0.03]}}],
    "lights": {
        "mode": "manual",
        "manual": [
            {"type": "directional", "direction": [0.3, 0.4, -1.0], "irradiance": 2.0},
            {"type": "ambient", "radiance": 0.2},
        ],
    },
    "method": {
        "name": "dvct",
        "operator": "paper",
        "quality": "best",
        "volume_size": 32,
        "rsm_size": 128,
        "triangle_budget": 5000,
    },
}
ADDED = {"translation_m": [0.2, -0.03, 0.03]}
# On the way to the renderer and from it, live pictures are JPEG of quality 90: two codings apart.
MEAN_CODES, MOST_CODES, MOST_SHARE = 2.0, 12, 0.99

Pictures = Mapping[str, UInt8[np.ndarray, "h w 3"]]


def write_take(path: Path, index: int) -> None:
    """A take that repeats one frame, so that moments of both cameras are alike."""
    synthetic = SyntheticCamera(camera=default_camera().resized(*SIZE))
    seen = synthetic.frame_at(index)
    with RecordingWriter(path, board=synthetic.board) as recording:
        for number in range(FRAMES):
            now_ns = number * PERIOD_NS
            recording.add(replace(seen, frame_id=number, timestamp_ns=now_ns, depth_timestamp_ns=now_ns))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("room")
    for number, name in enumerate(("left", "right")):
        write_take(made / f"{name}.mcap", number * APART)
    trimesh.creation.box((0.06, 0.06, 0.06)).export(made / "box.glb")
    scene = {**SCENE, "objects": [{**SCENE["objects"][0], "asset": str(made / "box.glb")}]}
    (made / "scene.json").write_text(SceneDocument.model_validate(scene).model_dump_json())
    (made / "rooms.yaml").write_text(ROOMS)
    return made


@pytest.fixture(scope="module")
def hall(folder: Path) -> Iterator[Installation]:
    with installed(folder) as running:
        wait_for(lambda: statuses(running) == {"left": "live", "right": "live"})
        yield running


def cameras(hall: Installation) -> list[dict[str, Any]]:
    answer = hall.client.get(f"{ROOM}/state")
    return list(answer.json()["cameras"]) if answer.status_code == 200 else []


def statuses(hall: Installation) -> dict[str, str]:
    return {each["name"]: each["status"] for each in cameras(hall)}


def live(hall: Installation, camera: str) -> UInt8[np.ndarray, "h w 3"]:
    answer = hall.client.get(f"{ROOM}/live.jpg", params={"camera": camera})
    assert answer.status_code == 200, answer.text
    return decode_rgb(answer.content, camera)


def recorded(folder: Path, name: str) -> dl.Take:
    take = dl.open(folder / f"{name}.mcap")
    assert isinstance(take, dl.Take)
    return take


def in_process(folder: Path, names: Sequence[str], document: SceneDocument) -> Pictures:
    """What `render_views` makes of the same frames."""
    takes = [recorded(folder, name) for name in names]
    with dl.Renderer() as renderer:
        for number in range(2):  # the second learns nothing more of frames at rest
            pictures = renderer.render_views([take[number] for take in takes], document)
    return {name: picture.color for name, picture in zip(names, pictures, strict=True)}


def are_alike(some: UInt8[np.ndarray, "h w 3"], other: UInt8[np.ndarray, "h w 3"]) -> bool:
    apart = np.abs(some.astype(int) - other)
    return bool(apart.mean() <= MEAN_CODES and (apart <= MOST_CODES).mean() >= MOST_SHARE)


def wait_for_pictures(hall: Installation, expected: Pictures) -> None:
    try:
        wait_for(lambda: all(are_alike(live(hall, name), wanted) for name, wanted in expected.items()))
    finally:
        if SCREENSHOTS:
            for name, wanted in expected.items():
                write_png(Path(SCREENSHOTS) / f"camera_{name}.png", np.hstack([live(hall, name), wanted]))


def scene_of(hall: Installation, folder: Path) -> SceneDocument:
    """The active scene, for a renderer of this process."""
    document = hall.client.get(f"{ROOM}/active-scene").json()["document"]
    for item in document["objects"]:
        item["asset"] = str(folder / "box.glb")
    return SceneDocument.model_validate(document)


def test_each_picture_is_that_of_render_views_also_after_an_object_was_added(
    hall: Installation, folder: Path
) -> None:
    names = [each["name"] for each in cameras(hall)]
    before = in_process(folder, names, scene_of(hall, folder))
    wait_for_pictures(hall, before)
    assert not are_alike(before["left"], before["right"])
    scene = hall.client.get(f"{ROOM}/active-scene").json()
    asset = scene["document"]["objects"][0]["asset"]
    added = hall.client.post(f"{ROOM}/scenes/{scene['id']}/objects", json={"asset": asset, "pose": ADDED})
    assert added.status_code == 201, added.text
    after = in_process(folder, names, scene_of(hall, folder))
    wait_for_pictures(hall, after)
    assert not any(are_alike(before[name], after[name]) for name in names)


def test_pick_and_snapshot_are_of_the_camera_that_is_named(hall: Installation, folder: Path) -> None:
    scene = scene_of(hall, folder)
    for name in ("left", "right"):
        frame = recorded(folder, name)[0]
        assert frame.pose is not None
        at = np.array([*scene.objects[0].pose.translation_m, 1.0])
        pixel = frame.camera.matrix @ (np.linalg.inv(frame.pose.world_from_camera) @ at)[:3]
        x, y = (float(value) for value in pixel[:2] / pixel[2])
        picked = hall.client.post(f"{ROOM}/live/pick", json={"x": x, "y": y, "camera": name}).json()
        assert picked["object"] == scene.objects[0].id
        body = {"camera": name, "pictures": [{"name": "a", "view": "camera"}, {"name": "b"}]}
        taken = hall.client.post(f"{ROOM}/snapshots", json=body, timeout=PATIENCE_S).json()
        files = {
            each: hall.client.get(f"{ROOM}/snapshots/{taken['id']}/{each}.png").content for each in ("a", "b")
        }
        assert are_alike(decode_rgb(files["a"], "a"), frame.color)
        assert are_alike(decode_rgb(files["b"], "b"), live(hall, name))
    refused = hall.client.get(f"{ROOM}/live.jpg", params={"camera": "middle"})
    assert refused.status_code == 404
    assert "there are left, right" in refused.json()["detail"] or "right, left" in refused.json()["detail"]


def node(hall: Installation, name: str) -> psutil.Process:
    """The process of a node."""
    found = [
        each
        for each in hall.process.children(recursive=True)
        if any(word.endswith(f"{name}.mcap") for word in each.cmdline())
    ]
    return found[0]


def frames(hall: Installation) -> int:
    """How many pictures of both cameras came."""
    return hall.frames("hall")


def is_fresh(hall: Installation, name: str) -> bool:
    camera = next(each for each in cameras(hall) if each["name"] == name)
    return camera["status"] == "live" and camera["last_frame_s"] < 1


def test_a_room_goes_on_without_a_camera_that_hangs_or_dies_and_has_it_again(
    hall: Installation, folder: Path
) -> None:
    names = [each["name"] for each in cameras(hall)]
    first, other = names
    both = in_process(folder, names, scene_of(hall, folder))
    hung = node(hall, first)
    os.kill(hung.pid, signal.SIGSTOP)
    try:
        wait_for(lambda: statuses(hall) == {first: "silent", other: "live"})
        before = frames(hall)
        wait_for(lambda: frames(hall) >= before + 3)
        assert is_fresh(hall, other)
        default = decode_rgb(hall.picture("hall"), "the first that sends")
        assert are_alike(default, live(hall, other))
        wait_for_pictures(hall, {other: both[other]})  # what the silent one saw lights the room for a while
    finally:
        os.kill(hung.pid, signal.SIGCONT)
    wait_for(lambda: is_fresh(hall, first))
    assert [each["name"] for each in cameras(hall)] == names
    wait_for_pictures(hall, both)
    killed = node(hall, first)
    os.kill(killed.pid, signal.SIGKILL)
    before = frames(hall)
    wait_for(lambda: frames(hall) >= before + 3 and is_fresh(hall, other))
    wait_for(lambda: node(hall, first).pid != killed.pid and is_fresh(hall, first))
    assert [each["name"] for each in cameras(hall)] == names
    wait_for_pictures(hall, both)
