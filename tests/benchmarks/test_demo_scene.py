"""The demo: printed board against BoardSpec, sensor models, and the files that the project ships."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

from deltalight.benchmarks.ground_truth import scene_demo
from deltalight.benchmarks.ground_truth.board_texture import INK_ALBEDO, board_texture
from deltalight.benchmarks.ground_truth.demo_object import BASE_COLOR, ROUGHNESS, object_mesh, write_glb
from deltalight.benchmarks.ground_truth.sensors import ColorSensor, StereoDepthSensor, srgb_bytes
from deltalight.benchmarks.make_demo import facts_by_digest
from deltalight.protocol.board import BoardSpec
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import SensorFrame, decode_lut
from deltalight.protocol.recording_reader import RecordingReader
from deltalight.protocol.scene import load_scene
from deltalight.sensor_node.markers import BoardDetector

ASSETS = Path(__file__).parents[2] / "services" / "demo_assets"
RECORDING = ASSETS / "demo.mcap"
MAX_RECORDING_BYTES = 5_000_000
SHOWN_FRAMES = (0, 9, 14, 20, 29)


@pytest.fixture(scope="module")
def recording() -> RecordingReader:
    return RecordingReader(RECORDING)


@pytest.mark.parametrize(
    "board",
    [
        scene_demo.BOARD,
        BoardSpec(
            type="apriltag_grid",
            dictionary="DICT_APRILTAG_36h11",
            marker_length_m=0.05,
            separation_m=0.0125,
            rows=2,
            columns=3,
            first_id=7,
        ),
    ],
    ids=["aruco", "apriltag"],
)
def test_printed_markers_lie_where_the_board_says(board: BoardSpec) -> None:
    sheet = board_texture(board)
    picture = np.rint(255 * sheet.albedo).astype(np.uint8)
    detector = cv2.aruco.ArucoDetector(board.opencv_dictionary())
    quads, ids, _ = detector.detectMarkers(picture)
    assert sorted(ids.ravel()) == sorted(board.marker_ids)
    texels_per_m = sheet.albedo.shape[1] / (sheet.max_m - sheet.min_m)[0]
    for quad, marker_id in zip(quads, ids.ravel(), strict=True):
        x_m, y_m = board.corner_points()[int(marker_id)][:, :2].T
        # Texel centres are at integers, so the sheet's corner is at -0.5.
        expected = np.stack([x_m - sheet.min_m[0], sheet.max_m[1] - y_m], axis=1) * texels_per_m - 0.5
        assert np.abs(quad.reshape(4, 2) - expected).max() < 1.0


def test_printed_sheet_has_ink_paper_and_margin() -> None:
    sheet = board_texture(scene_demo.BOARD)
    assert set(np.unique(sheet.albedo)) == {np.float32(INK_ALBEDO), np.float32(0.8)}
    assert sheet.min_m == pytest.approx([-0.02, -0.16])
    assert sheet.max_m == pytest.approx([0.21, 0.02])
    assert sheet.albedo[:60].min() == np.float32(0.8)


def test_sheet_refuses_charuco() -> None:
    board = scene_demo.BOARD.model_copy(update={"type": "charuco"})
    with pytest.raises(DeltalightError, match="aruco_grid"):
        board_texture(board)


def test_camera_swings_out_and_back() -> None:
    poses = [scene_demo.world_from_camera(frame) for frame in range(scene_demo.FRAME_COUNT)]
    still, moving = poses[: scene_demo.STILL_FRAMES], poses[scene_demo.STILL_FRAMES :]
    assert all(np.array_equal(pose, still[0]) for pose in still)
    assert all(np.allclose(out, back) for out, back in zip(moving, reversed(moving), strict=True))
    turn = still[0][:3, :3].T @ moving[len(moving) // 2][:3, :3]
    angle_deg = np.degrees(np.arccos((np.trace(turn) - 1) / 2))
    assert 0.8 * scene_demo.SWING_DEG < angle_deg <= scene_demo.SWING_DEG
    assert all(np.linalg.det(pose[:3, :3]) == pytest.approx(1) for pose in poses)


def test_srgb_bytes_invert_the_decoding_table() -> None:
    codes = np.repeat(np.arange(256, dtype=np.uint8)[:, None, None], 3, axis=2)
    linear = decode_lut(None)[codes, np.arange(3)]
    assert np.array_equal(srgb_bytes(linear), codes)


def test_color_noise_grows_with_light_and_repeats_by_seed() -> None:
    sensor = ColorSensor(shot_noise=4e-4, read_noise=0.002)
    dark, bright = (np.full((200, 200, 3), value, np.float32) for value in (0.05, 0.6))
    lut = decode_lut(None)
    sigma = [lut[sensor.expose(flat, np.random.default_rng(1))][..., 0].std() for flat in (dark, bright)]
    assert sigma[0] == pytest.approx(np.sqrt(4e-4 * 0.05 + 0.002**2), rel=0.1)
    assert sigma[1] == pytest.approx(np.sqrt(4e-4 * 0.6 + 0.002**2), rel=0.1)
    first, second = (sensor.expose(bright, np.random.default_rng(5)) for _ in range(2))
    assert np.array_equal(first, second)


def test_depth_noise_grows_with_distance_squared() -> None:
    sensor = StereoDepthSensor(failure_fraction=0.001, step_m=0.0001)
    for distance_m in (0.5, 1.0, 2.0):
        flat = np.full((240, 320), distance_m, np.float32)
        steps = sensor.measure(flat, np.random.default_rng(2))
        error = steps[steps > 0] * sensor.step_m - distance_m
        assert error.std() == pytest.approx(sensor.sigma_at_1m * distance_m**2, rel=0.1)


def test_depth_has_an_occlusion_shadow_left_of_near_things() -> None:
    sensor = StereoDepthSensor(failure_fraction=0.0001)
    depth_m = np.full((120, 200), 1.0, np.float32)
    depth_m[30:90, 80:140] = 0.5
    unknown = sensor.measure(depth_m, np.random.default_rng(3))[60] == 0
    shift = sensor.focal_px * sensor.baseline_m * (1 / 0.5 - 1 / 1.0)
    assert np.count_nonzero(unknown[40:80]) == pytest.approx(shift, abs=2)
    assert np.count_nonzero(unknown[142:]) <= 1
    assert not unknown[90:130].any()


def test_shipped_object_is_the_one_that_is_made_here(tmp_path: Path) -> None:
    write_glb(tmp_path / "object.glb")
    made, shipped = (
        trimesh.load(folder / "object.glb", force="mesh", process=False) for folder in (tmp_path, ASSETS)
    )
    assert np.array_equal(made.faces, shipped.faces)
    assert np.allclose(made.vertices, shipped.vertices, atol=1e-6)
    assert np.allclose(made.vertex_normals, shipped.vertex_normals, atol=1e-3)
    assert np.array_equal(made.visual.material.baseColorFactor, shipped.visual.material.baseColorFactor)
    mesh = object_mesh()
    assert mesh.bounds[0, 2] == 0
    assert len(mesh.faces) < 10_000
    assert all(part.is_watertight and part.volume > 0 for part in mesh.split())


def test_shipped_facts_are_what_the_check_of_the_object_finds() -> None:
    assert json.loads((ASSETS / "facts.json").read_bytes()) == facts_by_digest(ASSETS / "object.glb")


def test_shipped_scene_is_valid_and_complete() -> None:
    scene = load_scene(ASSETS / "scene.json")
    made = scene_demo.scene_document()
    assert scene.lights.model_dump(mode="json")["manual"][0]["intensity"] == scene_demo.KEY_LIGHT.intensity
    assert [light["type"] for light in made["lights"]["manual"]] == ["sphere", "ambient"]
    assert Path(scene.objects[0].asset) == ASSETS / "object.glb"
    assert max(BASE_COLOR) / min(BASE_COLOR) > 5
    assert ROUGHNESS == 0.35


def test_shipped_recording_is_small_and_opens(recording: RecordingReader) -> None:
    assert RECORDING.stat().st_size <= MAX_RECORDING_BYTES
    assert len(recording) == scene_demo.FRAME_COUNT
    assert recording.board == scene_demo.BOARD
    assert recording.camera == scene_demo.CAMERA
    assert recording.scene is not None
    assert recording.notes == []


def test_board_is_found_in_every_frame(recording: RecordingReader) -> None:
    detector = BoardDetector(scene_demo.BOARD, scene_demo.CAMERA)
    for frame in recording:
        pose = detector.detect(frame.color)
        assert pose is not None
        assert pose.reprojection_error_px is not None
        assert pose.reprojection_error_px < 0.5
        difference = pose.world_from_camera - scene_demo.world_from_camera(frame.frame_id)
        assert np.linalg.norm(difference[:3, 3]) < 0.004


@pytest.mark.parametrize("index", SHOWN_FRAMES)
def test_depth_is_registered_to_colour(recording: RecordingReader, index: int) -> None:
    frame = recording[index]
    plane_m = _depth_of_plane(frame, scene_demo.world_from_camera(index), z_m=0.0)
    on_board = _board_mask(frame, scene_demo.world_from_camera(index))
    assert frame.depth is not None
    error = (frame.depth.depth_m - plane_m)[on_board & frame.depth.valid]
    assert error.size > 5000
    assert abs(np.median(error)) < 0.0005
    assert error.std() < 0.0015


@pytest.mark.parametrize("index", SHOWN_FRAMES)
def test_pictures_are_well_exposed(recording: RecordingReader, index: int) -> None:
    frame = recording[index]
    paper = frame.color[_board_mask(frame, scene_demo.world_from_camera(index))].max(axis=1)
    white = decode_lut(None)[:, 0][np.quantile(paper, 0.8).astype(int)]
    assert 0.6 < white < 0.95
    assert np.mean(frame.color.min(axis=2) == 255) < 0.001
    assert np.median(frame.color) > 80


def test_frames_are_a_fifteenth_second_apart(recording: RecordingReader) -> None:
    periods = np.diff(recording.timestamps_ns)
    assert np.abs(periods - 1e9 / scene_demo.FRAME_RATE_HZ).max() <= 1


def _depth_of_plane(frame: SensorFrame, world_from_camera: np.ndarray, z_m: float) -> np.ndarray:
    """Depth along the optical axis at which each pixel's ray meets the plane z = z_m of the world."""
    rays = np.concatenate([frame.camera.rays(), np.ones((*frame.color.shape[:2], 1))], axis=2)
    rise = rays @ world_from_camera[2, :3]
    return np.asarray((z_m - world_from_camera[2, 3]) / rise)


def _board_mask(frame: SensorFrame, world_from_camera: np.ndarray) -> np.ndarray:
    camera_from_world = np.linalg.inv(world_from_camera)
    outline = scene_demo.BOARD.sheet_outline() @ camera_from_world[:3, :3].T + camera_from_world[:3, 3]
    mask = np.zeros(frame.color.shape[:2], np.uint8)
    cv2.fillConvexPoly(mask, np.rint(frame.camera.project(outline)).astype(np.int32), 1)
    return mask.astype(bool)
