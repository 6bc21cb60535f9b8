import numpy as np
import pytest

from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.frames import DepthImage

CAMERA = CameraModel(96, 72, np.array([[80.0, 0, 47.5], [0, 80.0, 35.5], [0, 0, 1]]))
SIZES = [(12, 9), (24, 18), (54, 41), (72, 54), (96, 72), (144, 108)]


def plane(camera: CameraModel) -> np.ndarray:
    """Inverse depth of a tilted plane at the pixels' centres, 1/m."""
    rays = camera.rays()
    return 1 + 0.4 * rays[..., 0] + 0.3 * rays[..., 1]


@pytest.mark.parametrize("size", SIZES)
def test_a_plane_stays_where_it_is_at_another_size(size: tuple[int, int]) -> None:
    """To the nearest of the old pixels' centres, half a pixel away at most."""
    depth = DepthImage((1 / plane(CAMERA)).astype(np.float32), np.ones((72, 96), bool), CAMERA, 0.002)
    resized = depth.resized(*size)
    assert resized.depth_m.shape == resized.valid.shape == size[::-1]
    assert resized.noise_sigma_m == 0.002
    half_pixel = (0.4 + 0.3) * 0.5 / 80
    assert np.abs(1 / resized.depth_m - plane(resized.camera)).max() < half_pixel + 1e-5


@pytest.mark.parametrize("size", SIZES)
def test_depths_at_an_edge_do_not_mix_and_holes_stay_holes(size: tuple[int, int]) -> None:
    metres = np.where(np.indices((72, 96)).sum(axis=0) % 3 > 0, np.float32(0.5), np.float32(2))
    valid = np.indices((72, 96)).sum(axis=0) % 5 > 0
    metres[~valid] = 0
    resized = DepthImage(metres, valid, CAMERA).resized(*size)
    assert set(np.unique(resized.depth_m)) <= {0, 0.5, 2}
    assert np.array_equal(resized.valid, resized.depth_m > 0)
