"""Lights over time: the same numbers, no jumps, no energy lost."""

import numpy as np
import pytest

from deltalight.protocol.light_tracker import MOST_LIGHTS, LightTracker
from deltalight.protocol.median_cut import RegionLight
from deltalight.protocol.octahedral import texel_solid_angles
from deltalight.protocol.sky_lights import Region

SECOND = 1_000_000_000
NOWHERE = Region(0, 1, 0, 1)


def light(
    azimuth_deg: float, strength: float, elevation_deg: float = 45.0, radius: float = 0.05
) -> RegionLight:
    azimuth, elevation = np.radians([azimuth_deg, elevation_deg])
    level = np.cos(elevation)
    toward = np.array([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])
    return RegionLight(toward, strength * np.array([1.0, 0.9, 0.8]), radius, NOWHERE)


def rest(radiance: float = 0.1) -> np.ndarray:
    return np.full((8, 8, 3), radiance, np.float32)


def total(tracker: LightTracker) -> float:
    """All light in the first channel, lights and residual together, as flux."""
    assert tracker.residual is not None
    residual = float((tracker.residual[..., 0] * texel_solid_angles(8)).sum())
    return residual + sum(float(one.irradiance[0]) for one in tracker.lights)


def by_direction(tracker: LightTracker, azimuth_deg: float) -> int:
    toward = light(azimuth_deg, 1).to_light
    return max(tracker.lights, key=lambda one: float(one.to_light @ toward)).identity


def test_the_first_map_is_taken_as_it_is() -> None:
    tracker = LightTracker(0.5)
    tracker.set_target(5 * SECOND, (light(0, 2), light(90, 1)), rest())
    assert [one.irradiance[0] for one in tracker.lights] == [2, 1]
    assert not tracker.advance(6 * SECOND)


def test_jitter_of_a_still_scene_is_reduced() -> None:
    rng = np.random.default_rng(1)
    tracker = LightTracker(0.5)
    raw, smooth = [], []
    for step in range(100):
        seen = light(30 + rng.normal(0, 1), 2 + rng.normal(0, 0.1))
        tracker.set_target(step * SECOND // 10, (seen,), rest())
        raw.append((*seen.to_light, seen.irradiance[0]))
        (shown,) = tracker.lights
        smooth.append((*shown.to_light, shown.irradiance[0]))
        assert shown.identity == 1
    noise, left = np.std(raw[20:], axis=0), np.std(smooth[20:], axis=0)
    assert (left[:2] < 0.5 * noise[:2]).all()
    assert left[3] < 0.5 * noise[3]
    assert np.mean(smooth[20:], axis=0) == pytest.approx(np.mean(raw[20:], axis=0), abs=0.05)


def test_another_order_and_moving_past_each_other_keep_numbers() -> None:
    tracker = LightTracker(0.2)
    tracker.set_target(0, (light(0, 3), light(80, 1)), rest())
    first, second = by_direction(tracker, 0), by_direction(tracker, 80)
    tracker.set_target(SECOND, (light(82, 1.1), light(3, 2.9)), rest())
    tracker.advance(3 * SECOND)
    assert len(tracker.lights) == 2
    assert (by_direction(tracker, 0), by_direction(tracker, 80)) == (first, second)


def test_strength_tells_neighbours_apart() -> None:
    """Between two lights 8 degrees apart that both moved by 5, the strong one stays the strong one."""
    tracker = LightTracker(0.0)
    tracker.set_target(0, (light(0, 5), light(8, 0.5)), rest())
    strong = max(tracker.lights, key=lambda one: one.irradiance[0]).identity
    tracker.set_target(SECOND, (light(13, 0.5), light(5, 5)), rest())
    assert max(tracker.lights, key=lambda one: one.irradiance[0]).identity == strong


def test_a_jump_settles_within_three_time_constants() -> None:
    tracker = LightTracker(0.5)
    tracker.set_target(0, (light(0, 1),), rest(0.1))
    tracker.set_target(SECOND, (light(10, 3),), rest(0.3))
    assert tracker.lights[0].irradiance[0] == 1  # nothing jumps
    for step in range(1, 46):
        tracker.advance(SECOND + step * SECOND // 30)
    (shown,) = tracker.lights
    assert shown.irradiance[0] == pytest.approx(3, abs=0.05 * 2 + 1e-6)
    assert np.degrees(np.arccos(shown.to_light @ light(10, 1).to_light)) < 0.06 * 10
    for step in range(46, 150):
        tracker.advance(SECOND + step * SECOND // 30)
    assert tracker.lights[0].irradiance[0] == 3
    assert not tracker.advance(10 * SECOND)  # at rest, so nothing is built anew


@pytest.mark.parametrize("step_ns", [SECOND // 60, SECOND // 10])
def test_the_way_does_not_depend_on_the_frame_rate(step_ns: int) -> None:
    tracker = LightTracker(0.5)
    tracker.set_target(0, (light(0, 1),), rest())
    tracker.set_target(0, (light(0, 2),), rest())
    for at in range(step_ns, SECOND + 1, step_ns):
        tracker.advance(at)
    assert tracker.lights[0].irradiance[0] == pytest.approx(2 - np.exp(-2), abs=0.03)


def test_a_light_that_splits_fades_without_a_change_of_the_total() -> None:
    """The same map, cut in another way: one light into two, one light back into the residual."""
    tracker = LightTracker(0.5)
    back = 1.0 / float(texel_solid_angles(8).sum())
    tracker.set_target(0, (light(0, 4), light(120, 1)), rest(0.1))
    before = total(tracker)
    tracker.set_target(SECOND, (light(-8, 2), light(40, 2)), rest(0.1 + back))
    for step in range(40):
        tracker.advance(SECOND + step * SECOND // 10)
        assert total(tracker) == pytest.approx(before, rel=0.01)
    assert len(tracker.lights) == 2


def test_lights_fade_in_and_out() -> None:
    tracker = LightTracker(0.5)
    tracker.set_target(0, (light(0, 2),), rest())
    tracker.set_target(SECOND, (light(150, 1),), rest())
    tracker.advance(SECOND + SECOND // 2)
    strengths = {one.identity: float(one.irradiance[0]) for one in tracker.lights}
    assert strengths == pytest.approx({1: 2 * np.exp(-1), 2: 1 - np.exp(-1)}, rel=0.01)
    for step in range(60):  # maps go on coming: what faded is gone in the end all the same
        tracker.set_target(2 * SECOND + step * SECOND // 10, (light(150, 1),), rest())
    assert [one.identity for one in tracker.lights] == [2]


def test_there_are_never_more_lights_than_a_composite_lists() -> None:
    """Lights that jump with each map leave more and more behind that fade."""
    tracker, rng = LightTracker(60.0), np.random.default_rng(2)
    for step in range(30):
        jumped = tuple(light(*rng.uniform((0, 1, -90), (360, 9, 90))) for _ in range(16))
        tracker.set_target(step * SECOND, jumped, rest())
        assert len(tracker.lights) <= MOST_LIGHTS
    assert len(tracker.lights) == MOST_LIGHTS
    tracker.advance(1000 * SECOND)
    shown = sorted(float(one.irradiance[0]) for one in tracker.lights)
    assert shown == pytest.approx(sorted(float(one.irradiance[0]) for one in jumped))


def test_a_light_that_comes_back_is_the_same() -> None:
    tracker = LightTracker(0.5)
    tracker.set_target(0, (light(0, 2), light(120, 1)), rest())
    lost = by_direction(tracker, 120)
    tracker.set_target(SECOND, (light(0, 2),), rest())
    tracker.set_target(SECOND + SECOND // 5, (light(0, 2), light(121, 1)), rest())
    assert by_direction(tracker, 120) == lost
    assert len(tracker.lights) == 2


def test_a_clock_that_is_set_back_does_no_harm() -> None:
    tracker = LightTracker(0.5)
    tracker.set_target(100 * SECOND, (light(0, 1),), rest())
    tracker.set_target(101 * SECOND, (light(0, 3),), rest())
    tracker.advance(101 * SECOND + SECOND // 2)
    reached = float(tracker.lights[0].irradiance[0])
    assert not tracker.advance(SECOND)
    assert float(tracker.lights[0].irradiance[0]) == reached
    tracker.set_target(2 * SECOND, (light(0, 3),), rest())
    for step in range(1, 40):
        tracker.advance(2 * SECOND + step * SECOND // 10)
    assert tracker.lights[0].irradiance[0] == pytest.approx(3)


def test_without_smoothing_everything_is_at_once() -> None:
    tracker = LightTracker(0.0)
    tracker.set_target(0, (light(0, 1),), rest())
    tracker.set_target(1, (light(15, 2), light(90, 1)), rest(0.5))
    assert [one.irradiance[0] for one in tracker.lights] == [2, 1]
    assert [one.identity for one in tracker.lights] == [1, 2]
    assert tracker.residual is not None
    assert tracker.residual.max() == 0.5
