"""Work on all cores gives what one core gives, and the real scene is meshed coarsely only where that is asked for."""

import numpy as np
import pytest

from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.frames import DepthImage
from deltalight.protocol.scene_objects import RealScene
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.methods.light_maps import shadow_receivers
from deltalight.render_server.real_geometry import COARSE_DIVISOR, RealGeometry
from deltalight.render_server.scene import seen_depth, threads
from deltalight.render_server.scene.depth_mesh import depth_mesh
from deltalight.render_server.scene.depth_surface import depth_surface
from deltalight.render_server.scene.gpu_mesh import GpuMesh
from deltalight.render_server.scene.threads import LEAST_BAND_ROWS, by_bands
from deltalight.render_server.view import CameraView, PosedFrame
from tests.render_server.scenes import checkered, depth_image, floor_depth, frame, look_at

BUDGET = 2000


@pytest.mark.parametrize("rows", [0, 1, LEAST_BAND_ROWS, 5 * LEAST_BAND_ROWS + 3])
def test_each_row_is_in_one_band(rows: int) -> None:
    seen = np.zeros(rows, int)

    def note(band: slice) -> None:
        seen[band] += 1

    by_bands(note, rows)
    assert (seen == 1).all()


def test_bands_within_bands_do_not_wait_for_each_other() -> None:
    seen = np.zeros((4 * LEAST_BAND_ROWS, 3 * LEAST_BAND_ROWS), int)

    def note(band: slice) -> None:
        def note_columns(columns: slice) -> None:
            seen[band, columns] += 1

        by_bands(note_columns, seen.shape[1])

    by_bands(note, len(seen))
    assert (seen == 1).all()


def test_what_a_band_raises_is_raised() -> None:
    def fail(band: slice) -> None:
        raise ValueError(str(band.start))

    with pytest.raises(ValueError, match="0"):
        by_bands(fail, LEAST_BAND_ROWS)


def test_normals_do_not_depend_on_the_bands(monkeypatch: pytest.MonkeyPatch) -> None:
    camera = CameraModel(160, 120, np.array([[150.0, 0, 80], [0, 150.0, 60], [0, 0, 1]]))
    rng = np.random.default_rng(3)
    depth_m = rng.normal(0.8, 0.004, (120, 160)).astype(np.float32)
    depth_m[40:80, 50:90] -= 0.3
    depth = DepthImage(depth_m, rng.random(depth_m.shape) > 0.05, camera, 0.003)
    found = []
    monkeypatch.setattr(threads, "_cores", lambda: 5)
    for rows in (len(depth_m), 7):
        monkeypatch.setattr(threads, "LEAST_BAND_ROWS", rows)
        found.append(depth_surface(depth, camera))
    assert np.isfinite(found[0].gradient).any()
    assert np.array_equal(found[0].gradient, found[1].gradient, equal_nan=True)
    assert np.array_equal(found[0].normals, found[1].normals)


@pytest.mark.parametrize("on_gpu", [False, True], ids=["numpy", "GPU"])
def test_no_array_of_a_measured_room_s_triangles_is_made(
    gpu: GpuContext, monkeypatch: pytest.MonkeyPatch, *, on_gpu: bool
) -> None:
    """Voxels and shadow views of a new frame: shaders read the mesh's own buffers."""

    def refuse(_: GpuMesh) -> None:
        raise AssertionError("an array of all triangles' corners")

    monkeypatch.setattr(GpuMesh, "corners", property(refuse))
    real = RealGeometry(gpu, RealScene(), BUDGET, meshes_on_gpu=on_gpu)
    real.update([floor_from(0.25)])
    assert real.state is not None
    fronts, backs = real.state.solid_parts(0.01)
    assert fronts.triangle_count > backs.triangle_count > 0
    assert backs.behind_m > fronts.behind_m == 0
    receivers = shadow_receivers(real.state, np.array([[-0.1, -0.1, 0.0], [0.1, 0.1, 0.1]]))
    assert 0 < len(receivers) <= len(real.state.points)
    with pytest.raises(AssertionError, match="all triangles"):
        _ = real.state.corners
    real.release()


def test_the_coarse_mesh_is_made_once_and_when_asked_for(
    gpu: GpuContext, monkeypatch: pytest.MonkeyPatch
) -> None:
    budgets: list[int] = []

    def counted(*given: object, **named: object) -> object:
        budgets.append(given[3])  # type: ignore[arg-type]
        return depth_mesh(*given, **named)  # type: ignore[arg-type]

    monkeypatch.setattr(seen_depth, "depth_mesh", counted)
    real = RealGeometry(gpu, RealScene(), BUDGET, meshes_on_gpu=False)
    assert real.update([floor_from(0.25)])
    assert real.state is not None
    assert budgets == [BUDGET]
    (coarse,) = real.state.coarse_parts
    assert real.state.coarse_parts[0].mesh is coarse.mesh
    assert budgets == [BUDGET, BUDGET // COARSE_DIVISOR]
    assert 0 < coarse.triangle_count < real.state.buffers.triangle_count
    real.release()


def test_a_coarse_mesh_that_is_begun_before_it_is_asked_for_is_that_of_its_frame(gpu: GpuContext) -> None:
    moving, standing = (RealGeometry(gpu, RealScene(), BUDGET, meshes_on_gpu=False) for _ in range(2))
    before = None
    for x in (0.25, 0.35, 0.45):
        assert moving.update([floor_from(x)])
        assert moving.state is not None
        coarse = moving.state.coarse_mesh.corners
        assert before is None or not np.array_equal(coarse, before)
        before = coarse
    standing.update([floor_from(0.45)])
    assert standing.state is not None
    assert before is not None
    assert np.array_equal(standing.state.coarse_mesh.corners, before)
    moving.release()
    standing.release()


def floor_from(x: float) -> PosedFrame:
    pose = look_at((x, -0.9, 0.65))
    seen = frame(checkered(), pose=pose, depth=depth_image(floor_depth(pose)))
    return PosedFrame(seen, CameraView(seen.camera, pose.world_from_camera))
