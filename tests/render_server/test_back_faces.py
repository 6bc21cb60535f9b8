"""What one camera saw of solid things keeps light off from behind too."""

from pathlib import Path

import numpy as np
import pytest

from deltalight.protocol.frames import decode_lut
from deltalight.protocol.scene_method import DlpvMethod, DvctMethod
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.scene.depth_mesh import BACK_OFFSET_VOXELS, back_faces
from tests.render_server.scenes import (
    HEIGHT,
    WIDTH,
    Stage,
    Vector,
    ambient,
    camera,
    cube,
    depth_image,
    floor_depth,
    frame,
    look_at,
    plain,
    solve,
)

SHELF_M = 0.2  # its height above the floor, and half its edge
SHELF_MIDDLE_M = (0.0, 0.15)
SURROUNDINGS, DARK = 0.2, 60  # radiance from everywhere; the picture's code
UNSEEN_ALBEDO = 0.5
LOW: tuple[Vector, Vector] = ((0.0, -0.9, 0.5), (0.0, 0.1, 0.08))  # a camera that sees the board and below it


def test_a_back_lies_behind_its_triangle_and_faces_away() -> None:
    corners = np.zeros((1, 3, 10), np.float32)
    corners[0, :, :3] = [(0, 0, 1), (1, 0, 1), (0, 1, 1)]
    corners[0, :, 3:] = np.arange(21).reshape(3, 7)
    (back,) = back_faces(corners, 0.01)
    assert back[:, :3] == pytest.approx(
        np.array([(0, 1, 1), (1, 0, 1), (0, 0, 1)]) - (0, 0, BACK_OFFSET_VOXELS * 0.01)
    )
    assert np.array_equal(back[:, 3:], corners[0, ::-1, 3:])


def shelf_depth() -> np.ndarray:
    """A square board over a floor, each seen where it is nearer."""
    pose = look_at(*LOW)
    board = floor_depth(pose, SHELF_M)
    rays = np.dstack([camera().rays(), np.ones((HEIGHT, WIDTH))])
    matrix = pose.world_from_camera
    place = matrix[:3, 3] + board[..., None] * (rays @ matrix[:3, :3].T)
    on_board = (np.abs(place[..., :2] - SHELF_MIDDLE_M) < SHELF_M).all(axis=-1) & (board > 0)
    return np.where(on_board, board, floor_depth(pose))


@pytest.mark.slow
@pytest.mark.usefixtures("clean_gl")
@pytest.mark.parametrize(
    "method",
    [
        DvctMethod(volume_size=64, volume_edge_m=0.9, cone_scale=1, bounces=2),
        DlpvMethod(volume_size=32, volume_edge_m=0.9, query_scale=1),
    ],
    ids=["dvct", "dlpv"],
)
def test_floor_below_a_shelf_is_lit_from_the_sides_alone(
    gpu: GpuContext, tmp_path: Path, method: DvctMethod | DlpvMethod
) -> None:
    """The camera sees the board's top only. The floor below its middle has the light beside it, and
    what the underside (of unseen albedo) gives back: between nothing and its albedo of all light."""
    speck = cube(0.01, (0.0, -0.1, 0.0))
    stage = Stage(tmp_path)
    document = stage.document([stage.virtual(speck)], [ambient(SURROUNDINGS)]).replaced(method=method)
    view = frame(plain(DARK), pose=look_at(*LOW), depth=depth_image(shelf_depth()))
    found = solve(gpu, document, view)
    below = np.linalg.norm(found.position[..., :3] - (*SHELF_MIDDLE_M, 0.0), axis=-1) < 0.04
    assert below.sum() > 20
    share = found.cones_mu[below].mean() / (np.pi * SURROUNDINGS)
    # A square of half edge h at height h: (4 / 2 pi) * 2 * (1/sqrt 2) atan(1/sqrt 2).
    factor = 4 / np.pi * np.sqrt(0.5) * np.arctan(np.sqrt(0.5))
    dark = decode_lut(None)[DARK, 0] / SURROUNDINGS
    print(
        f"{method.name}: {share:.3f} of the open floor's light; {1 - factor:.3f} if the underside were black"
    )
    assert 1 - factor - 0.1 < share < 1 - factor + factor * UNSEEN_ALBEDO + 0.1 * dark
