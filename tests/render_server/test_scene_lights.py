import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from deltalight.protocol import scene_lights as documents
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import LUMINANCE
from deltalight.protocol.octahedral import (
    octahedral_grid,
    resample_to_octahedral,
    sample_octahedral,
)
from deltalight.protocol.radiance_files import write_exr
from deltalight.render_server.lights.environment import (
    EnvironmentMap,
    load_environment,
    map_directions,
    orientation,
    pixel_solid_angles,
    split_environment,
)
from deltalight.render_server.lights.light_models import DirectionalLight, SphereLight
from deltalight.render_server.lights.lights import build_lights
from deltalight.render_server.lights.octahedral import irradiance, irradiance_map, prefilter, solid_angle_mean

SHAPE = (256, 512)


def discs(*lamps: tuple[tuple[float, float, float], float, float], ambient: float = 0.1) -> EnvironmentMap:
    """A grey map with discs: (direction, angular radius in degrees, radiance)."""
    directions = map_directions(*SHAPE)
    radiance = np.full((*SHAPE, 3), ambient, np.float32)
    for toward, radius_deg, value in lamps:
        unit = np.array(toward) / np.linalg.norm(toward)
        radiance[directions @ unit > np.cos(np.radians(radius_deg))] = value * np.array([1, 0.8, 0.6])
    return EnvironmentMap(radiance, np.eye(3))


def flux(environment: EnvironmentMap) -> np.ndarray:
    weights = pixel_solid_angles(*environment.radiance.shape[:2])[..., None]
    return (environment.radiance * weights).sum(axis=(0, 1), dtype=np.float64)


def random_directions(count: int) -> np.ndarray:
    vectors = np.random.default_rng(1).normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def test_constant_environment_gives_pi_times_radiance_everywhere() -> None:
    constant = np.full((64, 64, 3), 0.7, np.float32)
    normals = random_directions(20)
    assert irradiance(constant, normals) == pytest.approx(np.full((20, 3), 0.7 * np.pi), rel=2e-3)
    for level in prefilter(constant).levels:
        np.testing.assert_allclose(level, 0.7, rtol=1e-4)


@pytest.mark.parametrize("size", [8, 64, 256])
def test_black_has_the_levels_of_any_map(size: int) -> None:
    black, white = (prefilter(np.full((size, size, 3), value, np.float32)) for value in (0.0, 1.0))
    assert black.half_angles == white.half_angles
    assert [(each.shape, each.dtype) for each in black.levels] == [
        (each.shape, each.dtype) for each in white.levels
    ]
    assert not any(each.any() for each in black.levels)


def test_linear_sky_gives_its_closed_form() -> None:
    """L = 1 + d.z: E(n) = pi + 2 pi/3 n.z."""

    def sky(directions: np.ndarray) -> np.ndarray:
        unit = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
        return np.repeat(1 + unit[..., 2:], 3, axis=-1).astype(np.float32)

    radiance = resample_to_octahedral(sky, 64)
    normals = random_directions(30)
    expected = np.repeat(np.pi + 2 * np.pi / 3 * normals[:, 2:], 3, axis=1)
    assert irradiance(radiance, normals) == pytest.approx(expected, rel=5e-3)
    widest = prefilter(radiance)
    assert widest.half_angles[-1] == pytest.approx(np.pi / 2)
    wide = sample_octahedral(widest.levels[-1], normals[:, None])[:, 0] * np.pi
    assert wide == pytest.approx(expected, rel=0.02)
    texels = octahedral_grid(64).reshape(-1, 3)
    expected = np.repeat(np.pi + 2 * np.pi / 3 * texels[:, 2:], 3, axis=1)
    assert irradiance_map(radiance).reshape(-1, 3) == pytest.approx(expected, rel=0.02)


def test_narrow_cones_keep_a_disc_and_its_energy() -> None:
    environment = discs(((0, 1, 1), 20, 5.0), ambient=0.0)
    radiance = resample_to_octahedral(environment.sample, 128)
    filtered = prefilter(radiance)
    assert np.diff(np.log2(filtered.half_angles))[:-1] == pytest.approx(1.0)
    centre = np.array([[[0.0, 1, 1]]])
    for level, angle in zip(filtered.levels, filtered.half_angles, strict=True):
        if angle < np.radians(10):
            assert sample_octahedral(level, centre)[0, 0, 0] == pytest.approx(5.0, rel=0.02)
        assert solid_angle_mean(level) == pytest.approx(solid_angle_mean(radiance), rel=0.02)
    share = (np.sin(np.radians(20)) / np.sin(filtered.half_angles[-2])) ** 2
    assert sample_octahedral(filtered.levels[-2], centre)[0, 0, 0] == pytest.approx(5 * share, rel=0.1)


def test_sampling_over_the_maps_border_is_continuous() -> None:
    radiance = resample_to_octahedral(lambda d: np.repeat(d[..., :1], 3, axis=-1), 32)
    south = np.array([[[0.02, 0, -1.0], [-0.02, 0, -1.0], [0, 0.02, -1.0], [0, -0.02, -1.0]]])
    assert np.abs(sample_octahedral(radiance, south)).max() < 0.08


def test_directions_of_the_map_are_those_of_its_docstring() -> None:
    directions = map_directions(128, 256)
    assert directions[63:65, 127:129].mean(axis=(0, 1)) == pytest.approx([1, 0, 0], abs=1e-3)
    assert directions[63:65, 63:65].mean(axis=(0, 1)) == pytest.approx([0, 1, 0], abs=1e-3)
    assert directions[0, :, 2].min() > 0.999
    environment = EnvironmentMap(np.ascontiguousarray(directions) + 2, np.eye(3))
    looked = random_directions(500)[:, None]
    inside = np.abs(looked[..., 2]) < 0.99
    assert environment.sample(looked)[inside] == pytest.approx(looked[inside] + 2, abs=0.02)


def test_orientation_turns_about_up() -> None:
    assert orientation((0, 0, 1), 0) == pytest.approx(np.eye(3))
    assert orientation((0, 0, 1), 90) @ [1, 0, 0] == pytest.approx([0, 1, 0], abs=1e-12)
    down = orientation((0, -1, 0), 0)
    assert down @ [0, 0, 1] == pytest.approx([0, -1, 0])
    assert down @ [1, 0, 0] == pytest.approx([1, 0, 0])
    for up in ((1.0, 0, 0), (0.6, 0.0, 0.8), (-1.0, 0.01, 0)):
        matrix = orientation(up, 33)
        assert matrix.T @ matrix == pytest.approx(np.eye(3), abs=1e-12)
        assert np.linalg.det(matrix) == pytest.approx(1)


def test_lamps_are_found_with_place_energy_and_size() -> None:
    lamps = [((1, 0, 1), 4.0, 50.0), ((-1, 0.5, 0.3), 6.0, 20.0), ((0, -1, 0.1), 3.0, 80.0)]
    environment = discs(*lamps)
    split = split_environment(environment, 3)
    assert len(split.lights) == 3
    for toward, radius_deg, value in lamps:
        unit = np.array(toward) / np.linalg.norm(toward)
        light = max(split.lights, key=lambda item: float(item.to_light @ unit))
        assert np.degrees(np.arccos(min(light.to_light @ unit, 1))) < 0.3
        solid_angle = 2 * np.pi * (1 - np.cos(np.radians(radius_deg)))
        radiance = value * np.array([1, 0.8, 0.6])
        expected = radiance * (1 - 0.1 / (radiance @ LUMINANCE)) * solid_angle
        assert light.irradiance == pytest.approx(expected, rel=0.03)
        assert np.degrees(light.angular_radius_rad) == pytest.approx(radius_deg, rel=0.05)


def test_a_lamp_behind_the_seam_is_not_cut_in_two() -> None:
    split = split_environment(discs(((-1, 0, 0.2), 5.0, 40.0)), 1)
    (light,) = split.lights
    assert light.to_light == pytest.approx(np.array([-1, 0, 0.2]) / np.hypot(1, 0.2), abs=0.01)
    assert np.degrees(light.angular_radius_rad) == pytest.approx(5, rel=0.05)


def test_a_small_lamp_stays_one_light() -> None:
    assert len(split_environment(discs(((0, 1, 1), 3.0, 500.0)), 8).lights) == 1


@pytest.mark.parametrize("count", [1, 2, 4, 7, 16])
def test_lights_and_residual_are_the_map(count: int) -> None:
    rng = np.random.default_rng(count)
    environment = EnvironmentMap(rng.lognormal(0, 2, (*SHAPE, 3)).astype(np.float32), np.eye(3))
    split = split_environment(environment, count)
    total = flux(split.residual) + sum(light.irradiance for light in split.lights)
    assert total == pytest.approx(flux(environment), rel=1e-4)
    assert len(split.lights) <= count
    assert split.residual.radiance.min() >= 0


def test_faint_regions_go_back_and_even_light_gives_no_lights() -> None:
    faint = discs(((0, 0, 1), 1.0, 2.0), ((1, 0, 0), 4.0, 60.0))
    assert len(split_environment(faint, 2).lights) == 1
    even = split_environment(discs(ambient=0.5), 4)
    assert even.lights == ()
    np.testing.assert_allclose(even.residual.radiance, 0.5, rtol=1e-5)


def test_cutting_the_whole_map_leaves_nothing() -> None:
    environment = discs(((0, 0, 1), 10.0, 5.0))
    split = split_environment(environment, 8, whole_map=True)
    assert len(split.lights) == 8
    assert split.residual.radiance.max() == 0
    total = sum(light.irradiance for light in split.lights)
    assert total == pytest.approx(flux(environment), rel=1e-4)


def test_residual_keeps_its_energy_on_the_octahedron() -> None:
    residual = split_environment(discs(((1, 1, 1), 6.0, 30.0)), 4).residual
    octahedral = resample_to_octahedral(residual.sample, 256)
    assert solid_angle_mean(octahedral) * 4 * np.pi == pytest.approx(flux(residual), rel=2e-3)


def write_map(path: Path, environment: EnvironmentMap) -> str:
    cv2.imwrite(str(path), environment.radiance[..., ::-1])
    return str(path)


def environment_lights(path: str, **settings: object) -> documents.Lights:
    environment = documents.EnvironmentLights(map=path).replaced(**settings)
    return documents.Lights(mode="environment", environment=environment)


def test_environment_mode_puts_lamps_where_the_document_turns_them(tmp_path: Path) -> None:
    path = write_map(tmp_path / "room.hdr", discs(((1, 0, 1), 4.0, 50.0)))
    built = build_lights(environment_lights(path, rotation_deg=90, intensity=2.0, up=(0, 0, 1)))
    light = built.lights[0]
    assert isinstance(light, DirectionalLight)
    assert light.direction == pytest.approx([0, -np.sqrt(0.5), -np.sqrt(0.5)], abs=0.01)
    assert built.registration.tolist() == [1, 1, 1]
    assert built.environment.shape == (256, 256, 3)
    single = build_lights(environment_lights(path)).lights[0]
    assert isinstance(single, DirectionalLight)
    assert light.irradiance == pytest.approx(2 * single.irradiance, rel=1e-3)
    towards_floor = sample_octahedral(built.environment, np.array([[[0.0, 0, -1]]]))
    assert towards_floor[0, 0] == pytest.approx([0.2] * 3, rel=0.02)


def test_manual_lights_take_their_colour_and_ambient_adds_up() -> None:
    manual = (
        documents.DirectionalLight(direction=(0, 0, -2), irradiance=3, color_linear=(1, 0.5, 0)),
        documents.SphereLight(position_m=(1, 2, 3), intensity=4, radius_m=0.1),
        documents.AmbientLight(radiance=0.25, color_linear=(1, 2, 0)),
        documents.AmbientLight(radiance=0.25),
    )
    built = build_lights(documents.Lights(manual=manual, registration=(2.0, 1.0, 1.0))).registered()
    directional, sphere = built.lights
    assert isinstance(directional, DirectionalLight)
    assert directional.direction.tolist() == [0, 0, -1]
    assert directional.irradiance.tolist() == [6, 1.5, 0]
    assert isinstance(sphere, SphereLight)
    assert sphere.intensity.tolist() == [8, 4, 4]
    assert np.unique(built.environment.reshape(-1, 3), axis=0).tolist() == [[1.0, 0.75, 0.25]]
    assert [item["type"] for item in built.describe()] == ["directional", "sphere", "environment"]


def test_unusable_maps_are_refused(tmp_path: Path) -> None:
    square = EnvironmentMap(np.ones((64, 64, 3), np.float32), np.eye(3))
    cases = [
        (write_map(tmp_path / "square.hdr", square), "twice as wide"),
        (str(tmp_path / "none.hdr"), "does not exist"),
        (str(tmp_path / "map.exr"), "cannot be read as an OpenEXR picture"),
        (str(tmp_path / "bright.exr"), "not finite"),
        (str(tmp_path / "map.tif"), "not an environment map"),
        (str(tmp_path / "text.hdr"), "cannot be read"),
    ]
    for name in ("map.exr", "map.tif", "text.hdr"):
        (tmp_path / name).write_text("no picture")
    write_exr(tmp_path / "bright.exr", np.full((16, 32, 3), np.inf, np.float32))
    for path, sentence in cases:
        with pytest.raises(DeltalightError, match=sentence):
            load_environment(documents.EnvironmentLights(map=path))


def test_openexr_maps_are_read_without_loss(tmp_path: Path) -> None:
    radiance = np.random.default_rng(7).uniform(0, 5000, (16, 32, 3)).astype(np.float32)
    write_exr(tmp_path / "room.exr", radiance)
    map_file = documents.EnvironmentLights(map=str(tmp_path / "room.exr"), intensity=2.0)
    assert np.array_equal(load_environment(map_file).radiance, 2 * radiance)


def test_openexr_maps_need_their_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_exr(tmp_path / "room.exr", np.ones((16, 32, 3), np.float32))
    monkeypatch.setitem(sys.modules, "OpenEXR", None)
    with pytest.raises(
        DeltalightError, match=r"room\.exr needs the package OpenEXR: .* -m pip install OpenEXR"
    ):
        load_environment(documents.EnvironmentLights(map=str(tmp_path / "room.exr")))


def test_coded_pictures_are_decoded(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "low.png"), np.full((16, 32, 3), 188, np.uint8))
    environment = load_environment(documents.EnvironmentLights(map=str(tmp_path / "low.png")))
    assert environment.radiance == pytest.approx(np.full((16, 32, 3), 0.503), abs=2e-3)


@pytest.mark.data
@pytest.mark.parametrize("name", ["st_fagans_interior", "kiara_1_dawn", "studio_small_03"])
def test_real_maps_split_without_loss(shared_data: Path, name: str) -> None:
    path = shared_data / f"hdr_env/polyhaven_1k/{name}_1k.hdr"
    environment = load_environment(documents.EnvironmentLights(map=str(path)))
    built = build_lights(environment_lights(str(path)))
    assert 1 <= len(built.lights) <= 4
    total = solid_angle_mean(built.environment) * 4 * np.pi
    for light in built.lights:
        assert isinstance(light, DirectionalLight)
        total = total + light.irradiance
    assert total == pytest.approx(flux(environment), rel=0.01)
