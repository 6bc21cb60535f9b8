"""Triangles that the GPU makes of depth are those of `depth_mesh`, and the points that bound them do."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from jaxtyping import Float32

from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import DepthImage
from deltalight.protocol.scene_objects import RealScene
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.passes.depth_mesh import DepthFrame, DepthMesher
from deltalight.render_server.passes.mesh_buffers import MeshBuffers
from deltalight.render_server.real_geometry import EMPTY_MESH, RealGeometry
from deltalight.render_server.scene.depth_mesh import BOUND_POINTS, bound_points, depth_mesh
from deltalight.render_server.scene.gpu_mesh import merge_for_gpu
from deltalight.render_server.view import CameraView
from tests.render_server.test_real_surface import room, shown_normals
from tests.render_server.test_scene_depth_mesh import LENS, NORMAL, PINHOLE, image, plane_depth
from tests.render_server.test_scene_threads import floor_from
from tests.render_server.voxel_lab import solid_buffer

WORLD_FROM_CAMERA = np.array([[0, 0, 1.0, 0.3], [-1, 0, 0, 0.2], [0, -1, 0, 0.1], [0, 0, 0, 1]])
SHAPE = PINHOLE.height, PINHOLE.width
NO_GRAZING = np.zeros(SHAPE, np.float32)


def no_grazing() -> Float32[np.ndarray, "h w"]:
    return NO_GRAZING


def take(
    mesher: DepthMesher,
    depth: DepthImage,
    budget: int = 8_000,
    grazing: Callable[[], Float32[np.ndarray, "h w"]] = no_grazing,
) -> None:
    view = CameraView(depth.camera, WORLD_FROM_CAMERA)
    mesher.take([DepthFrame(depth, view, grazing)], (budget, budget // 8))


@pytest.fixture(scope="module")
def mesher(gpu: GpuContext) -> Iterator[DepthMesher]:
    mesher = DepthMesher(gpu)
    yield mesher
    mesher.release()


def made_by_gpu(
    gpu: GpuContext, mesher: DepthMesher, budget: int
) -> tuple[Float32[np.ndarray, "n 12"], np.ndarray]:
    """Vertices, and triangles that are there."""
    buffers = MeshBuffers(gpu)
    mesher.fill(buffers, merge_for_gpu([EMPTY_MESH]))
    assert buffers.triangle_count <= budget
    vertices, indices = (solid_buffer(buffers, name).read() for name in ("Vertices", "Indices"))
    buffers.release()
    triangles = np.frombuffer(indices, np.int32).reshape(-1, 3)[: buffers.triangle_count]
    return np.frombuffer(vertices, np.float32).reshape(-1, 12), triangles[triangles[:, 0] != triangles[:, 1]]


def by_corners(uv: np.ndarray, triangles: np.ndarray) -> dict[tuple[float, ...], np.ndarray]:
    """Triangles by the pixels of their corners, from the first one on."""
    found = {}
    for triangle in triangles:
        start = int(np.lexsort(uv[triangle].T)[0])
        turned = np.roll(triangle, -start)
        found[tuple(uv[turned].ravel().tolist())] = turned
    return found


def with_grazing(depth: DepthImage) -> Float32[np.ndarray, "h w"]:
    """A hole is bridged from left to right, two pixels of it from nothing."""
    grazing = NO_GRAZING.copy()
    grazing[20:30, 100:130] = np.linspace(1.2, 2.2, 30, dtype=np.float32)
    grazing[depth.depth_m > 0] = 0
    grazing[2, 2] = 1.0
    return grazing


@pytest.mark.parametrize("camera", [PINHOLE, LENS], ids=["pinhole", "lens"])
@pytest.mark.parametrize("budget", [100_000, 8_000, 700], ids=["every pixel", "stride 3", "stride 9"])
@pytest.mark.parametrize("is_bridged", [False, True], ids=["holes", "grazing"])
def test_the_gpu_makes_the_same_triangles(
    gpu: GpuContext, mesher: DepthMesher, camera: CameraModel, budget: int, *, is_bridged: bool
) -> None:
    depth = room(camera, 0.002)
    grazing = with_grazing(depth) if is_bridged else NO_GRAZING
    wanted = depth_mesh(depth, camera, WORLD_FROM_CAMERA, budget, grazing=lambda: grazing)
    assert wanted.uv is not None
    take(mesher, depth, budget, lambda: grazing)
    vertices, triangles = made_by_gpu(gpu, mesher, budget)
    theirs, ours = by_corners(wanted.uv, wanted.triangles), by_corners(vertices[:, 6:8], triangles)
    common = theirs.keys() & ours.keys()
    # Where a test is decided by the last bit, numpy and the GPU may choose another window or pixel.
    assert len(theirs.keys() ^ ours.keys()) <= 0.01 * len(theirs)
    one, other = (np.concatenate([each[key] for key in common]) for each in (theirs, ours))
    apart = np.linalg.norm(wanted.positions[one] - vertices[other, :3], axis=1)
    turned = np.degrees(2 * np.arcsin(np.linalg.norm(wanted.normals[one] - vertices[other, 3:6], axis=1) / 2))
    assert np.mean(apart > 1e-4) < 0.01
    assert np.median(apart) < 1e-6
    assert np.mean(turned > 0.2) < 0.01
    assert (vertices[other, 8:] == [1, 1, 1, 0]).all()


def test_grazing_surfaces_close_a_hole(gpu: GpuContext, mesher: DepthMesher) -> None:
    depth = room(PINHOLE, 0.0005)
    counts = []
    for grazing in (no_grazing, partial(with_grazing, depth), no_grazing):
        take(mesher, depth, 8_000, grazing)
        counts.append(len(made_by_gpu(gpu, mesher, 8_000)[1]))
    assert counts[1] > counts[0] + 30
    assert counts[2] == counts[0]


def test_another_camera_gets_its_own_grid(gpu: GpuContext, mesher: DepthMesher) -> None:
    small = CameraModel(80, 60, PINHOLE.matrix * np.array([[0.5], [0.5], [1]]))
    take(mesher, room(PINHOLE, 0.002), 700)
    made_by_gpu(gpu, mesher, 700)
    take(mesher, image(plane_depth(small, NORMAL, 0.9), small), 700, lambda: np.zeros((60, 80), np.float32))
    vertices, triangles = made_by_gpu(gpu, mesher, 700)
    assert len(triangles) > 500
    assert vertices[triangles, 6].max() < small.width


def test_only_the_image_that_was_taken_last_is_fitted(mesher: DepthMesher) -> None:
    first, second = room(PINHOLE, 0.002), room(PINHOLE, 0.002)
    take(mesher, first)
    assert mesher.fitted(first) is not None
    assert mesher.fitted(second) is None
    take(mesher, second)
    assert mesher.fitted(first) is None
    assert mesher.fitted(replace(second, camera=LENS)) is None


def test_what_the_mesher_fitted_serves_the_visible_surface(gpu: GpuContext, mesher: DepthMesher) -> None:
    depth = room(PINHOLE, 0.002)
    take(mesher, depth)
    own, shared = (
        shown_normals(gpu, depth, pytest.fail, fits_depth=True, on_gpu=found)
        for found in (None, mesher.fitted(depth))
    )
    assert np.array_equal(own, shared)


def test_an_image_of_another_size_is_refused() -> None:
    view = CameraView(CameraModel(80, 60, PINHOLE.matrix), WORLD_FROM_CAMERA)
    with pytest.raises(DeltalightError, match="differ in size"):
        DepthFrame(room(PINHOLE, 0.002), view, no_grazing)


@pytest.mark.parametrize("camera", [PINHOLE, LENS], ids=["pinhole", "lens"])
def test_points_enclose_what_depth_shows_without_its_outliers(camera: CameraModel) -> None:
    depth = room(camera, 0.0005)
    points = bound_points(depth, camera, WORLD_FROM_CAMERA)
    assert len(points) <= BOUND_POINTS
    shown = depth_mesh(depth, camera, WORLD_FROM_CAMERA, 8_000).positions
    for pick, sign in ((np.min, 1), (np.max, -1)):
        beyond = sign * (pick(shown, axis=0) - pick(points, axis=0))
        assert (beyond > -1e-3).all()
        assert (beyond < 0.05).all()


@pytest.mark.parametrize("metres", [1.0, 0.7, 1.5, 3.001])
def test_all_of_a_wall_at_one_depth_is_shown(metres: float) -> None:
    points = bound_points(image(np.full(SHAPE, metres, np.float32)), PINHOLE, WORLD_FROM_CAMERA)
    assert len(points) > BOUND_POINTS // 2


def test_nothing_known_has_no_points() -> None:
    assert not len(bound_points(image(np.zeros(SHAPE, np.float32)), PINHOLE, WORLD_FROM_CAMERA))


def test_a_room_meshed_by_the_gpu_tells_the_same_triangles_to_the_cpu(gpu: GpuContext) -> None:
    """Which makes them only when asked; and depth in which nothing is known leaves no room."""
    by_gpu, by_numpy = (RealGeometry(gpu, RealScene(), 8_000, meshes_on_gpu=on) for on in (True, False))
    seen = floor_from(0.25)
    assert seen.frame.depth is not None
    lost = replace(seen.frame.depth, depth_m=np.zeros_like(seen.frame.depth.depth_m))
    by_gpu.update([replace(seen, frame=replace(seen.frame, depth=lost))])
    assert by_gpu.state is None
    for real in (by_gpu, by_numpy):
        assert real.update([seen])
    assert by_gpu.state is not None
    assert by_numpy.state is not None
    assert np.array_equal(by_gpu.state.corners, by_numpy.state.corners)
    assert 0 < len(by_gpu.state.coarse_mesh.triangles) < by_gpu.state.buffers.triangle_count / 4
    assert np.array_equal(by_gpu.state.coarse_mesh.corners, by_numpy.state.coarse_mesh.corners)
    for real in (by_gpu, by_numpy):
        real.release()
