"""`bench real` on a table of our own: plane, cuboid and lights are found again, and its faults are one sentence."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from deltalight.benchmarks.real.blob import Blob, fit_blob
from deltalight.benchmarks.real.cuboid import Cuboid, Observed, fit_cuboid, outline
from deltalight.benchmarks.real.light_fit import FoundLight, FoundLights, fit_lights, hidden_light, hidden_sky
from deltalight.benchmarks.real.pictures import read_values
from deltalight.benchmarks.real.ranges import Plane, fit_plane
from deltalight.benchmarks.real.relit import table_frame, table_scene
from deltalight.benchmarks.real.score import changed_part, score
from deltalight.benchmarks.real.things import standing, table_mask
from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.errors import DeltalightError
from deltalight.relighting import Renderer
from deltalight.services.cli import app

WIDTH, HEIGHT = 320, 240
CAMERA = CameraModel(WIDTH, HEIGHT, np.array([[262.5, 0, 159.5], [0, 262.5, 119.5], [0, 0, 1]]))
NORMAL = np.array([0.1, 0.6, np.sqrt(1 - 0.37)])
PLANE = Plane(CAMERA, NORMAL, 0.7, np.array([-0.2, 0.85, 0.2]), 0.0)
BOX = Cuboid(-0.05, -0.06, 0.4, (0.05, 0.11, 0.16))


def box_depth() -> np.ndarray:
    """Depth of the table with the box on it, m."""
    eye, points = PLANE.world_from_camera[:3, 3], PLANE.points(PLANE.depth_m)
    enter, leave = BOX.hits(np.broadcast_to(eye, points.shape), points - eye)
    return np.where(enter <= leave, np.minimum(enter, 1), 1) * PLANE.depth_m


def light(azimuth_deg: float, elevation_deg: float, radius_deg: float, fraction: float) -> FoundLight:
    azimuth, elevation = np.radians([azimuth_deg, elevation_deg])
    across = np.cos(elevation)
    towards = np.array([across * np.cos(azimuth), across * np.sin(azimuth), np.sin(elevation)])
    return FoundLight(towards, float(np.radians(radius_deg)), np.full(3, fraction))


def around(count: int = 24) -> np.ndarray:
    """Points of the table around the box."""
    grid = np.linspace(-0.3, 0.3, count)
    x, y = np.meshgrid(BOX.x_m + grid, BOX.y_m + grid)
    return np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3)


def test_a_plane_is_found_from_distances_to_another_place_than_the_camera() -> None:
    points = PLANE.points(box_depth())
    origin = PLANE.world_from_camera[:3, :3] @ PLANE.origin_m + PLANE.world_from_camera[:3, 3]
    ranges = np.linalg.norm(points - origin, axis=-1)
    noisy = ranges + np.random.default_rng(1).normal(0, 0.0005, ranges.shape)
    found = fit_plane(CAMERA, noisy, np.ones(ranges.shape, bool), at_camera=False)
    assert np.degrees(np.arccos(found.normal @ NORMAL)) < 0.3
    assert abs(found.distance_m - PLANE.distance_m) < 0.003
    heights = found.points(found.depth_of_ranges(noisy))[..., 2]
    assert abs(heights[standing(heights)[0]].max() - BOX.size_m[2]) < 0.01


def test_curved_ground_is_no_table() -> None:
    rows = np.linspace(0, 3, HEIGHT)[:, None] + np.zeros((1, WIDTH))
    with pytest.raises(DeltalightError, match="within"):
        fit_plane(CAMERA, 1 + 0.2 * np.sin(4 * rows), np.ones((HEIGHT, WIDTH), bool), at_camera=True)


def test_a_cuboid_of_known_pose_is_found() -> None:
    points = PLANE.points(box_depth())
    seen = outline(BOX, PLANE)
    found = fit_cuboid(Observed(seen, points[seen & (points[..., 2] > 0.01)]), PLANE)
    assert np.hypot(found.x_m - BOX.x_m, found.y_m - BOX.y_m) < 0.003
    np.testing.assert_allclose(sorted(found.size_m), sorted(BOX.size_m), atol=0.004)
    nearest = [np.linalg.norm(found.corners - corner, axis=1).min() for corner in BOX.corners]
    assert max(nearest) < 0.006


def test_the_table_is_what_is_even() -> None:
    heights = PLANE.points(box_depth())[..., 2]
    table = table_mask(heights)
    assert not (table & outline(BOX, PLANE)).any()
    assert table.mean() > 0.8


def test_a_box_hides_light_as_its_shape_says() -> None:
    """A light at 45 degrees throws a shadow as long as the box is high; beside it even light has half the sky."""
    tall = Cuboid(0, 0, 0, (0.2, 0.2, 0.1))
    towards = np.array([1, 0, 1]) / np.sqrt(2)
    points = np.array([[-0.101, 0, 0], [-0.199, 0, 0], [-0.201, 0, 0], [0.101, 0, 0]])
    np.testing.assert_array_equal(hidden_light(points, tall, towards, 1e-6), [1, 1, 0, 0])
    wall = Cuboid(-50, 0, 0, (100, 100, 100))
    assert hidden_sky(np.array([[1e-4, 0, 0]]), wall)[0] == pytest.approx(0.5, abs=0.01)


def test_lights_are_found_again() -> None:
    truth = FoundLights([light(-60, 50, 5, 0.45), light(100, 60, 5, 0.2)], np.full(3, 0.35), 0.0)
    points = around()
    inside = BOX.hits(points, np.broadcast_to([0.0, 0.0, 1.0], points.shape))
    points = points[inside[0] > inside[1]]
    noise = np.random.default_rng(2).normal(0, 0.005, (len(points), 3))
    found = fit_lights(points, truth.ratios(points, BOX) + noise, BOX)
    strongest = max(found.lights, key=lambda each: each.fraction.sum())
    assert np.degrees(np.arccos(strongest.towards @ truth.lights[0].towards)) < 3
    assert np.abs(strongest.fraction - 0.45).max() < 0.08
    np.testing.assert_allclose(found.ratios(points, BOX), truth.ratios(points, BOX), atol=0.1)
    assert found.rms < 0.01


def test_a_blob_is_found_again() -> None:
    truth = Blob((0.4, -0.2), 1.2, 0.3, np.array([0.3, 0.4, 0.5]))
    found = fit_blob(around(), truth.ratios(around(), BOX), BOX)
    np.testing.assert_allclose(found.ratios(around(), BOX), truth.ratios(around(), BOX), atol=0.01)


def test_figures_of_no_shadow_half_the_shadow_and_all_of_it() -> None:
    plate = np.full((40, 60, 3), 0.5, np.float32)
    truth, table = plate.copy(), np.ones((40, 60), bool)
    truth[10:30, 10:40] = 0.3
    changed = changed_part(truth, plate, table)
    assert changed[10:30, 10:40].all()
    none, half, all_of_it = (
        score(each, truth, plate, table, changed) for each in (plate, (plate + truth) / 2, truth)
    )
    assert (none.taken, half.taken, all_of_it.taken) == pytest.approx((0, 0.5, 1), abs=1e-3)
    assert none.table_psnr_db < half.table_psnr_db < all_of_it.table_psnr_db == np.inf


@pytest.mark.slow
def test_lights_shine_in_the_renderer_as_in_the_closed_form(tmp_path: Path) -> None:
    lights = FoundLights([light(-60, 50, 5, 0.6), light(100, 60, 8, 0.4)], np.zeros(3), 0.0)
    plane = replace(PLANE, camera=CAMERA.resized(WIDTH // 2, HEIGHT // 2))
    table = np.ones((HEIGHT // 2, WIDTH // 2), bool)
    plate = np.full((*table.shape, 3), 180, np.uint8)
    scene = table_scene([(BOX, np.zeros(3))], lights, np.full(3, 0.45), tmp_path)
    with Renderer("exact", "best") as renderer:
        picture = renderer.render(table_frame(0, plate, plane, table), scene)
    shown = picture.coverage == 0
    closed = lights.ratios(plane.points(plane.depth_m)[shown], BOX)
    ours = picture.ratio[shown]
    assert (closed < 0.6).any()
    assert np.abs(ours - closed).mean() < 0.02
    assert (1 - ours).sum() == pytest.approx((1 - closed).sum(), rel=0.05)


def test_missing_folders_and_files_are_one_sentence(tmp_path: Path) -> None:
    result = CliRunner().invoke(
        app, ["bench", "real", "--data", str(tmp_path), "--out", str(tmp_path / "out")]
    )
    assert isinstance(result.exception, DeltalightError)
    assert "holds no folder carton_table" in str(result.exception)
    (tmp_path / "depth.png").write_bytes(b"no picture")
    with pytest.raises(DeltalightError, match="cannot be read as a picture"):
        read_values(tmp_path / "depth.png", (4, 4))
    with pytest.raises(DeltalightError, match="does not exist"):
        read_values(tmp_path / "other.png", (4, 4))
