"""Metrics of the quality benchmark against closed forms."""

import cv2
import numpy as np
import pytest
from scipy.special import ndtr, ndtri

from deltalight.benchmarks.ground_truth.benchmark_scene import ShadowEdge
from deltalight.benchmarks.ground_truth.parts import looking
from deltalight.benchmarks.quality.energy import Change, energy_ratios
from deltalight.benchmarks.quality.error_view import error_view
from deltalight.benchmarks.quality.figures import mean_figures
from deltalight.benchmarks.quality.metrics import Comparison
from deltalight.benchmarks.quality.penumbra import EdgeOnPicture, step_width
from deltalight.benchmarks.quality.regions import Regions, find_regions
from deltalight.benchmarks.quality.temporal import temporal_deviation
from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.frames import decode_lut

SIZE = (24, 32)


def picture(seed: int = 1) -> np.ndarray:
    return np.random.default_rng(seed).integers(40, 200, (*SIZE, 3), dtype=np.uint8)


def part(rows: slice) -> np.ndarray:
    mask = np.zeros(SIZE, bool)
    mask[rows] = True
    return mask


def test_equal_pictures_agree_perfectly() -> None:
    agreement = Comparison(picture(), picture()).everywhere()
    assert agreement.psnr_db == np.inf
    assert agreement.ssim == pytest.approx(1)
    assert agreement.flip == 0
    assert agreement.share == 1


def test_constant_offset_has_the_psnr_of_its_square() -> None:
    agreement = Comparison(picture() + np.uint8(10), picture()).everywhere()
    assert agreement.psnr_db == pytest.approx(20 * np.log10(255 / 10))


def test_part_is_compared_alone() -> None:
    other = picture()
    other[12:] += 20
    compared = Comparison(other, picture())
    assert compared.over(part(slice(0, 12))).psnr_db == np.inf
    assert compared.over(part(slice(12, 24))).psnr_db == pytest.approx(20 * np.log10(255 / 20))
    assert compared.over(part(slice(12, 24))).flip > 0.02
    assert compared.over(part(slice(0, 0))).share == 0
    assert np.isnan(compared.over(part(slice(0, 0))).psnr_db)


def test_changed_pixels_move_by_more_than_two_codes() -> None:
    lut = decode_lut(None)[:, 0]
    without = np.full((1, 4, 3), lut[100], np.float32)
    with_objects = without.copy()
    with_objects[0, :, 1] = lut[[100, 102, 103, 96]]
    cover = np.array([[0.0, 0.0, 1.0, 0.5]], np.float32)
    regions = find_regions(without, with_objects, cover)
    assert regions.changed.tolist() == [[False, False, True, True]]
    assert regions.changed_virtual.tolist() == [[False, False, True, False]]
    assert not regions.changed_real.any()


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0, 1.5])
def test_scaled_change_has_its_scale_as_energy(share: float) -> None:
    rng = np.random.default_rng(5)
    without = rng.uniform(0.3, 0.6, (*SIZE, 3)).astype(np.float32)
    change = rng.uniform(-0.2, 0.2, (*SIZE, 3)).astype(np.float32)
    camera = without + np.float32(0.05)
    regions = Regions(part(slice(0, 24)), part(slice(0, 12)), part(slice(12, 24)))
    energy = energy_ratios(camera + share * change, camera, [Change(without, without + change, regions)])
    assert energy.darkening == pytest.approx(share, abs=1e-4)
    assert energy.brightening == pytest.approx(share, abs=1e-4)


def test_noise_of_the_truth_is_not_light() -> None:
    """An independent, unbiased estimate of a little added light has all of it, though both are noisy."""
    rng = np.random.default_rng(6)
    size = (240, 320, 3)
    without = np.full(size, 0.4, np.float32)
    with_objects, result = (without + rng.normal(0.002, 0.006, size).astype(np.float32) for _ in range(2))
    everywhere = np.ones(size[:2], bool)
    regions = Regions(everywhere, everywhere, ~everywhere)
    energy = energy_ratios(result, without, [Change(without, with_objects, regions)])
    assert energy.brightening == pytest.approx(1, abs=0.05)  # by the truth's own sign: 0.36


def test_noise_that_a_lens_spreads_over_neighbours_is_no_light_either() -> None:
    """And neither is that which lifts pixels over the threshold of change: light is measured by the other half."""
    rng = np.random.default_rng(7)
    size = (240, 320, 3)
    without, cover = np.full(size, 0.4, np.float32), np.zeros(size[:2], np.float32)

    def blurred_draw() -> np.ndarray:
        noise = rng.normal(0, 0.012, size).astype(np.float32)
        return without + np.float32(0.004) + cv2.GaussianBlur(noise, (0, 0), 0.6)

    result, *halves = (blurred_draw() for _ in range(3))
    changes = [Change(without, half, find_regions(without, half, cover)) for half in halves]
    assert energy_ratios(result, without, changes).brightening == pytest.approx(1, abs=0.05)
    assert energy_ratios(result, without, changes[:1]).brightening < 0.8


def test_virtual_radiance_is_compared_on_objects_only() -> None:
    truth = np.full((*SIZE, 3), 0.4, np.float32)
    result = truth.copy()
    result[12:] *= 0.75
    regions = Regions(part(slice(0, 24)), part(slice(0, 12)), part(slice(12, 24)))
    energy = energy_ratios(result, truth, [Change(truth, truth, regions)])
    assert energy.virtual == pytest.approx(0.75)
    assert np.isnan(energy.darkening)


def test_width_of_a_ramp_is_eight_tenths_of_it() -> None:
    way = np.linspace(0, 1, 401)
    assert step_width(np.interp(way, [0.3, 0.7], [1.0, 0.4])) == pytest.approx(0.8 * 0.4, abs=0.005)


def test_width_of_a_blurred_step_is_that_of_its_normal_distribution() -> None:
    way = np.linspace(0, 1, 401)
    noise = np.random.default_rng(2).normal(0, 0.003, way.size)
    profile = 0.9 - 0.5 * ndtr((way - 0.5) / 0.1) + noise
    assert step_width(profile) == pytest.approx(2 * ndtri(0.9) * 0.1, rel=0.08)


def test_profile_that_does_not_fall_has_no_width() -> None:
    assert np.isnan(step_width(np.ones(50)))
    assert np.isnan(step_width(np.linspace(0.5, 1, 50)))


CAMERA = CameraModel(
    160, 120, np.array([[150.0, 0, 79.5], [0, 150.0, 59.5], [0, 0, 1]]), "plumb_bob", np.zeros(5)
)


def table_shadow(width_m: float) -> np.ndarray:
    """A table seen from above at a slant: its light falls linearly from 1 to 0.5 over `width_m` in x, about x = 0."""
    pose = looking((0.1, -0.5, 0.6), (0.0, 0.0, 0.0))
    rays = np.concatenate([CAMERA.rays(), np.ones((120, 160, 1))], axis=2) @ pose[:3, :3].T
    x_m = pose[0, 3] - rays[..., 0] / rays[..., 2] * pose[2, 3]
    light = np.interp(x_m, [-width_m / 2, width_m / 2], [1, 0.5])
    return np.repeat(0.6 * light[..., None], 3, axis=2).astype(np.float32)


def test_penumbra_on_a_slanted_table_has_its_width_in_metres() -> None:
    edge = ShadowEdge((-0.15, 0.02, 0.0), (0.15, 0.02, 0.0))
    seen = EdgeOnPicture.seen(edge, CAMERA, looking((0.1, -0.5, 0.6), (0.0, 0.0, 0.0)))
    lit = np.full((120, 160, 3), 0.6, np.float32)
    penumbra = seen.measure(lit, table_shadow(0.15), lit, table_shadow(0.1))
    assert penumbra.truth_m == pytest.approx(0.08, rel=0.05)
    assert penumbra.relative_error == pytest.approx(0.5, abs=0.05)
    assert np.isnan(seen.measure(lit, lit, lit, table_shadow(0.1)).relative_error)


def test_penumbra_behind_an_object_is_not_measured() -> None:
    edge = ShadowEdge((-0.15, 0.02, 0.0), (0.15, 0.02, 0.0))
    seen = EdgeOnPicture.seen(edge, CAMERA, looking((0.1, -0.5, 0.6), (0.0, 0.0, 0.0)))
    lit = np.full((120, 160, 3), 0.6, np.float32)
    shadow = table_shadow(0.1)
    hidden = seen.uncovered(np.ones((120, 160), np.float32))
    assert np.isnan(hidden.measure(lit, shadow, lit, shadow).truth_m)
    free = seen.uncovered(np.zeros((120, 160), np.float32))
    assert free.measure(lit, shadow, lit, shadow).relative_error == pytest.approx(0)


def test_identical_sequences_are_steady() -> None:
    frames = [picture(seed) for seed in range(3)]
    deviation = temporal_deviation(frames, frames, [part(slice(0, 12))] * 3)
    assert (deviation.unchanged, deviation.changed) == (0, 0)


def test_flicker_counts_where_it_is() -> None:
    reference = [picture()] * 2
    flickering = [picture(), picture()]
    flickering[1][12:] += 6
    deviation = temporal_deviation(flickering, reference, [part(slice(12, 24))] * 2)
    assert deviation.unchanged == 0
    assert deviation.changed == pytest.approx(6)
    steady_error = [frame + np.uint8(9) for frame in reference]
    assert temporal_deviation(steady_error, reference, [part(slice(0, 12))] * 2).changed == 0


def test_single_frame_has_no_deviation() -> None:
    assert np.isnan(temporal_deviation([picture()], [picture()], [part(slice(0, 12))]).unchanged)


def test_error_colours_say_sign_and_size() -> None:
    reference = np.full((1, 5, 3), 100, np.uint8)
    result = reference.copy()
    result[0, 1, 1] = 100 - 32  # beyond 1/8 of the range
    result[0, 2, 2] = 100 + 32
    result[0, 3, 0] = 100 - 16  # strength (16/255)^2 * 64 = 0.252, red at twice that
    result[0, 4] = (90, 120, 100)  # the greater error gives the sign
    colors = error_view(result, reference)[0].tolist()
    assert colors[0] == [0, 0, 0]
    assert colors[1] == [255, 255, 0]
    assert colors[2] == [255, 255, 255]
    assert colors[3] == [129, 0, 0]
    assert colors[4][0] == 0
    assert colors[4][2] == 201


def test_means_leave_out_what_is_not_there() -> None:
    means = mean_figures([{"a": 1.0, "b": np.nan}, {"a": 3.0, "b": np.nan}, {"c": 5.0}])
    assert means["a"] == 2
    assert means["c"] == 5
    assert np.isnan(means["b"])
