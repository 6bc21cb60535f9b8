"""Surfaces seen along them, without depth: bridged where nothing else explains the strip, meshed, and opaque."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from jaxtyping import Bool, Float32, UInt8

from deltalight.protocol.frames import BoardPose, DepthImage
from deltalight.protocol.source import open_source
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.scene.depth_mesh import depth_mesh
from deltalight.render_server.scene.grazing_depth import grazing_depth_fill
from deltalight.sensor_node.view_frames import ViewFrameBuilder
from tests.render_server.scenes import COARSE, Stage, camera, cube, directional, frame, look_at, solve

CAMERA = camera(320, 240, 300)
TOP, FRONT, WALL, SIDE = 0.3, -0.1, 0.3, 0.2  # of a shelf on a wall, over a floor; m
ALONG, ABOVE = look_at((0, -1, 0.4), (0, 0, 0.25)), look_at((0, -1, 0.8), (0, 0, 0.25))
LID, EDGE, FLOOR, BEHIND = 0, 1, 2, 3
COLORS = np.array([(200, 60, 60), (210, 210, 200), (90, 120, 80), (70, 130, 150)])
# Axis, place on it, and the bounds along x, y and z of each, in the order above.
PLANES = (
    (2, TOP, ((-SIDE, SIDE), (FRONT, WALL), (-9, 9))),
    (1, FRONT, ((-SIDE, SIDE), (-9, 9), (TOP - 0.03, TOP))),
    (2, 0.0, ((-9, 9), (-9, WALL), (-9, 9))),
    (1, WALL, ((-9, 9), (-9, 9), (0, 9))),
)
SIGMA = 0.001


def shelf(pose: BoardPose) -> tuple[Float32[np.ndarray, "h w"], UInt8[np.ndarray, "h w"]]:
    """Depth (m) without noise, and what each pixel shows."""
    rays = np.dstack([CAMERA.rays(), np.ones((CAMERA.height, CAMERA.width))])
    eye, along = pose.world_from_camera[:3, 3], rays @ pose.world_from_camera[:3, :3].T
    found = []
    for axis, at, bounds in PLANES:
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = (at - eye[axis]) / along[..., axis]
            place = eye + along * depth[..., None]
        inside = depth > 0
        for other, (low, high) in enumerate(bounds):
            inside &= (other == axis) | ((place[..., other] >= low) & (place[..., other] <= high))
        found.append(np.where(inside, depth, np.inf))
    return np.min(found, axis=0).astype(np.float32), np.argmin(found, axis=0).astype(np.uint8)


def colored(
    shown: UInt8[np.ndarray, "h w"], lid: tuple[int, ...] | None = None
) -> UInt8[np.ndarray, "h w 3"]:
    """The picture, noisy and soft as a lens makes it, with another colour of the lid."""
    colors = COLORS.copy()
    colors[LID] = COLORS[LID] if lid is None else lid
    soft = cv2.GaussianBlur(colors[shown].astype(float), (0, 0), 0.6)
    return np.clip(soft + np.random.default_rng(3).normal(0, 2, soft.shape), 0, 255).astype(np.uint8)


def measured(depth: Float32[np.ndarray, "h w"], unknown: Bool[np.ndarray, "h w"]) -> DepthImage:
    noise = np.random.default_rng(4).normal(0, SIGMA, depth.shape)
    return DepthImage(
        np.where(unknown, 0, 1 / (1 / depth + noise)).astype(np.float32), ~unknown, CAMERA, SIGMA
    )


def test_a_lid_seen_along_it_is_the_plane_between_its_edges() -> None:
    depth, shown = shelf(ALONG)
    found = grazing_depth_fill(measured(depth, shown == LID), colored(shown), CAMERA)
    assert not found[shown != LID].any()
    assert (found > 0)[shown == LID].mean() > 0.95
    inner = (
        cv2.erode((shown == LID).astype(np.uint8), np.ones((1, 41))) > 0
    )  # at its ends, the wall is beside it
    a_pixel = np.abs(np.diff(1 / depth, axis=0))[inner[1:]].mean()
    assert np.abs(found - 1 / depth)[inner].max() < a_pixel + 5 * SIGMA
    rows = np.flatnonzero(inner[:, CAMERA.width // 2])
    assert (np.diff(found[rows, CAMERA.width // 2]) > 0).all()  # nearer downwards


def test_holes_elsewhere_change_nothing() -> None:
    depth, shown = shelf(ALONG)
    color, lid, holes = colored(shown), shown == LID, np.zeros(shown.shape, bool)
    holes[[3, 200, 220], [5, 60, 300]] = True
    holes[210:222, 20:40] = holes[-9:, -30:] = True
    assert not (holes & lid).any()
    alone = grazing_depth_fill(measured(depth, lid), color, CAMERA)
    assert alone.any()
    assert np.array_equal(grazing_depth_fill(measured(depth, lid | holes), color, CAMERA), alone)


def test_the_mesh_closes_the_lid_with_triangles_that_face_up_and_join_nothing_else() -> None:
    depth, shown = shelf(ALONG)
    image, pose = measured(depth, shown == LID), ALONG.world_from_camera
    grazing = grazing_depth_fill(image, colored(shown), CAMERA)
    open_, closed = (
        depth_mesh(image, CAMERA, pose, 80_000, grazing=each) for each in (None, lambda: grazing)
    )
    inside = cv2.erode((shown == LID).astype(np.uint8), np.ones((5, 41))) > 0
    counts = []
    for mesh in (open_, closed):
        corners = mesh.positions[mesh.triangles]
        assert mesh.uv is not None
        column, row = mesh.uv[mesh.triangles].mean(axis=1).round().astype(int).T
        on_lid = inside[row, column]
        across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        up = np.abs(across[:, 2]) / np.linalg.norm(across, axis=1)
        counts.append(int(on_lid.sum()))
        assert (up[on_lid] > 0.9).all()
        assert np.isfinite(mesh.normals).all()
        assert np.linalg.norm(mesh.normals, axis=1) == pytest.approx(1, abs=1e-3)
    assert counts[0] == 0
    assert counts[1] > 0.3 * inside.sum()


def top_of_a_cube_under_the_lid(gpu: GpuContext, stage: Stage, color: UInt8[np.ndarray, "h w 3"]) -> float:
    """Its radiance under light from straight above, which alone makes it 0.5 / pi; the floor reflects some more."""
    depth, shown = shelf(ALONG)
    document = stage.document([stage.virtual(cube(0.1, (0, 0.1, 0)))], [directional((0, 0, -1), 1.0)])
    found = solve(gpu, document, frame(color, pose=ALONG, camera=CAMERA, depth=measured(depth, shown == LID)))
    return float(np.percentile(found.virtual_radiance[found.matte == 1][:, 1], 95))


@pytest.mark.slow
@pytest.mark.usefixtures("clean_gl")
def test_the_lid_throws_its_shadow(gpu: GpuContext, tmp_path: Path) -> None:
    stage, (_, shown) = Stage(tmp_path, COARSE), shelf(ALONG)
    bright = top_of_a_cube_under_the_lid(
        gpu, stage, colored(shown, tuple(COLORS[BEHIND]))
    )  # the lid is unknown
    assert bright > 0.5 / np.pi
    dark = top_of_a_cube_under_the_lid(gpu, stage, colored(shown))
    assert dark < 0.25 * bright  # the lid's underside gives back some of the floor's light


@pytest.mark.parametrize("seen_as", [BEHIND, EDGE])
def test_a_strip_in_the_colour_of_a_surface_beside_it_stays_unknown(seen_as: int) -> None:
    depth, shown = shelf(ALONG)
    color = colored(shown, tuple(COLORS[seen_as]))
    assert not grazing_depth_fill(measured(depth, shown == LID), color, CAMERA).any()


def test_what_a_measurable_slope_explains_has_lost_its_depth_for_another_reason() -> None:
    depth, shown = shelf(ABOVE)
    assert (shown == LID).sum() > 4000
    assert not grazing_depth_fill(measured(depth, shown == LID), colored(shown), CAMERA).any()


def test_edges_of_mixed_colours_and_holes_in_one_surface_are_none() -> None:
    depth, shown = shelf(ALONG)
    rim = cv2.morphologyEx(shown, cv2.MORPH_GRADIENT, np.ones((2, 2), np.uint8)) > 0
    hole = np.zeros_like(rim)
    hole[200:212, 100:140] = True
    color = colored(shown)
    color[rim | hole] = (250, 20, 250)
    unknown = rim | hole
    assert not grazing_depth_fill(measured(depth, unknown), color, CAMERA).any()


def test_nothing_known_and_all_known_give_nothing() -> None:
    depth, shown = shelf(ALONG)
    for unknown in (np.ones(shown.shape, bool), np.zeros(shown.shape, bool)):
        assert not grazing_depth_fill(measured(depth, unknown), colored(shown), CAMERA).any()


@pytest.mark.data
@pytest.mark.parametrize("number", [0, 18])
def test_a_real_desk_has_unknown_depth_everywhere_and_nothing_seen_along_it(
    shared_data: Path, number: int
) -> None:
    source = open_source(shared_data / "rgbd" / "visp_rbt_apriltag")
    view = ViewFrameBuilder(source)(source[number])
    assert view.depth is not None
    assert (~view.depth.valid).sum() > 10_000
    assert not grazing_depth_fill(view.depth, view.color, view.camera).any()
