"""Planes that go on beyond the picture: found, continued as far as is likely, and lit as the lights light them."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from jaxtyping import Float32, Float64

from deltalight.protocol.frames import decode_lut
from deltalight.protocol.octahedral import octahedral_grid, sample_octahedral
from deltalight.protocol.scene import SceneDocument
from deltalight.render_server.estimation.plane_extrapolation import (
    DetectedPlane,
    ExtrapolatedPlanes,
    PointCloud,
    RealSamples,
    ViewFrustum,
    detect_planes,
    extrapolate_planes,
)
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.lights.light_models import DirectionalLight, Light, SphereLight
from deltalight.render_server.renderer import SceneRenderer
from tests.render_server.scenes import COARSE, Stage, ambient, cube, floor, frame, look_at, plain, shifted

SIZE = 32
DIRECTIONS = octahedral_grid(SIZE).reshape(-1, 3)
EYE, CENTRE = np.array([0, -1.0, 0.5]), np.array([0, 0, 0.5])
VIEW = np.array([0.5, 0.5])  # greatest x / z and y / z: at 2 m, 1 m to each side
SIGHT = ViewFrustum(
    np.linalg.inv(look_at((0, -1.0, 0.5), (0, 1.0, 0.5)).world_from_camera.astype(np.float64)), -VIEW, VIEW
)


def wall(
    axis: int, at: float, towards: float, spread: Float64[np.ndarray, "k 2"]
) -> tuple[Float64[np.ndarray, "k 3"], Float64[np.ndarray, "3"]]:
    """Points of a plane across an axis, and its normal."""
    points = np.insert(spread, axis, at, axis=1)
    normal = np.zeros(3)
    normal[axis] = towards
    return points, normal


def evenly(
    low: tuple[float, float], high: tuple[float, float], count: int = 30
) -> Float64[np.ndarray, "k 2"]:
    one, other = (np.linspace(a, b, count) for a, b in zip(low, high, strict=True))
    return np.stack(np.meshgrid(one, other), axis=-1).reshape(-1, 2)


def shown(
    *parts: tuple[Float64[np.ndarray, "k 3"], Float64[np.ndarray, "3"], float],
) -> tuple[list[DetectedPlane], RealSamples]:
    """Planes (points, normal, radiance) as samples that no known light explains."""
    position = np.concatenate([points for points, _, _ in parts])
    number = np.repeat(np.arange(len(parts)), [len(points) for points, _, _ in parts])
    planes = [
        DetectedPlane(normal, float(points[0] @ normal), number == each)
        for each, (points, normal, _) in enumerate(parts)
    ]
    radiance = np.array([radiance for _, _, radiance in parts])[number]
    none = np.zeros((len(position), 3))
    samples = RealSamples(
        position, none + radiance[:, None], np.ones(len(position)), none, np.full(len(position), 0.01)
    )
    return planes, samples


def continued(
    planes: list[DetectedPlane], samples: RealSamples, lights: tuple[Light, ...] = ()
) -> ExtrapolatedPlanes:
    return extrapolate_planes(planes, samples, lights, SIGHT, centre=CENTRE, size=SIZE)


AHEAD = wall(1, 1.0, -1.0, evenly((-1, -0.5), (1, 1.5)))  # fills the view, whose middle is its own


def test_the_planes_of_a_noisy_corner_are_found_the_largest_first_and_always_the_same() -> None:
    rng = np.random.default_rng(2)
    parts = [
        wall(2, 0.0, 1.0, rng.uniform(-1, 2, (3000, 2))),
        wall(0, -1.0, 1.0, rng.uniform(0, 2, (2000, 2))),
        wall(1, 2.0, -1.0, rng.uniform(0, 2, (1000, 2))),
    ]
    position = np.concatenate([points for points, _ in parts] + [rng.uniform(0, 1, (600, 3))])
    normal = np.concatenate(
        [np.tile(unit, (len(points), 1)) for points, unit in parts] + [np.zeros((600, 3))]
    )
    normal[6000:] = rng.normal(size=(600, 3))
    normal += rng.normal(0, 0.05, normal.shape)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    position += rng.normal(0, 0.003, position.shape)
    order = rng.permutation(len(position))
    cloud = PointCloud(position[order], normal[order], np.full(len(order), 0.01))
    found, again = detect_planes(cloud), detect_planes(cloud)
    assert len(found) == 3
    for plane, (points, unit) in zip(found, parts, strict=True):
        assert plane.normal @ unit > np.cos(np.radians(0.5))
        assert plane.offset == pytest.approx(points[0] @ unit, abs=0.005)
        assert plane.inliers.sum() == pytest.approx(len(points), rel=0.05)
    assert (np.sum([plane.inliers for plane in found], axis=0) <= 1).all()
    for one, other in zip(found, again, strict=True):
        assert np.array_equal(one.normal, other.normal)
        assert one.offset == other.offset


def test_inliers_of_many_planes_are_counted_as_those_of_each() -> None:
    rng = np.random.default_rng(5)
    normal = rng.normal(size=(300, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    cloud = PointCloud(rng.uniform(0, 1, (300, 3)), normal, rng.uniform(0, 0.2, 300))
    axes, offsets = normal[:45], rng.uniform(-1, 1, 45)
    each = [np.count_nonzero(cloud.inliers(*plane)) for plane in zip(axes, offsets, strict=True)]
    assert cloud.count_inliers(axes, offsets).tolist() == each
    assert any(each)


@pytest.mark.parametrize("count", [0, 2, 500])
def test_where_no_plane_is_none_is_found(count: int) -> None:
    rng = np.random.default_rng(3)
    normal = rng.normal(size=(count, 3))
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
    assert detect_planes(PointCloud(rng.uniform(0, 1, (count, 3)), normal, np.full(count, 0.002))) == []
    assert not continued([], shown((*AHEAD, 1.0))[1]).probability.any()


def test_a_wall_goes_on_with_the_probability_that_its_seen_length_gives() -> None:
    found = continued(*shown((*AHEAD, 0.3)))
    met = DIRECTIONS[:, 1] > 0
    place = CENTRE + DIRECTIONS[met] / DIRECTIONS[met, 1:2]  # 1 m ahead
    beyond = np.maximum(
        np.abs(place[:, [0, 2]] - CENTRE[[0, 2]]).max(axis=1), 1
    )  # in halves of the seen length
    share = found.probability.reshape(-1)
    assert share[met] == pytest.approx(2 / (1 + beyond), rel=1e-5)
    assert (share[~met] == 0).all()
    assert found.radiance.reshape(-1, 3)[met] == pytest.approx(0.3, rel=1e-5)


def test_a_long_wall_is_likely_to_be_high() -> None:
    """Of a wall the view shows 2 m by 0.2 m: it reaches d above that with probability 2 / (2 + d)."""
    low = ViewFrustum(SIGHT.camera_from_world, *(sign * np.array([0.5, 0.05]) for sign in (-1, 1)))
    strip = shown((*wall(1, 1.0, -1.0, evenly((-1, 0.4), (1, 0.6))), 0.3))
    found = extrapolate_planes(*strip, (), low, centre=CENTRE, size=SIZE).probability.reshape(-1)
    place = CENTRE + DIRECTIONS / np.where(DIRECTIONS[:, 1:2] > 0, DIRECTIONS[:, 1:2], np.inf)
    above = (DIRECTIONS[:, 1] > 0) & (np.abs(place[:, 0]) < 0.1) & (place[:, 2] > 0.7)
    away = np.linalg.norm(place[above] - CENTRE - (0, 1, 0), axis=1)
    beyond = away * (1 - 0.1 / (place[above, 2] - CENTRE[2]))
    assert above.sum() >= 2
    assert found[above] == pytest.approx(2 / (2 + beyond), rel=1e-3)


def test_a_strip_of_a_wall_beside_a_long_one_goes_on_as_that_does() -> None:
    """The view shows 0.2 m of it, which reaches d farther with 0.2 / (0.2 + d); at the end of 2 m, 2 / (2 + d)."""
    strip = wall(0, 0.9, -1.0, evenly((0.8, 0.45), (1, 0.55)))
    end = wall(1, 1.0, -1.0, evenly((-1, -0.5), (0.9, 1.5)))
    place = CENTRE + 0.9 * DIRECTIONS / np.where(DIRECTIONS[:, :1] > 0, DIRECTIONS[:, :1], np.inf)
    beside = (DIRECTIONS[:, 0] > 0) & (place[:, 1] < 0) & (np.abs(place[:, 2] - 0.5) < 1e-9)
    beyond = 0.8 - place[beside, 1]
    assert beside.sum() >= 4
    for parts, length in (([(*strip, 0.3)], 0.2), ([(*strip, 0.3), (*end, 0.3)], 2.0)):
        found = continued(*shown(*parts)).probability.reshape(-1)[beside]
        assert found == pytest.approx(length / (length + beyond), rel=1e-5)


@pytest.mark.parametrize(("noise_m", "is_continued"), [(0.0005, True), (0.02, False)])
def test_a_strip_goes_on_only_if_its_slant_is_certain(noise_m: float, is_continued: bool) -> None:
    """Of 16 points over 10 cm, noise of 0.5 mm turns the wall by less than a degree, 2 cm by many."""
    points, normal, radiance = *wall(0, 0.9, -1.0, evenly((0.9, 0.45), (1, 0.55), 4)), 0.3
    points[:, 0] += np.random.default_rng(0).normal(0, noise_m, len(points))
    found = continued(*shown((points, normal, radiance))).probability
    assert bool(found.any()) == is_continued


def test_a_wall_reaches_as_far_as_lamps_say_that_the_room_does() -> None:
    """The view shows 2 m of it. With a lamp 4 m to the right of its middle, 5 m are known; not with one behind it."""
    planes, samples = shown((*AHEAD, 0.3))
    lamp, outside = (
        SphereLight(np.array([4, y, 0.5], np.float32), np.zeros(3, np.float32), 0.02) for y in (0.999, 1.1)
    )
    sun = DirectionalLight(np.array([0, 1, 0], np.float32), np.zeros(3, np.float32), 0.0)
    place = CENTRE + DIRECTIONS / np.where(DIRECTIONS[:, 1:2] > 0, DIRECTIONS[:, 1:2], np.inf)
    left = (DIRECTIONS[:, 1] > 0) & (place[:, 0] < -1) & (np.abs(place[:, 2] - 0.5) < 1e-9)
    beyond = -1 - place[left, 0]
    assert left.sum() >= 4
    for light, length in ((lamp, 5.0), (outside, 2.0), (sun, 2.0)):
        found = continued(planes, samples, (light,)).probability.reshape(-1)[left]
        assert found == pytest.approx(length / (length + beyond), rel=1e-5)


def test_what_a_wall_shines_with_is_what_the_light_makes_there() -> None:
    position, intensity, albedo = np.array([1.5, 0.2, 1.5]), np.array([2.0, 1.5, 1.0]), 0.4
    lamp = SphereLight(position.astype(np.float32), intensity.astype(np.float32), 0.02)

    def thrown(places: Float64[np.ndarray, "k 3"]) -> Float64[np.ndarray, "k 3"]:
        """Radiance of the wall at places: I cos / d^2, reflected evenly."""
        distance = np.linalg.norm(position - places, axis=1)
        return albedo / np.pi * ((1 - position[1]) / distance**3)[:, None] * intensity

    planes, samples = shown((*AHEAD, 0.0))
    lit = RealSamples(
        samples.position, thrown(samples.position), samples.lit, samples.indirect, samples.tolerance_m
    )
    found = continued(planes, lit, (lamp,)).radiance.reshape(-1, 3)
    met = DIRECTIONS[:, 1] > 0.05
    place = CENTRE + DIRECTIONS[met] / DIRECTIONS[met, 1:2]
    assert found[met] == pytest.approx(thrown(place), rel=1e-3, abs=1e-5)


def test_a_thing_that_has_the_room_behind_it_ends_where_it_ends() -> None:
    ground = wall(2, 0.0, 1.0, evenly((-1, 0), (1, 2)))
    box = wall(1, 0.5, -1.0, evenly((-0.2, 0), (0.2, 0.4)))
    planes, samples = shown((*ground, 0.2), (*box, 0.7))
    found = continued(planes, samples)
    only_ground = continued(planes[:1], samples)
    np.testing.assert_array_equal(found.probability, only_ground.probability)
    assert (found.probability.reshape(-1)[DIRECTIONS[:, 2] >= 0] == 0).all()
    assert (found.probability.reshape(-1)[DIRECTIONS[:, 2] < 0] > 0).all()


def test_nearer_planes_stand_before_farther_ones() -> None:
    end, side = (
        wall(1, 1.0, -1.0, evenly((-1, -0.5), (0.6, 1.5))),
        wall(0, 0.6, -1.0, evenly((0.3, -0.5), (1, 1.5))),
    )  # as high as each other: neither makes the other one more likely
    planes, samples = shown((*end, 0.3), (*side, 0.9))
    both = continued(planes, samples)
    ahead, aside = (continued([plane], samples) for plane in planes)
    one, other = ahead.probability, aside.probability
    assert both.probability == pytest.approx(one + (1 - one) * other, abs=1e-6)
    x, y = DIRECTIONS[:, 0].reshape(one.shape), DIRECTIONS[:, 1].reshape(one.shape)
    for nearer, first, second, radiance in (
        (0.6 * y > x, one, other, (0.3, 0.9)),
        (x > 0.6 * y, other, one, (0.9, 0.3)),
    ):
        mixed = first * radiance[0] + (1 - first) * second * radiance[1]
        seen = both.probability * both.radiance
        assert seen[nearer[..., 0]] == pytest.approx(np.repeat(mixed[nearer[..., 0]], 3, axis=1), abs=1e-5)


ROOM = 1.0  # radiance of the light that is given, from everywhere


def corner(stage: Stage, surroundings: str) -> SceneDocument:
    """A floor and a wall that the picture's borders cut, under even light; a small cube before the wall."""
    behind = shifted(trimesh.creation.box((8, 0.02, 6)), 0, 0.61, 3)
    real = trimesh.util.concatenate([floor(4), behind])
    made = stage.document([stage.virtual(cube(0.1))], [ambient(ROOM)], real)
    return made.replaced(lights=made.lights.model_copy(update={"surroundings": surroundings}))


def environment(gpu: GpuContext, document: SceneDocument) -> tuple[Float32[np.ndarray, "n n 3"], bytes]:
    """The environment that a renderer uses after its first frame, and its picture."""
    renderer = SceneRenderer(gpu, document)
    color = renderer.render(frame(plain(120))).color.tobytes()
    assert renderer.graph is not None
    lights = renderer.graph["light set"]
    renderer.release()
    return lights.environment, color


@pytest.mark.slow
@pytest.mark.usefixtures("clean_gl")
def test_the_wall_in_the_picture_goes_on_beside_it_unless_nothing_is_to_be_found(
    gpu: GpuContext, tmp_path: Path
) -> None:
    radiance = float(decode_lut(None)[120, 0])
    directions = np.array([[(0.9, 0.6, 0.1), (-0.9, 0.6, 0.1), (0.1, -0.5, 0.9)]])
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    found, picture = environment(gpu, corner(Stage(tmp_path, COARSE), "auto"))
    *beside, above = sample_octahedral(found, directions)[0]
    assert radiance < 0.25 * ROOM
    assert (np.array(beside) < 0.6 * ROOM).all()
    assert (np.array(beside) > 0.95 * radiance).all()
    assert above == pytest.approx(ROOM, rel=1e-3)
    again, same = environment(gpu, corner(Stage(tmp_path, COARSE), "auto"))
    np.testing.assert_array_equal(found, again)
    assert picture == same
    given, _ = environment(gpu, corner(Stage(tmp_path, COARSE), "none"))
    assert given == pytest.approx(ROOM, rel=1e-6)
