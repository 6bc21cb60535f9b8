"""The real surfaces of a picture: what the GPU fits to depth is what `depth_surface` does."""

from collections.abc import Callable
from functools import partial

import numpy as np
import pytest
from jaxtyping import Float32

from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.frames import DepthImage
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Binding
from deltalight.render_server.gpu.textures import read_texture, texture_2d
from deltalight.render_server.gpu.uniform_block import UniformBlock
from deltalight.render_server.passes.real_surface import RealSurface
from deltalight.render_server.scene.depth_surface import DepthSurface, depth_surface, window_radius
from deltalight.render_server.view import CameraBlock, CameraView
from tests.render_server.test_scene_depth_mesh import LENS, NORMAL, PINHOLE, image, plane_depth

SHAPE = PINHOLE.height, PINHOLE.width


def room(camera: CameraModel, sigma: float) -> DepthImage:
    """A wall, a box before it, a hole, lost pixels and spikes, with noise that grows with z^2."""
    random = np.random.default_rng(3)
    metres = plane_depth(camera, NORMAL, 0.9)
    metres[40:80, 50:90] = 0.6 * plane_depth(camera, np.array([0.2, 0.1, -0.97]), 0.9)[40:80, 50:90]
    metres[20:30, 100:130] = 0
    metres[random.random(SHAPE) < 0.03] = 0
    metres[random.random(SHAPE) < 0.005] = 0.3
    noise = sigma * metres**2 * random.standard_normal(SHAPE)
    return image((metres + noise).astype(np.float32), camera, sigma)


def shown_normals(
    gpu: GpuContext,
    depth: DepthImage,
    fitted: Callable[[], DepthSurface],
    *,
    fits_depth: bool,
    on_gpu: dict[str, Binding] | None = None,
) -> Float32[np.ndarray, "h w 3"]:
    """In the optical frame; those of pixels without a known one look along the ray."""
    view = CameraView(depth.camera, np.eye(4))
    surface = RealSurface(gpu, view.size, fits_depth=fits_depth)
    rays = texture_2d(gpu, view.size, 2, "f4")
    rays.write(np.ascontiguousarray(depth.camera.rays(), np.float32).tobytes(), alignment=1)
    block = UniformBlock[CameraBlock](gpu, view.block())
    nothing: dict[str, Binding] = {"DECLARED_SURFACES": False, "Surfaces": None, "surface_count": 0}
    surface.from_depth(depth, fitted, {"Camera": block, "picture_rays": rays, **nothing}, on_gpu=on_gpu)
    found = read_texture(surface.normal)[..., :3]
    for each in (surface, rays, block):
        each.release()
    return found


@pytest.mark.parametrize("camera", [PINHOLE, LENS], ids=["pinhole", "lens"])
@pytest.mark.parametrize(("sigma", "radius"), [(0.0005, 1), (0.002, 2), (0.02, 5)])
def test_the_gpu_fits_the_same_normals(
    gpu: GpuContext, camera: CameraModel, sigma: float, radius: int
) -> None:
    depth = room(camera, sigma)
    assert window_radius(depth, camera) == radius
    by_numpy = shown_normals(gpu, depth, partial(depth_surface, depth, camera), fits_depth=False)
    by_gpu = shown_normals(gpu, depth, pytest.fail, fits_depth=True)  # which asks for no fit of the CPU
    apart = np.degrees(2 * np.arcsin(np.linalg.norm(by_numpy - by_gpu, axis=2) / 2))
    # Where a test is decided by the last bit, numpy and the GPU may choose another window.
    assert np.mean(apart > 0.2) < 0.002
    assert np.median(apart) < 0.05
