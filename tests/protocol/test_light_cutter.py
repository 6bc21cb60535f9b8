"""From maps of radiance to lights and residual, frame by frame."""

from dataclasses import replace

import numpy as np
import pytest

from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.frames import BoardPose, DepthImage, RadianceMap, ViewFrame
from deltalight.protocol.hemisphere import texel_directions, texel_solid_angles
from deltalight.protocol.light_cutter import RESIDUAL_SIZE, LightCutter
from deltalight.protocol.octahedral import texel_solid_angles as sphere
from deltalight.protocol.scene_lights import LightCut
from deltalight.protocol.sky_lights import SkyLights
from tests.protocol.test_light_codecs import sample_map

SIZE = 128
SECOND = 1_000_000_000
CAMERA = CameraModel(4, 3, np.array([[4.0, 0, 1.5], [0, 4, 1], [0, 0, 1]]), "plumb_bob", np.zeros(5))
LAMPS = [(0.0, 40.0), (130.0, 60.0), (250.0, 80.0)]  # azimuth in degrees, radiance


def lit_map(turn_deg: float = 0.0, noise: float = 0.0, seed: int = 0) -> RadianceMap:
    """Three lamps 45 degrees up in a coloured room, turned about the axis, with noise of a share of each texel."""
    radiance = np.full((SIZE, SIZE, 3), 0.3, np.float32) * np.array([1, 0.8, 0.6], np.float32)
    for azimuth_deg, value in LAMPS:
        azimuth = np.radians(azimuth_deg + turn_deg)
        toward = np.array([np.cos(azimuth), np.sin(azimuth), 1]) / np.sqrt(2)
        radiance[texel_directions(SIZE) @ toward > np.cos(np.radians(4))] = value
    gain = 1 + noise * np.random.default_rng(seed).standard_normal(radiance.shape, np.float32)
    return replace(
        sample_map(),
        radiance=radiance * np.maximum(gain, 0),
        seen=np.ones((SIZE, SIZE), bool),
        world_from_fisheye=np.eye(4),
    )


def frame(seen: RadianceMap | None, time_s: float = 0.0) -> ViewFrame:
    picture = np.zeros((3, 4, 3), np.uint8)
    return ViewFrame(0, round(time_s * SECOND), picture, CAMERA, radiance_map=seen)


def cut(cutter: LightCutter, seen: RadianceMap, time_s: float = 0.0) -> SkyLights:
    sky = cutter.update(frame(seen, time_s))
    assert sky is not None
    return sky


def flux(sky: SkyLights) -> np.ndarray:
    """Lights and residual over what the map shows."""
    solid_angles = (sphere(RESIDUAL_SIZE)[..., None] * sky.seen).astype(np.float64)
    return np.asarray(
        (solid_angles * sky.residual).sum(axis=(0, 1)) + sum(light.irradiance for light in sky.lights)
    )


def test_lights_and_residual_are_the_map() -> None:
    """To 0.3 %, by which the resampling of the residual to the world errs; the cut itself is exact."""
    seen = lit_map(noise=0.2)
    sky = cut(LightCutter(LightCut()), seen)
    assert len(sky.lights) == len(sky.regions) == 3
    whole = (seen.radiance * texel_solid_angles(SIZE)[..., None]).sum(axis=(0, 1), dtype=np.float64)
    assert flux(sky) == pytest.approx(whole, rel=3e-3)
    assert sum(light.irradiance[0] for light in sky.lights) > 0.5 * whole[0]
    assert sky.residual.min() >= 0
    assert sky.seen.max() <= 1


def test_identities_outlast_noise_and_a_slow_turn() -> None:
    """A full turn in steps of 15 degrees: each light meets the place of every other one, and keeps its number."""
    cutter = LightCutter(LightCut(smoothing_s=0.2))
    first = cut(cutter, lit_map())
    numbers = {round(each.irradiance[0], 6): each.identity for each in first.lights}
    assert len(numbers) == 3
    for step in range(1, 25):
        sky = cut(cutter, lit_map(15.0 * step, 0.1, step), step / 10)
        assert {each.identity for each in sky.lights} == {1, 2, 3}
    settled = cutter.update(frame(None, 99.0))
    assert settled is not None
    for strength, identity in numbers.items():
        (same,) = [each for each in settled.lights if each.identity == identity]
        assert same.irradiance[0] == pytest.approx(strength, rel=0.05)


def test_the_sum_follows_a_map_that_changes_at_once() -> None:
    cutter = LightCutter(LightCut(smoothing_s=0.5))
    brighter = replace(lit_map(60.0), radiance=2 * lit_map(60.0).radiance)
    before, wanted = flux(cut(cutter, lit_map())), flux(cut(LightCutter(LightCut()), brighter))
    assert flux(cut(cutter, brighter, 1.0)) == pytest.approx(before, rel=1e-6)
    after = cutter.update(frame(None, 1.5))
    assert after is not None
    assert flux(after) == pytest.approx(wanted + np.exp(-1) * (before - wanted), rel=1e-6)


def test_lights_that_do_not_change_are_not_told_again() -> None:
    cutter, seen = LightCutter(LightCut()), lit_map()
    assert cutter.update(frame(None)) is None
    cut(cutter, seen)
    assert cutter.update(frame(seen, 1.0)) is None


def test_a_reflection_that_depth_shows_goes_back_to_the_residual() -> None:
    """The camera looks along +x, -y, +z: a surface half a metre away hides the lamp at azimuth 0."""
    seen = replace(lit_map(), world_from_fisheye=np.eye(4))
    forward = np.array([1.0, 0, 1]) / np.sqrt(2)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([np.cross([0, 1.0, 0], forward), [0, 1, 0], forward], axis=1)
    wall = DepthImage(np.full((3, 4), 0.5, np.float32), np.ones((3, 4), bool), CAMERA)
    lit = cut(LightCutter(LightCut()), seen)
    hidden = LightCutter(LightCut()).update(replace(frame(seen), depth=wall, pose=BoardPose(pose)))
    assert hidden is not None
    assert len(hidden.lights) == 2
    assert flux(hidden) == pytest.approx(flux(lit), rel=3e-3)
