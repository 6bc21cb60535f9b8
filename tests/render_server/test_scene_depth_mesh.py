from pathlib import Path

import cv2
import numpy as np
import pytest

from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import DepthImage
from deltalight.protocol.messages import MAX_CAMERAS
from deltalight.render_server.scene.depth_mesh import depth_mesh, stride_for_budget
from deltalight.render_server.scene.depth_surface import depth_surface, window_radius

WIDTH, HEIGHT = 160, 120
MATRIX = np.array([[150.0, 0, 81.3], [0, 152.0, 58.9], [0, 0, 1]])
PINHOLE = CameraModel(WIDTH, HEIGHT, MATRIX)
LENS = CameraModel(WIDTH, HEIGHT, MATRIX, "plumb_bob", np.array([-0.2, 0.05, 1e-3, -1e-3, 0.0]))
NORMAL = np.array([0.3, -0.5, -0.81])
NORMAL /= np.linalg.norm(NORMAL)


def plane_depth(camera: CameraModel, normal: np.ndarray, distance: float) -> np.ndarray:
    """Depth of the plane normal.P = -distance."""
    rays = np.dstack([camera.rays(), np.ones((camera.height, camera.width))]).astype(np.float64)
    return (-distance / (rays @ normal)).astype(np.float32)


def image(depth_m: np.ndarray, camera: CameraModel = PINHOLE, sigma: float | None = 0.0005) -> DepthImage:
    return DepthImage(depth_m, depth_m > 0, camera, sigma)


def face_normals(positions: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    corners = positions[triangles].astype(float)
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


@pytest.mark.parametrize("camera", [PINHOLE, LENS])
@pytest.mark.parametrize("budget", [300, 2_000, 9_000, 100_000])
def test_a_plane_stays_a_plane_in_the_world(camera: CameraModel, budget: int) -> None:
    depth = image(plane_depth(camera, NORMAL, 0.9), camera)
    world_from_camera = np.eye(4)
    world_from_camera[:3, :3] = cv2.Rodrigues(np.array([0.3, -1.0, 0.7]))[0]
    world_from_camera[:3, 3] = [1, 2, 3]
    mesh = depth_mesh(depth, camera, world_from_camera, budget)
    normal = world_from_camera[:3, :3] @ NORMAL
    offset = normal @ [1, 2, 3] - 0.9
    assert np.abs(mesh.positions @ normal - offset).max() < (2e-5 if camera is PINHOLE else 2e-4)
    assert (mesh.normals @ normal).min() > (1 - 1e-5 if camera is PINHOLE else 1 - 1e-3)
    assert (face_normals(mesh.positions, mesh.triangles) @ normal > 0).all()
    assert len(mesh.triangles) <= budget
    stride = stride_for_budget(WIDTH, HEIGHT, budget)
    rows, columns = -(-HEIGHT // stride), -(-WIDTH // stride)
    assert len(mesh.triangles) == 2 * (rows - 1) * (columns - 1)


def test_rays_of_all_cameras_of_a_room_are_found_once(monkeypatch: pytest.MonkeyPatch) -> None:
    lenses = [
        CameraModel(WIDTH, HEIGHT, MATRIX, "plumb_bob", np.array([-0.1 - 0.01 * number, 0, 0, 0]))
        for number in range(MAX_CAMERAS)
    ]

    def mesh_all() -> None:
        for lens in lenses:
            for budget in (2_000, 300):
                depth_mesh(image(plane_depth(lens, NORMAL, 0.9), lens), lens, np.eye(4), budget)

    def again(*_: object) -> None:
        pytest.fail("a lens is inverted again")

    mesh_all()
    monkeypatch.setattr(CameraModel, "unproject", again)
    mesh_all()


def test_stride_is_the_least_that_keeps_to_the_budget() -> None:
    assert stride_for_budget(640, 480, 40_000) == 4
    assert stride_for_budget(640, 480, 400_000) == 2
    assert stride_for_budget(640, 480, 1_000_000) == 1


@pytest.mark.parametrize("camera", [PINHOLE, LENS])
def test_uv_is_the_pixel_of_each_vertex(camera: CameraModel) -> None:
    mesh = depth_mesh(image(plane_depth(camera, NORMAL, 0.9), camera), camera, np.eye(4), 3000)
    assert mesh.uv is not None
    assert np.abs(camera.project(mesh.positions.astype(float)) - mesh.uv).max() < 0.02


def step_scene() -> np.ndarray:
    depth = plane_depth(PINHOLE, np.array([0, 0, -1.0]), 1.2)
    depth[30:90, 50:110] = 0.8
    return depth


def test_no_triangle_crosses_a_step_and_both_sides_keep_their_normals() -> None:
    depth = image(step_scene())
    mesh = depth_mesh(depth, PINHOLE, np.eye(4), 5000)
    z = mesh.positions[mesh.triangles][..., 2]
    assert np.ptp(z, axis=1).max() < 1e-4
    np.testing.assert_allclose(np.unique(z.round(3)), [0.8, 1.2], atol=1e-6)
    np.testing.assert_allclose(mesh.normals, np.tile([0, 0, -1], (len(mesh.normals), 1)), atol=1e-4)
    normals = depth_surface(depth, PINHOLE).normals
    np.testing.assert_allclose(normals[..., 2], -1, atol=1e-4)


def test_holes_stay_holes() -> None:
    metres = plane_depth(PINHOLE, np.array([0, 0, -1.0]), 1.0)
    metres[40:80, 60:100] = 0
    depth = image(metres)
    mesh = depth_mesh(depth, PINHOLE, np.eye(4), 100_000)
    assert mesh.uv is not None
    inside = (mesh.uv > [59.5, 39.5]).all(axis=1) & (mesh.uv < [99.5, 79.5]).all(axis=1)
    assert not inside.any()
    assert np.isfinite(mesh.positions).all()
    surface = depth_surface(depth, PINHOLE)
    assert not surface.normals[40:80, 60:100].any()
    outside = np.ones((HEIGHT, WIDTH), bool)
    outside[40:80, 60:100] = False
    np.testing.assert_allclose(surface.normals[outside][:, 2], -1, atol=1e-4)


def test_single_bad_pixels_move_no_vertex() -> None:
    metres = plane_depth(PINHOLE, np.array([0, 0, -1.0]), 1.0)
    rng = np.random.default_rng(5)
    metres[rng.random(metres.shape) < 0.05] = 0
    spikes = rng.random(metres.shape) < 0.02
    metres[spikes] = 0.6
    mesh = depth_mesh(image(metres), PINHOLE, np.eye(4), 2500)
    assert np.abs(mesh.positions[:, 2] - 1).max() < 1e-3


def test_sphere_has_radial_normals_in_spite_of_noise() -> None:
    rays = np.dstack([PINHOLE.rays(), np.ones((HEIGHT, WIDTH))]).astype(np.float64)
    centre, radius = np.array([0, 0, 1.0]), 0.4
    a, b = (rays**2).sum(axis=2), rays @ centre
    inside = b**2 - a * (centre @ centre - radius**2)
    z = np.where(inside > 0, (b - np.sqrt(np.maximum(inside, 0))) / a, 0)
    sigma = 0.001
    noisy = np.where(z > 0, z + sigma * z**2 * np.random.default_rng(2).normal(size=z.shape), 0)
    normals = depth_surface(image(noisy.astype(np.float32), sigma=sigma), PINHOLE).normals
    radial = (rays * z[..., None] - centre) / radius
    facing = (z > 0) & ((radial * rays).sum(axis=2) / np.sqrt(a) < -0.5)
    angles = np.degrees(np.arccos(np.clip((normals * radial).sum(axis=2)[facing], -1, 1)))
    assert np.median(angles) < 3
    assert np.percentile(angles, 95) < 8


def test_images_without_depth_give_empty_meshes() -> None:
    mesh = depth_mesh(image(np.zeros((HEIGHT, WIDTH), np.float32)), PINHOLE, np.eye(4))
    assert mesh.triangles.shape == (0, 3)
    assert mesh.positions.shape == (0, 3)


def test_what_cannot_be_meshed_is_said() -> None:
    depth = image(step_scene())
    with pytest.raises(DeltalightError, match="budget"):
        depth_mesh(depth, PINHOLE, np.eye(4), 1)
    with pytest.raises(DeltalightError, match="differ in size"):
        depth_mesh(depth, CameraModel(80, 60, MATRIX), np.eye(4))


@pytest.mark.data
def test_real_depth_keeps_the_table_flat(shared_data: Path) -> None:
    """The table's plane in board coordinates is given with the data; the pose is that of its first frame."""
    folder = shared_data / "rgbd/visp_rbt_apriltag"
    matrix = np.array([[607.178, 0, 321.391], [0, 607.234, 241.918], [0, 0, 1]])
    camera = CameraModel(640, 480, matrix)
    picture = cv2.imread(str(min((folder / "depth").glob("*.png"))), cv2.IMREAD_UNCHANGED)
    assert picture is not None
    depth = DepthImage(picture.astype(np.float32) * 1e-3, picture > 0, camera)
    mesh = depth_mesh(depth, camera, np.eye(4), 40_000)
    assert 25_000 < len(mesh.triangles) <= 40_000
    assert mesh.uv is not None
    table = (mesh.uv[:, 1] > 400) & (mesh.uv[:, 0] > 280) & (mesh.uv[:, 0] < 500)
    points = mesh.positions[table].astype(float)
    _, _, axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)
    assert np.degrees(np.arccos(np.clip(np.abs(mesh.normals[table] @ axes[2]), 0, 1))).mean() < 10


def masked(pattern: str) -> np.ndarray:
    """Pixels that are valid in a picture large enough for many boxes of windows with gaps."""
    valid = np.ones((240, 320), bool)
    rng = np.random.default_rng(4)
    if pattern == "holes":
        valid[100:140, 60:100] = valid[:30, 200:] = False
    elif pattern == "speckles":
        valid[rng.random(valid.shape) < 0.02] = False
    elif pattern == "rest":
        valid[:, 9:] = False
    return valid


@pytest.mark.parametrize("pattern", ["whole", "holes", "speckles", "rest"])
def test_slopes_are_those_of_least_squares_over_the_valid_pixels_of_each_window(pattern: str) -> None:
    camera = CameraModel(320, 240, np.array([[300.0, 0, 160], [0, 310.0, 120], [0, 0, 1]]))
    valid, rng = masked(pattern), np.random.default_rng(3)
    inverse = 1 / (1.0 + 0.002 * rng.normal(size=valid.shape)).astype(np.float32)
    depth = DepthImage(1 / inverse, valid, camera, 0.002)
    radius = window_radius(depth, camera)
    surface = depth_surface(depth, camera)
    u, v = np.meshgrid(np.arange(320.0), np.arange(240.0))
    places = [
        (0, 0),
        (0, 3),
        (120, 0),
        (239, 319),
        (1, 318),
        (120, 160),
        *rng.integers(0, (240, 320), (300, 2)),
    ]
    known = 0
    for row, column in places:
        window = np.s_[max(row - radius, 0) : row + radius + 1, max(column - radius, 0) : column + radius + 1]
        used = surface.inverse_depth[window] > 0
        terms = np.stack([u[window][used] - column, v[window][used] - row, np.ones(used.sum())], axis=1)
        found = surface.gradient[:, row, column]
        if not np.isfinite(found).all():
            few = used.sum() <= (radius + 1) ** 2
            assert few or not surface.inverse_depth[row, column], (row, column)
            continue
        known += 1
        expected, *_ = np.linalg.lstsq(
            terms, surface.inverse_depth[window][used].astype(np.float64), rcond=None
        )
        np.testing.assert_allclose(found, expected[:2] * (300, 310), atol=2e-4)
    assert known > (5 if pattern == "rest" else 200)
