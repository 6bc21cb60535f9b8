"""How far lights are, by the shading and the shadows of a box on a table."""

from dataclasses import replace

import numpy as np
import pytest

from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.frames import BoardPose, DepthImage, ViewFrame
from deltalight.protocol.scene_lights import LightCut, Lights
from deltalight.protocol.sky_lights import SkyLights, TrackedLight
from deltalight.render_server.lights.light_distance import common_inverse
from deltalight.render_server.lights.light_models import DirectionalLight, SphereLight
from deltalight.render_server.lights.shading_distance import Shading
from deltalight.render_server.lights.sources import FisheyeSource

LOW, HIGH = np.array([-0.12, 0.05, 0.0]), np.array([-0.02, 0.12, 0.1])
"""Corners of the box; the fish-eye camera stands beside it."""
FISHEYE = np.array([0.05, 0.0, 0.02])
TO_LIGHT = np.array([0.6, -0.5, 0.7]) / np.linalg.norm([0.6, -0.5, 0.7])
TO_OTHER = np.array([-0.7, -0.4, 0.6]) / np.linalg.norm([-0.7, -0.4, 0.6])
AMBIENT, SUN = 0.1, 1.5


def camera(lens: tuple[float, ...] = ()) -> CameraModel:
    matrix = np.array([[280.0, 0, 159.5], [0, 280.0, 119.5], [0, 0, 1]])
    return CameraModel(320, 240, matrix, "plumb_bob", np.array(lens))


def pose() -> np.ndarray:
    """Half a metre from the table, looking down at 40 degrees."""
    forward = np.array([0, np.cos(0.7), -np.sin(0.7)])
    right = np.array([1.0, 0, 0])
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    matrix[:3, 3] = np.array([0, 0.05, 0.0]) - 0.5 * forward
    return matrix


def enters_box(origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance along each ray at which it enters the box (inf: never), and the axis of the face."""
    with np.errstate(divide="ignore", invalid="ignore"):
        one, other = (LOW - origins) / directions, (HIGH - origins) / directions
    enter, leave = np.minimum(one, other), np.maximum(one, other)
    near = np.nanmax(enter, axis=-1)
    hit = (near <= np.nanmin(leave, axis=-1)) & (near > 1e-4)
    return np.where(hit, near, np.inf), np.nanargmax(enter, axis=-1)


def lamp_light(
    direction: np.ndarray, distance_m: float | None, points: np.ndarray, normals: np.ndarray
) -> np.ndarray:
    """Irradiance by a lamp in a direction from the fish-eye camera, with the box's shadow."""
    inverse = 0.0 if distance_m is None else 1 / distance_m
    to_lamp = direction - inverse * (points - FISHEYE)
    far = np.linalg.norm(to_lamp, axis=-1)
    toward = to_lamp / far[..., None]
    lit = np.isinf(enters_box(points + 1e-3 * normals, toward)[0])
    return np.asarray(lit * SUN * np.maximum((toward * normals).sum(axis=-1), 0) / far**2)


def scene(
    distance_m: float | None, lens: tuple[float, ...] = (), *, other_m: float | None = None
) -> ViewFrame:
    """A photograph of the box under a lamp, or under the sun: lit, shadowed, of two albedos, with noise.

    A second lamp may shine from the other side.
    """
    model, world_from_camera = camera(lens), pose()
    rays = np.insert(model.rays().astype(float), 2, 1.0, axis=2) @ world_from_camera[:3, :3].T
    eye = np.broadcast_to(world_from_camera[:3, 3], rays.shape)
    box, axis = enters_box(eye, rays)
    floor = -eye[..., 2] / rays[..., 2]
    depth = np.minimum(box, floor)
    points = eye + depth[..., None] * rays
    normals = np.where((box < floor)[..., None], -np.eye(3)[axis] * np.sign(rays), [0, 0, 1.0])
    irradiance = AMBIENT * np.pi + lamp_light(TO_LIGHT, distance_m, points, normals)
    if other_m is not None:
        irradiance += lamp_light(TO_OTHER, other_m, points, normals)
    tiles = (np.floor(points[..., 0] / 0.09) + np.floor(points[..., 1] / 0.09)) % 2
    rng = np.random.default_rng(3)
    radiance = irradiance * np.where(tiles, 0.6, 0.25) / np.pi * rng.normal(1, 0.02, depth.shape)
    coded = np.where(
        radiance < 0.0031308, 12.92 * radiance, 1.055 * np.maximum(radiance, 0) ** (1 / 2.4) - 0.055
    )
    color = np.repeat(np.clip(coded * 255 + 0.5, 0, 255).astype(np.uint8)[..., None], 3, axis=-1)
    noisy = (depth + rng.normal(0, 0.0005, depth.shape) * depth**2).astype(np.float32)
    image = DepthImage(noisy, np.ones(depth.shape, bool), model, 0.0005)
    return ViewFrame(0, 0, color, model, pose=BoardPose(world_from_camera), depth=image)


def sky(*directions: np.ndarray) -> SkyLights:
    fisheye = np.eye(4)
    fisheye[:3, 3] = FISHEYE
    residual = np.full((32, 32, 3), AMBIENT, np.float32)
    lights = tuple(
        TrackedLight(identity, toward, np.full(3, SUN), 0.005)
        for identity, toward in enumerate(directions or (TO_LIGHT,))
    )
    return SkyLights(LightCut(), fisheye, lights, (), residual, np.ones((32, 32, 1), np.float32))


def distance_by_shading(frame: ViewFrame, given: SkyLights) -> float | None:
    """The distance that shading and shadows tell alone; None where they tell nothing."""
    shading = Shading.of(frame, given)
    assert shading is not None
    assert shading.cue is not None
    return 1 / common_inverse([shading.cue]) if shading.cue.tells_near else None


@pytest.mark.parametrize("distance_m", [0.5, 0.8, 1.4])
def test_shading_tells_how_far_a_lamp_is(distance_m: float) -> None:
    assert distance_by_shading(scene(distance_m), sky()) == pytest.approx(distance_m, rel=0.15)


def test_a_lens_that_bends_lines_changes_nothing() -> None:
    straight, bent = (distance_by_shading(scene(0.8, lens), sky()) for lens in ((), (-0.25, 0.08, 0, 0)))
    assert bent == pytest.approx(straight, rel=0.1)


def test_the_sun_stays_far() -> None:
    assert distance_by_shading(scene(None), sky()) is None


def test_only_the_mix_of_the_maps_light_counts_not_its_scale() -> None:
    """The fish-eye camera's units need not be the colour camera's, but more ambient light is softer shading."""
    frame, given = scene(0.8), sky()
    (light,) = given.lights
    scaled = replace(
        given, lights=(replace(light, irradiance=5 * light.irradiance),), residual=5 * given.residual
    )
    assert distance_by_shading(frame, scaled) == pytest.approx(distance_by_shading(frame, given), rel=1e-3)
    ambient = distance_by_shading(frame, replace(given, residual=5 * given.residual))
    assert ambient != pytest.approx(distance_by_shading(frame, given), rel=0.01)


def test_frames_that_show_nothing_say_nothing() -> None:
    frame = scene(0.8)
    assert frame.depth is not None
    nothing = replace(frame.depth, valid=np.zeros_like(frame.depth.valid))
    black = np.zeros_like(frame.color)
    for blind in (
        replace(frame, depth=None),
        replace(frame, pose=None),
        replace(frame, depth=nothing),
        replace(frame, color=black),
    ):
        assert Shading.of(blind, sky()) is None


def test_lamps_come_near_without_a_board() -> None:
    for distance_m, kind in ((0.8, SphereLight), (None, DirectionalLight)):
        source = FisheyeSource(Lights.model_validate({"mode": "fisheye"}))
        lights = source.update(replace(scene(distance_m), sky_lights=sky()))
        assert lights is not None
        (light,) = lights.lights
        assert isinstance(light, kind)
        if isinstance(light, SphereLight):
            assert np.linalg.norm(light.position - FISHEYE) == pytest.approx(0.8, rel=0.15)
            assert "shading and shadows" in source.remarks[0]


@pytest.mark.parametrize(("one_m", "other_m"), [(0.6, 1.8), (1.5, 0.7)])
def test_lamps_at_different_distances_each_have_their_own(one_m: float, other_m: float) -> None:
    source = FisheyeSource(Lights.model_validate({"mode": "fisheye"}))
    view = replace(scene(one_m, other_m=other_m), sky_lights=sky(TO_LIGHT, TO_OTHER))
    lights = source.update(view)
    assert lights is not None
    for light, distance_m in zip(lights.lights, (one_m, other_m), strict=True):
        assert isinstance(light, SphereLight)
        assert np.linalg.norm(light.position - FISHEYE) == pytest.approx(distance_m, rel=0.2)
    assert source.remarks[0].count(" m") == 2


def test_lamps_as_far_as_each_other_share_a_distance() -> None:
    shading = Shading.of(scene(0.8, other_m=0.8), sky(TO_LIGHT, TO_OTHER))
    assert shading is not None
    assert shading.own_inverses() == {}


def test_the_lights_of_one_lamp_stay_together() -> None:
    """A large lamp is cut into lights whose discs touch."""
    across = np.cross(TO_LIGHT, [0.0, 0, 1])
    beside = TO_LIGHT + 0.2 * across / np.linalg.norm(across)
    given = sky(TO_LIGHT, TO_OTHER, beside / np.linalg.norm(beside))
    wide = replace(given, lights=tuple(replace(light, angular_radius_rad=0.12) for light in given.lights))
    shading = Shading.of(scene(0.8), wide)
    assert shading is not None
    assert [[light.identity for light in lamp] for lamp in shading.lamps] == [[0, 2], [1]]
