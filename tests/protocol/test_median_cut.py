"""Splitting fish-eye maps: lights and residual are the map, and what cannot be a light goes back."""

from pathlib import Path

import numpy as np
import pytest

from deltalight.protocol.frames import LUMINANCE
from deltalight.protocol.hemisphere import texel_directions, texel_solid_angles
from deltalight.protocol.hemisphere_map import HemisphereMap, to_world
from deltalight.protocol.median_cut import RegionLight, Split, split_map
from deltalight.protocol.octahedral import octahedral_grid, sample_octahedral
from deltalight.protocol.octahedral import texel_solid_angles as sphere
from deltalight.render_server.lights.environment import (
    WORK_SIZE,
    EnvironmentMap,
    read_radiance,
    split_environment,
)

SIZE = 128
TILTED = np.array([[0.8, 0.0, 0.6], [0.0, 1.0, 0.0], [-0.6, 0.0, 0.8]])


def unit(*vector: float) -> np.ndarray:
    return np.array(vector) / np.linalg.norm(vector)


def hemisphere(
    *lamps: tuple[np.ndarray, float, float],
    ambient: float = 0.2,
    size: int = SIZE,
    turned: np.ndarray | None = None,
) -> HemisphereMap:
    """A grey map with discs: (direction in map axes, angular radius in degrees, radiance)."""
    directions = texel_directions(size)
    radiance = np.full((size, size, 3), ambient, np.float32)
    for toward, radius_deg, value in lamps:
        radiance[directions @ toward > np.cos(np.radians(radius_deg))] = value * np.array([1, 0.8, 0.6])
    world_from_map = np.eye(3) if turned is None else turned
    return HemisphereMap(radiance, np.ones((size, size), bool), world_from_map)


def flux(sky: HemisphereMap | EnvironmentMap) -> np.ndarray:
    return (sky.radiance * sky.grid.solid_angles[..., None]).sum(axis=(0, 1), dtype=np.float64)


def normals() -> np.ndarray:
    vectors = np.random.default_rng(3).normal(size=(40, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def irradiance_of_map(sky: HemisphereMap | EnvironmentMap) -> np.ndarray:
    """Irradiance on each of the normals (world), the plain sum."""
    directions = sky.grid.directions.reshape(-1, 3) @ sky.world_from_map.T
    weighted = sky.radiance.reshape(-1, 3) * sky.grid.solid_angles.reshape(-1, 1)
    return np.maximum(normals() @ directions.T, 0) @ weighted.astype(np.float64)


def irradiance_of_lights(lights: tuple[RegionLight, ...]) -> np.ndarray:
    """Irradiance on each of the normals from uniform discs of the lights' sizes, as the renderer samples them."""
    total = np.zeros((len(normals()), 3))
    index = np.arange(400) + 0.5
    for light in lights:
        cosine = 1 - index / 400 * (1 - np.cos(light.angular_radius_rad))
        turn, sine = index * 2.399963, np.sqrt(1 - cosine**2)
        side = unit(*np.cross(light.to_light, (0.3, 0.5, 0.8)))
        around = np.cos(turn)[:, None] * side + np.sin(turn)[:, None] * np.cross(light.to_light, side)
        disc = cosine[:, None] * light.to_light + sine[:, None] * around
        total += np.maximum(normals() @ disc.T, 0).mean(axis=1)[:, None] * light.irradiance
    return total


def require_the_map(
    split: Split[HemisphereMap] | Split[EnvironmentMap],
    sky: HemisphereMap | EnvironmentMap,
    within: float = 0.01,
) -> None:
    """Lights and residual are the map within 0.1 % of its flux, and within 1 % as irradiance of any normal."""
    lights = sum((light.irradiance for light in split.lights), np.zeros(3))
    assert flux(split.residual) + lights == pytest.approx(flux(sky), rel=1e-3)
    expected = irradiance_of_map(sky)
    found = irradiance_of_map(split.residual) + irradiance_of_lights(split.lights)
    assert np.abs(found - expected).max() < within * expected.max()
    assert split.residual.radiance.min() >= 0


@pytest.mark.parametrize("turned", [None, TILTED])
def test_lamps_on_a_hemisphere_are_found(turned: np.ndarray | None) -> None:
    lamps = [(unit(1, 0.2, 0.6), 4.5, 60.0), (unit(-1, 0.5, 1), 4.0, 90.0), (unit(0, -1, 0.4), 4.0, 70.0)]
    sky = hemisphere(*lamps, turned=turned)
    split = split_map(sky, 4)
    assert len(split.lights) == 3
    require_the_map(split, sky)
    for toward, radius_deg, value in lamps:
        in_world = toward if turned is None else turned @ toward
        light = max(split.lights, key=lambda one: float(one.to_light @ in_world))
        assert np.degrees(np.arccos(min(1.0, light.to_light @ in_world))) < 0.5
        assert np.degrees(light.angular_radius_rad) == pytest.approx(radius_deg, rel=0.06)
        whole = value * np.array([1, 0.8, 0.6]) * 2 * np.pi * (1 - np.cos(np.radians(radius_deg)))
        assert light.irradiance == pytest.approx(whole, rel=0.12)  # discs of whole texels


@pytest.mark.parametrize("count", [1, 3, 8, 16])
def test_lights_and_residual_are_any_map(count: int) -> None:
    rng = np.random.default_rng(count)
    lamps = [(unit(*rng.normal(size=2), rng.uniform(0.3, 2)), rng.uniform(2, 7), 80.0) for _ in range(5)]
    sky = hemisphere(*lamps)
    sky = sky.with_radiance(sky.radiance * rng.uniform(0.5, 1.5, sky.radiance.shape).astype(np.float32))
    split = split_map(sky, count)
    assert 1 <= len(split.lights) <= count
    if (
        count >= 8
    ):  # else lamps far apart become one light, whose energy is right and whose direction is between
        require_the_map(split, sky)
    total = flux(split.residual) + sum(light.irradiance for light in split.lights)
    assert total == pytest.approx(flux(sky), rel=1e-3)


def test_cutting_the_whole_map_leaves_nothing() -> None:
    sky = hemisphere((unit(1, 0, 1), 10.0, 5.0))
    split = split_map(sky, 16, whole_map=True)
    assert len(split.lights) == 16
    assert split.residual.radiance.max() == 0
    assert sum(light.irradiance for light in split.lights) == pytest.approx(flux(sky), rel=1e-3)


def test_what_was_not_seen_does_not_count_as_dark() -> None:
    """Lamps leave the mean of what else was seen, however little of the sky that is."""
    whole = hemisphere((unit(0.3, 0, 1), 4.0, 30.0), ambient=0.5)
    seen = texel_directions(SIZE)[..., 2] > 0.7
    masked = HemisphereMap(whole.radiance * seen[..., None], seen, whole.world_from_map)
    assert split_map(whole, 4).lights[0].irradiance @ LUMINANCE > 0
    bright, weight = masked.radiance @ LUMINANCE, texel_solid_angles(SIZE) * seen
    rest = weight * (bright <= 4 * (bright * weight).sum() / weight.sum())
    left = split_map(masked, 4).residual.radiance @ LUMINANCE
    assert left[(weight > 0) & (rest == 0)] == pytest.approx((bright * rest).sum() / rest.sum(), rel=1e-3)


def test_hidden_lights_go_back() -> None:
    near, far = unit(1, 0, 0.5), unit(-1, 0, 1)
    sky = hemisphere((near, 4.0, 60.0), (far, 4.0, 60.0))
    split = split_map(sky, 4, is_occluded=lambda toward: bool(toward @ near > 0.9))
    (light,) = split.lights
    assert light.to_light @ far > 0.999
    require_the_map(split, sky)


def test_residual_goes_to_the_world_with_its_energy() -> None:
    sky = hemisphere((unit(1, 0.2, 0.6), 15.0, 2.0), turned=TILTED)
    world = to_world(sky, 64)
    energy = (world.radiance * sphere(64)[..., None]).sum(axis=(0, 1))
    assert energy == pytest.approx(flux(sky), rel=0.01)
    assert (world.seen[..., 0] * sphere(64)).sum() == pytest.approx(2 * np.pi, rel=0.01)
    lamp = (TILTED @ unit(1, 0.2, 0.6))[None, None]
    assert sample_octahedral(world.radiance, lamp)[0, 0] == pytest.approx([2.0, 1.6, 1.2], rel=0.02)


def test_unseen_directions_are_like_what_is_seen_beside_them() -> None:
    """A sky red towards +x and blue towards -x, of which the lowest 30 degrees are not seen."""
    directions = texel_directions(SIZE)
    red = directions[..., :1] > 0
    radiance = np.where(red, [1.0, 0, 0], [0, 0, 1.0]).astype(np.float32)
    seen = directions[..., 2] > 0.5
    filled = to_world(HemisphereMap(radiance * seen[..., None], seen, np.eye(3)), 64).filled()
    low = octahedral_grid(64)
    low = np.abs(low[..., 2] - 0.2) < 0.1
    for side, channel in (1, 0), (-1, 2):
        there = filled[low & (side * octahedral_grid(64)[..., 0] > 0.8)]
        assert there[:, channel].min() > 0.8
    assert filled.sum(axis=-1) == pytest.approx(np.ones((64, 64)), abs=0.02)


@pytest.mark.data
@pytest.mark.parametrize(
    ("count", "within"), [(4, 0.02), (16, 0.01)]
)  # four lights are wide: discs of another shape
def test_real_maps_are_lights_and_residual(shared_data: Path, count: int, within: float) -> None:
    maps = [path for path in (shared_data / "hdr_env").rglob("*") if path.suffix in (".hdr", ".exr")]
    assert len(maps) > 8
    for path in sorted(maps):
        environment = EnvironmentMap(read_radiance(path), np.eye(3)).resized(*WORK_SIZE)
        require_the_map(split_environment(environment, count), environment, within)
        sky = upper_half(environment)
        require_the_map(split_map(sky, count), sky, within)


def upper_half(environment: EnvironmentMap) -> HemisphereMap:
    radiance = environment.sample(texel_directions(256))
    return HemisphereMap(radiance, np.ones((256, 256), bool), np.eye(3))
