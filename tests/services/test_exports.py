"""Exports to other programs: a point of the world lands on the same pixel by each format's own conventions."""

import json
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh

from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import DepthImage
from deltalight.protocol.poses import rigid_matrix, rotation_from_wxyz
from deltalight.protocol.recording_reader import RecordingReader
from deltalight.protocol.recording_writer import RecordingWriter
from deltalight.protocol.scene import parse_scene
from deltalight.protocol.source import open_source
from deltalight.services.exports import ExportFormat
from deltalight.services.exports.colmap import camera_line
from deltalight.services.exports.recording import export_as
from deltalight.services.exports.ros_bags import import_bag, is_bag
from deltalight.services.exports.scene_glb import write_scene_glb
from tests.protocol.fisheye_samples import assert_same_frames, linear
from tests.services.conftest import RunCli
from tests.services.record_samples import HEIGHT, WIDTH, frames, write

MATRIX = np.array([[60.0, 0, 30.0], [0, 61.0, 25.0], [0, 0, 1]])
LENS = CameraModel(WIDTH, HEIGHT, MATRIX, "plumb_bob", np.array([-0.1, 0.02, 0.001, 0.002, 0.0]))
POSE = rigid_matrix(rotation_from_wxyz((0.9, 0.2, -0.3, 0.1)), (0.3, -0.2, 0.5))
POINT = (POSE @ [0.2, -0.1, 1.5, 1])[:3]  # in front of the camera
PIXEL = LENS.project(np.array([[0.2, -0.1, 1.5]]))[0]
DEPTH_M = 1.25


def quietly(numbers: range) -> Iterable[int]:
    return numbers


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """Two frames, one of them without a pose, before a wall at a known distance."""
    path = tmp_path / "take.mcap"
    wall = DepthImage(
        np.full((HEIGHT, WIDTH), DEPTH_M, np.float32), np.ones((HEIGHT, WIDTH), bool), LENS, 0.001
    )
    first, second = (replace(frame, camera=LENS, depth=wall, response=None) for frame in frames(2))
    with RecordingWriter(path) as writer:
        writer.add(replace(first, world_from_camera=POSE))
        writer.add(replace(second, world_from_camera=None))
    return path


def on_wall(points: np.ndarray) -> None:
    """All points are where the camera of POSE sees its wall."""
    assert len(points) > 100
    seen = np.column_stack([points, np.ones(len(points))]) @ np.linalg.inv(POSE).T
    np.testing.assert_allclose(seen[:, 2], DEPTH_M, atol=5e-3)


def test_colmap_projects_a_point_onto_our_pixel(recording: Path, tmp_path: Path) -> None:
    copied = export_as(ExportFormat.COLMAP, recording, tmp_path / "out", None, quietly)
    assert (copied.frames, copied.notes[-1]) == (1, "Left out: 1 frame without a pose.")
    model = tmp_path / "out" / "sparse" / "0"
    _, name, width, height, *numbers = rows(model / "cameras.txt")[0]
    assert (name, width, height) == ("OPENCV", str(WIDTH), str(HEIGHT))
    fx, fy, cx, cy, k1, k2, p1, p2 = map(float, numbers)
    (image,) = rows(model / "images.txt")
    w, x, y, z, *place = map(float, image[1:8])
    assert (tmp_path / "out" / "images" / image[9]).read_bytes() == RecordingReader(recording)[0].color_jpeg
    # colmap: x_camera = R x + t; OPENCV distorts; pixels begin at the corner of the first one.
    seen = rotation_from_wxyz((w, x, y, z)) @ POINT + place
    u, v = seen[:2] / seen[2]
    r2 = u * u + v * v
    radial = 1 + k1 * r2 + k2 * r2 * r2
    u2 = u * radial + 2 * p1 * u * v + p2 * (r2 + 2 * u * u)
    v2 = v * radial + p1 * (r2 + 2 * v * v) + 2 * p2 * u * v
    np.testing.assert_allclose((fx * u2 + cx - 0.5, fy * v2 + cy - 0.5), PIXEL, atol=1e-6)
    on_wall(np.array([row[1:4] for row in rows(model / "points3D.txt")], float))


def rows(path: Path) -> list[list[str]]:
    return [line.split() for line in path.read_text().splitlines() if line and not line.startswith("#")]


def test_colmap_names_the_model_of_each_lens() -> None:
    def named(model: Any, terms: list[float]) -> list[str]:  # noqa: ANN401
        return camera_line(CameraModel(WIDTH, HEIGHT, LENS.matrix, model, np.array(terms))).split()[1::3][:1]

    assert named("plumb_bob", []) == ["PINHOLE"]
    assert named("plumb_bob", [0.1, 0, 0, 0, 0.2]) == ["FULL_OPENCV"]
    assert named("equidistant", [0.1, 0, 0, 0]) == ["OPENCV_FISHEYE"]
    with pytest.raises(DeltalightError, match=r"COLMAP has no lens model .* calibrate it with fewer"):
        named("plumb_bob", [0.1] * 12)


def test_nerfstudio_projects_a_point_onto_our_pixel(recording: Path, tmp_path: Path) -> None:
    export_as(ExportFormat.NERFSTUDIO, recording, tmp_path / "out", None, quietly)
    document = json.loads((tmp_path / "out" / "transforms.json").read_text())
    (frame,) = document["frames"]
    # OpenGL's camera: x right, y up, looking along -z.
    x, y, z = (np.linalg.inv(np.array(frame["transform_matrix"])) @ [*POINT, 1])[:3]
    terms = np.array([document[name] for name in ("k1", "k2", "p1", "p2", "k3")])
    matrix = np.array(
        [[document["fl_x"], 0, document["cx"]], [0, document["fl_y"], document["cy"]], [0, 0, 1]]
    )
    pixel, _ = cv2.projectPoints(np.array([[x, -y, -z]]), np.zeros(3), np.zeros(3), matrix, terms)
    np.testing.assert_allclose(pixel.ravel() - 0.5, PIXEL, atol=1e-6)
    depth = cv2.imread(str(tmp_path / "out" / frame["depth_file_path"]), cv2.IMREAD_UNCHANGED)
    assert depth is not None
    assert np.median(depth) == 1000 * DEPTH_M
    on_wall(np.asarray(trimesh.load(tmp_path / "out" / document["ply_file_path"]).vertices))


def test_a_scene_as_glb_has_objects_lights_camera_and_room_where_they_are(
    recording: Path, tmp_path: Path
) -> None:
    trimesh.creation.box((0.1, 0.2, 0.3)).export(tmp_path / "box.stl")
    lamp = {"type": "spot", "position_m": [1, 2, 3], "direction": [1, 0, 0], "intensity": 4, "angle_deg": 60}
    scene = {
        "objects": [{"asset": "box.stl", "pose": {"translation_m": [0.5, 0.6, 0.7]}}],
        "lights": {"manual": [{**lamp, "color_linear": [2, 1, 0]}, {"type": "ambient"}]},
    }
    (tmp_path / "scene.json").write_text(json.dumps(scene))
    out = tmp_path / "room.glb"
    copied = export_as(ExportFormat.GLB, recording, out, tmp_path / "scene.json", quietly)
    assert any("Ambient light" in note for note in copied.notes)
    tree = glb_tree(out)
    assert tree["extensionsUsed"] == ["KHR_lights_punctual"]
    (light,) = tree["extensions"]["KHR_lights_punctual"]["lights"]
    assert (light["type"], light["intensity"], light["color"]) == ("spot", 8.0, [1.0, 0.5, 0.0])
    assert light["spot"]["outerConeAngle"] == pytest.approx(np.pi / 6)
    node = next(node for node in tree["nodes"] if "extensions" in node)
    matrix = np.array(node["matrix"]).reshape(4, 4).T
    np.testing.assert_allclose(matrix[:3, 3], [1, 3, -2], atol=1e-9)  # y is up
    np.testing.assert_allclose(-matrix[:3, 2], [1, 0, 0], atol=1e-9)  # it shines along -z
    camera = next(node for node in tree["nodes"] if "camera" in node)
    eye = np.array(camera["matrix"]).reshape(4, 4).T
    x, y, z = (np.linalg.inv(eye) @ [POINT[0], POINT[2], -POINT[1], 1])[:3]
    np.testing.assert_allclose((x, -y, -z), [0.2, -0.1, 1.5], atol=1e-9)
    loaded = trimesh.load_scene(out)
    box = next(each for each in loaded.dump() if isinstance(each, trimesh.Trimesh))
    np.testing.assert_allclose(box.bounds, [[0.45, 0.55, -0.7], [0.55, 0.85, -0.5]], atol=1e-6)
    points = next(each for each in loaded.dump() if isinstance(each, trimesh.PointCloud)).vertices
    on_wall(np.column_stack([points[:, 0], -points[:, 2], points[:, 1]]))


def glb_tree(path: Path) -> dict[str, Any]:
    data = path.read_bytes()
    length = int.from_bytes(data[12:16], "little")
    return dict(json.loads(data[20 : 20 + length]))


def test_exports_say_what_is_missing(recording: Path, tmp_path: Path, cli: RunCli) -> None:
    with pytest.raises(DeltalightError, match="nothing to export"):
        write_scene_glb(tmp_path / "a.glb", parse_scene({"lights": {"mode": "fisheye"}}))
    with pytest.raises(DeltalightError, match=r"object0: .* is not a file here"):
        write_scene_glb(tmp_path / "a.glb", parse_scene({"objects": [{"asset": "/nowhere/a.stl"}]}))
    blind = tmp_path / "blind.mcap"
    with RecordingWriter(blind) as writer:
        writer.add(replace(frames(1)[0], world_from_camera=None))
    failed = cli("recordings", "export", str(blind), "--out", str(tmp_path / "o"), "--format", "colmap")
    assert (failed.returncode, "No frame has a pose" in failed.stderr) == (2, True)
    assert not (tmp_path / "o").exists()
    with pytest.raises(DeltalightError, match=r"must end in \.glb"):
        export_as(ExportFormat.GLB, recording, tmp_path / "o", None, quietly)


@pytest.fixture(params=[ExportFormat.ROS1, ExportFormat.ROS2])
def bag(request: pytest.FixtureRequest, tmp_path: Path) -> tuple[ExportFormat, Path]:
    pytest.importorskip("rosbags")
    return request.param, tmp_path / ("bag.bag" if request.param is ExportFormat.ROS1 else "bag")


def test_a_bag_in_capitals_is_one(recording: Path, tmp_path: Path) -> None:
    pytest.importorskip("rosbags")
    export_as(ExportFormat.ROS1, recording, tmp_path / "desk.bag", None, quietly)
    capitals = (tmp_path / "desk.bag").rename(tmp_path / "DESK.BAG")
    assert is_bag(capitals)
    assert import_bag(capitals, tmp_path / "after.mcap", quietly).frames == 2
    with pytest.raises(DeltalightError, match=r"DESK\.BAG is a ROS bag; make a recording"):
        open_source(capitals)


@pytest.mark.parametrize("as_jpeg", [True, False])
def test_a_bag_comes_back_equal(bag: tuple[ExportFormat, Path], tmp_path: Path, *, as_jpeg: bool) -> None:
    wanted, path = bag
    scene = parse_scene({"name": "kept"})
    made = frames(4, as_jpeg=as_jpeg, with_fisheye=True)
    if not as_jpeg:
        made = [
            replace(frame, fisheye=linear(made[index // 2].timestamp_ns)) for index, frame in enumerate(made)
        ]
    before = RecordingReader(write(tmp_path / "before.mcap", made, scene))
    assert export_as(wanted, before.path, path, None, quietly).frames == 4
    assert import_bag(path, tmp_path / "after.mcap", quietly).frames == 4
    after = RecordingReader(tmp_path / "after.mcap")
    assert (after.board, after.scene) == (before.board, before.scene)
    assert after.extrinsics.to_dict() == before.extrinsics.to_dict()
    for one, other in zip(before, after, strict=True):
        assert_same_frames(one, other)


def test_a_foreign_bag_is_read_by_its_topics(bag: tuple[ExportFormat, Path], tmp_path: Path) -> None:
    """Depth as floats from a camera of its own, padded bgr8 rows, no description."""
    from rosbags.highlevel import AnyReader

    wanted, path = bag
    (frame,) = frames(1, as_jpeg=False)
    assert frame.depth is not None
    depth = replace(frame.depth, depth_m=frame.depth.depth_m * np.float32(1.01), camera=LENS)
    source = write(tmp_path / "take.mcap", [replace(frame, depth=depth)])
    export_as(wanted, source, path, None, quietly)
    with AnyReader([path]) as reader:
        kinds = {each.topic: each.msgtype for each in reader.connections}
        assert kinds["/camera/depth/image_raw"] == "sensor_msgs/msg/Image"
        (connection,) = (each for each in reader.connections if each.topic == "/tf")
        _, _, data = next(reader.messages([connection]))
        moved = reader.deserialize(data, connection.msgtype).transforms[0].transform.translation
    assert frame.world_from_camera is not None
    np.testing.assert_allclose((moved.x, moved.y, moved.z), frame.world_from_camera[:3, 3])
    import_bag(path, tmp_path / "after.mcap", quietly)
    (read,) = RecordingReader(tmp_path / "after.mcap")
    assert read.depth is not None
    assert read.depth.camera == LENS
    np.testing.assert_array_equal(read.depth.depth_m, depth.depth_m)


def test_what_is_no_bag_is_refused(tmp_path: Path) -> None:
    pytest.importorskip("rosbags")
    broken = tmp_path / "broken.bag"
    broken.write_bytes(b"#ROSBAG V2.0\nnothing")
    with pytest.raises(DeltalightError, match="cannot be read as a ROS bag"):
        import_bag(broken, tmp_path / "a.mcap", quietly)
    assert not (tmp_path / "a.mcap").exists()
    with pytest.raises(DeltalightError, match="does not exist"):
        import_bag(tmp_path / "no.bag", tmp_path / "a.mcap", quietly)
