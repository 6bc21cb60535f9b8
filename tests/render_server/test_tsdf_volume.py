"""The fused surface: true, smoother than one frame, free of what went away, where the board's pose errs as well."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.frames import DepthImage
from deltalight.render_server.scene.depth_surface import DepthSurface, depth_surface
from deltalight.render_server.scene.depth_views import PosedSurface
from deltalight.render_server.scene.triangle_mesh import TriangleMesh
from deltalight.render_server.scene.tsdf_mesh import TsdfScene, decimated, extract_mesh
from deltalight.render_server.scene.tsdf_volume import aligned_view, interpolate
from deltalight.render_server.view import CameraView

MATRIX = np.array([[150.0, 0, 79.5], [0, 150.0, 59.5], [0, 0, 1]])
PINHOLE = CameraModel(160, 120, MATRIX)
LENS = CameraModel(160, 120, MATRIX, "plumb_bob", np.array([-0.2, 0.05, 1e-3, -1e-3, 0.0]))
SIGMA = 0.001
# Least and greatest corners: a floor whose top is z = 0, a wall whose front is y = 0.4, a box on the floor.
FLOOR, WALL = ((-9, -9, -1), (9, 9, 0)), ((-9, 0.4, -1), (9, 1, 9))
BOX = ((-0.1, -0.1, 0), (0.1, 0.05, 0.15))
ROOM = (FLOOR, WALL)
Box = tuple[tuple[float, float, float], tuple[float, float, float]]


def view(eye: tuple[float, float, float] = (0.1, -0.7, 0.5), camera: CameraModel = PINHOLE) -> CameraView:
    """Looks at a point above the world's origin; the picture's upper edge is up."""
    forward = np.subtract((0, 0, 0.06), eye)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, (0, 0, 1))
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(forward, right), forward, eye], axis=1)
    return CameraView(camera, pose)


def seen(boxes: tuple[Box, ...], at: CameraView, noise: float = 0.0, seed: int = 0) -> DepthSurface:
    """The surface that a depth camera sees of boxes, with noise of `noise` m at 1 m."""
    rays = np.dstack([at.camera.rays(), np.ones(at.camera.rays().shape[:2])]).astype(np.float64)
    along = rays @ at.world_from_camera[:3, :3].T
    depth = np.full(along.shape[:2], np.inf)
    for low, high in boxes:
        with np.errstate(divide="ignore", invalid="ignore"):
            hits = np.sort([(np.array(end) - at.position) / along for end in (low, high)], axis=0)
        enter, leave = hits[0].max(axis=-1), hits[1].min(axis=-1)
        depth = np.where((enter < leave) & (enter > 0), np.minimum(depth, enter), depth)
    depth += noise * depth**2 * np.random.default_rng(seed).standard_normal(depth.shape)
    known = np.isfinite(depth)
    image = DepthImage(np.where(known, depth, 0).astype(np.float32), known, at.camera, max(noise, SIGMA))
    return depth_surface(image, at.camera)


def fused(boxes: tuple[Box, ...], views: list[CameraView], noise: float = 0.0) -> TsdfScene:
    scene = TsdfScene()
    for number, at in enumerate(views):
        scene.add(PosedSurface(seen(boxes, at, noise, number), at, max(noise, SIGMA)), settle=True)
    return scene


def near_mesh(scene: TsdfScene) -> TriangleMesh:
    return extract_mesh(scene.volumes[0])


def inside(mesh: TriangleMesh, box: Box, margin: float) -> np.ndarray:
    low, high = np.array(box[0]) + margin, np.array(box[1]) - margin
    return np.asarray(((mesh.positions > low) & (mesh.positions < high)).all(axis=1))


def facing(mesh: TriangleMesh) -> np.ndarray:
    """Cosine between each triangle's own normal and that of its first vertex."""
    corners = mesh.positions[mesh.triangles].astype(float)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-20)
    return np.asarray((normals * mesh.normals[mesh.triangles[:, 0]]).sum(axis=1))


@pytest.mark.parametrize("camera", [PINHOLE, LENS])
def test_a_floor_and_a_wall_lie_where_they_are(camera: CameraModel) -> None:
    scene = fused(ROOM, [view(camera=camera)])
    mesh = near_mesh(scene)
    _, y, z = mesh.positions.T
    # Where both meet, voxels cut the corner.
    reach = 4 * scene.voxel_m
    flat, upright = y < 0.4 - reach, z > reach
    assert min(flat.sum(), upright.sum()) > 1000
    assert (flat | upright).mean() > 0.9
    for error in (z[flat], y[upright] - 0.4):
        assert np.median(np.abs(error)) < 3e-4
        assert np.abs(error).max() < 0.5 * scene.voxel_m
    assert (facing(mesh) > 0).mean() > 0.999


def test_a_floor_has_no_holes() -> None:
    scene = fused((FLOOR,), [view((0, -0.3, 0.6))])
    mesh = near_mesh(scene)
    area = 0.5 * np.linalg.norm(
        np.cross(
            *(mesh.positions[mesh.triangles[:, k]] - mesh.positions[mesh.triangles[:, 0]] for k in (1, 2))
        ),
        axis=1,
    )
    within = (np.abs(mesh.positions[mesh.triangles, :2]) < 0.15).all(axis=(1, 2))
    voxel = scene.voxel_m
    assert area[within].sum() == pytest.approx(0.3 * 0.3, abs=4 * 0.3 * 2 * voxel)


def test_many_frames_are_smoother_than_one() -> None:
    def roughness(frames: int) -> float:
        mesh = near_mesh(fused(ROOM, [view()] * frames, noise=0.003))
        on_floor = (np.abs(mesh.positions[:, 2]) < 0.02) & (np.abs(mesh.positions[:, 1]) < 0.2)
        return float(mesh.positions[on_floor, 2].std())

    assert roughness(12) < 0.5 * roughness(1)


def test_what_went_away_is_carved_and_what_came_is_there() -> None:
    views = [view((0.1 + 0.01 * k, -0.7, 0.5)) for k in range(6)]
    scene = fused((*ROOM, BOX), views)
    shell = ((-0.12, -0.12, 0.02), (0.12, 0.07, 0.17))
    with_box = inside(near_mesh(scene), shell, 0).sum()
    assert with_box > 500
    for number, at in enumerate(views[:4]):
        scene.add(PosedSurface(seen(ROOM, at, 0, number), at, SIGMA), settle=True)
    # Only what lies beyond the floor's visible part may keep a trace of it.
    assert inside(near_mesh(scene), shell, 0).sum() < 0.02 * with_box
    for number, at in enumerate(views[:4]):
        scene.add(PosedSurface(seen((*ROOM, BOX), at, 0, number), at, SIGMA), settle=True)
    assert inside(near_mesh(scene), shell, 0).sum() > 0.9 * with_box


def test_the_same_frames_give_the_same_triangles() -> None:
    first, second = (near_mesh(fused((*ROOM, BOX), [view(), view((0.2, -0.6, 0.5))])) for _ in range(2))
    np.testing.assert_array_equal(first.positions, second.positions)
    np.testing.assert_array_equal(first.triangles, second.triangles)


def test_a_budget_is_kept_and_the_shape_with_it() -> None:
    scene = fused(ROOM, [view()])
    mesh = near_mesh(scene)
    few = decimated(mesh, 1500)
    assert 500 < len(few.triangles) <= 1500
    flat = few.normals[:, 2] > 0.99
    assert np.abs(few.positions[flat, 2]).max() < 0.003
    assert np.abs(few.bounds() - mesh.bounds()).max() < 0.1
    assert [sum(len(part.triangles) for part in parts) <= 800 for parts in scene.meshes(800, 800)] == [
        True,
        True,
    ]
    assert decimated(mesh, 10**6) is mesh


def test_a_far_wall_goes_to_the_coarse_volume_and_joins_the_near_one() -> None:
    far_wall = ((-9, 4, -1), (9, 5, 9))
    scene = fused((FLOOR, far_wall), [view((0, -0.8, 0.35))])
    near, far = (volume.placement for volume in scene.volumes)
    (meshes,) = scene.meshes(10**6)
    assert far.voxel_m > 3 * near.voxel_m
    assert len(meshes[1].triangles) > 500
    on_wall = meshes[1].normals[:, 1] < -0.9
    assert np.abs(meshes[1].positions[on_wall, 1] - 4).max() < 0.02
    # No triangle twice: those of the far volume reach into the near one by a voxel at most.
    corners = meshes[1].positions[meshes[1].triangles]
    low, high = near.box
    assert not ((corners > low) & (corners < high)).all(axis=(1, 2)).any()


def test_a_still_scene_settles() -> None:
    scene, at = TsdfScene(), view()
    renewed = [scene.add(PosedSurface(seen(ROOM, at), at, SIGMA)) for _ in range(4)]
    assert renewed == [True, False, False, False]


@pytest.mark.parametrize("boxes", [(*ROOM, BOX), (FLOOR,)], ids=["corner", "bare floor"])
def test_a_pose_that_errs_is_corrected_by_what_the_shape_tells(boxes: tuple[Box, ...]) -> None:
    truth = view((0.5, -0.6, 0.5))
    scene = fused(boxes, [truth])
    wrong = truth.world_from_camera.copy()
    wrong[:3, :3] = cv2.Rodrigues(np.radians([0.3, -0.2, 0.4]))[0] @ wrong[:3, :3]
    wrong[:3, 3] += [0.004, -0.003, 0.005]
    at = CameraView(PINHOLE, wrong)
    found = aligned_view(scene.volumes, seen(boxes, truth), at, SIGMA)
    surface = seen(boxes, truth)
    z = 1 / surface.inverse_depth[surface.inverse_depth > 0]
    rays = np.column_stack([PINHOLE.rays()[surface.inverse_depth > 0], np.ones(len(z))]) * z[:, None]
    places, true = (rays @ each.world_from_camera[:3, :3].T + each.position for each in (found, truth))
    if len(boxes) == 1:  # a floor tells height and tilt only
        assert np.abs(places[:, 2]).max() < 0.001
        assert np.linalg.norm((found.position - at.position)[:2]) < 0.004
    else:
        assert np.linalg.norm(places - true, axis=1).mean() < 0.0015


def test_without_anything_known_a_pose_stays() -> None:
    at = view()
    first = TsdfScene()
    assert first.add(PosedSurface(seen(ROOM, at), at, SIGMA, aligns=True))
    assert first.view is at
    scene = TsdfScene()
    nothing = DepthSurface(
        np.zeros((120, 160), np.float32),
        np.zeros((2, 120, 160), np.float32),
        np.zeros((120, 160), np.float32),
        at.camera,
    )
    assert not scene.add(PosedSurface(nothing, at, SIGMA))
    assert scene.meshes(1000) == [[]]


@pytest.mark.data
def test_a_real_room_is_where_the_frame_left_out_sees_it(shared_data: Path) -> None:
    """Four of five frames fused, with the noise of a structured-light camera; the fifth is judged by the field."""
    folder = shared_data / "rgbd" / "open3d_redwood_livingroom" / "RGBD"
    lines = (folder / "trajectory.log").read_text().splitlines()
    camera = CameraModel(640, 480, np.array([[525.0, 0, 319.5], [0, 525.0, 239.5], [0, 0, 1]]))
    scene, noise = TsdfScene(), 0.0023
    for number in (0, 1, 3, 4, 2):
        pose = np.array([[float(v) for v in row.split()] for row in lines[5 * number + 1 : 5 * number + 5]])
        coded = cv2.imread(str(folder / "depth" / f"{number:05}.png"), cv2.IMREAD_UNCHANGED)
        depth = np.asarray(coded, np.float32) / np.float32(1000)
        at, surface = (
            CameraView(camera, pose),
            depth_surface(DepthImage(depth, depth > 0, camera, noise), camera),
        )
        if number != 2:
            scene.add(PosedSurface(surface, at, noise))
    rays = np.dstack([camera.rays(), np.ones((480, 640))])[::4, ::4].reshape(-1, 3)
    z = depth[::4, ::4].reshape(-1, 1)
    found, distance, _ = interpolate(scene.volumes[0], (rays * z @ pose[:3, :3].T + pose[:3, 3])[z[:, 0] > 0])
    assert len(found) > 0.9 * np.count_nonzero(z)
    assert np.abs(np.median(distance)) < 0.001
    assert (np.abs(distance) < 3 * noise * z[z[:, 0] > 0][found, 0] ** 2).mean() > 0.97
