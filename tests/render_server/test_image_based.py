"""Image-based shading ([D] 4.2, docs/method.md 6.6): irradiance, filtered samples, ambient occlusion, energy."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from jaxtyping import Float32, Float64
from scipy.ndimage import uniform_filter

from deltalight.protocol import scene_lights as documents
from deltalight.protocol.frames import ViewFrame
from deltalight.protocol.octahedral import octahedral_grid, resample_to_octahedral
from deltalight.protocol.scene import SceneDocument
from deltalight.protocol.scene_method import NoneMethod
from deltalight.protocol.scene_objects import Material
from deltalight.protocol.scene_output import Shading
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Binding, Kernel
from deltalight.render_server.gpu.textures import release_all
from deltalight.render_server.lights.environment import load_environment
from deltalight.render_server.lights.light_map import irradiance_coefficients, light_map
from deltalight.render_server.lights.light_models import DirectionalLight, SphereLight
from deltalight.render_server.lights.lights import LightSet, build_lights
from deltalight.render_server.lights.octahedral import even_directions, harmonics, irradiance
from deltalight.render_server.passes.image_based import SurroundingLight
from deltalight.render_server.renderer import SceneRenderer
from tests.render_server.scenes import (
    COARSE,
    Stage,
    ambient,
    array_of,
    ball,
    floor,
    frame,
    look_at,
    shifted,
    sphere_light,
    with_neighbours,
)

pytestmark = pytest.mark.usefixtures("clean_gl")
NORMALS = even_directions(64)
ROUGHNESSES = (0.1, 0.2, 0.35, 0.5, 0.7, 1.0)
COSINES = (0.3, 0.6, 0.95)
SIZE = 128


def sky(sharpness: float) -> Float32[np.ndarray, "n n 3"]:
    """A bright side over a dim ground; the bright side gets narrower with `sharpness`."""

    def radiance(directions: Float32[np.ndarray, "a b 3"]) -> Float32[np.ndarray, "a b 3"]:
        d = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
        bright = np.exp(sharpness * (d @ np.array([0.6, 0.0, 0.8]) - 1))[..., None]
        tint = 0.2 + 0.1 * d[..., 2:]
        return np.asarray(bright * (3.0, 2.0, 1.0) + tint * (0.6, 0.8, 1.0), np.float32)

    return resample_to_octahedral(radiance, SIZE)


def irradiance_of(radiance: Float32[np.ndarray, "n n 3"]) -> Float64[np.ndarray, "k 3"]:
    return np.asarray(harmonics(NORMALS, 3) @ irradiance_coefficients(radiance))


def test_irradiance_is_within_three_percent_on_smooth_light() -> None:
    """Ramamoorthi & Hanrahan: 3 % on average; here the worst normal, of the brightest one's irradiance."""
    for sharpness in (1.0, 2.0):
        radiance = sky(sharpness)
        wanted = irradiance(radiance, NORMALS)
        error = np.abs(irradiance_of(radiance) - wanted) / wanted.max(axis=0)
        print(f"sharpness {sharpness}: {error.max():.2%}")
        assert error.max() < 0.03


def test_irradiance_of_even_light_is_exact() -> None:
    assert irradiance_of(np.full((SIZE, SIZE, 3), 0.7, np.float32)) == pytest.approx(0.7 * np.pi, rel=1e-4)


def light_set(*lights: DirectionalLight | SphereLight, ambient_radiance: float = 0.1) -> LightSet:
    environment = np.full((64, 64, 3), ambient_radiance, np.float32)
    return LightSet(lights, environment, np.zeros((64, 64, 1), np.float32), np.ones(3, np.float32))


def test_lights_are_put_back_with_their_irradiance() -> None:
    above = DirectionalLight(np.array([0, 0, -1], np.float32), np.array([2, 1, 0.5], np.float32), 0.0047)
    lamp = SphereLight(np.array([1.5, 0, 0], np.float32), np.array([4, 4, 4], np.float32), 0.1)
    found = light_map(light_set(above, lamp), np.array([0.5, 0, 0]))
    normals = np.array([[0, 0, 1.0], [1, 0, 0], [0, 0, -1]])
    even, half = 0.1 * np.pi, 4 * 2 * 0.1 / (3 * np.pi)  # of the lamp's disc, whose middle is at the horizon
    wanted = [[2 + even + half, 1 + even + half, 0.5 + even + half], [4 + even] * 3, [even + half] * 3]
    assert irradiance(found, normals) == pytest.approx(np.array(wanted), rel=0.01)
    towards = octahedral_grid(len(found)) @ (1, 0, 0)
    angle = np.arccos(np.clip(towards, -1, 1))
    lamp_disc = (found[..., 2] > 1) & (angle < 1)
    assert angle[lamp_disc].max() == pytest.approx(0.1, abs=0.015)


def test_a_given_map_is_not_taken_apart(tmp_path: Path) -> None:
    """What surfaces mirror is the map itself, and not the lights that were cut out of it."""
    rng = np.random.default_rng(2)
    cv2.imwrite(str(tmp_path / "room.hdr"), rng.lognormal(0, 1.5, (64, 128, 3)).astype(np.float32))
    given = documents.EnvironmentLights(map=str(tmp_path / "room.hdr"))
    lights = documents.Lights(mode="environment", environment=given, registration=(1, 2, 4))
    wanted = resample_to_octahedral(load_environment(given).sample, 256) * (1, 2, 4)
    found = light_map(build_lights(lights).registered(), np.zeros(3))
    assert found == pytest.approx(wanted, rel=1e-5)


@pytest.fixture
def lobes(gpu: GpuContext) -> Iterator[Callable[..., Float32[np.ndarray, "n 4"]]]:
    """Mean radiance of lobes of a map: for each of NORMALS, COSINES and ROUGHNESSES."""
    light = SurroundingLight(gpu)
    kernels = [
        Kernel(gpu, Path(__file__).with_name("filtered_lobe"), **each) for each in ({}, {"UNFILTERED": 1})
    ]

    def trace(
        radiance: Float32[np.ndarray, "n n 3"],
        samples: int,
        f0: tuple[float, float, float] = (0.9, 0.5, 0.04),
        *,
        filtered: bool = True,
        directions: int = 0,
    ) -> Float32[np.ndarray, "n 4"]:
        light.set_map(radiance)
        views = views_of()
        given, found = gpu.ctx.buffer(views.tobytes()), gpu.ctx.buffer(reserve=16 * len(views))
        own: dict[str, Binding] = {
            "samples": samples,
            "f0": f0,
            "directions": directions,
            "count": len(views),
        }
        kernels[not filtered].run((len(views),), light.bindings, Views=given, Found=found, **own)
        values = np.frombuffer(found.read(), np.float32).reshape(-1, 4).copy()
        for item in (given, found):
            item.release()
        return values

    yield trace
    release_all(light, *kernels)


def views_of() -> Float32[np.ndarray, "n 8"]:
    """Normal and roughness, direction to the viewer."""
    across = np.cross(NORMALS, (0.48, 0.6, 0.64))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    views = []
    for roughness in ROUGHNESSES:
        for cosine in COSINES:
            towards = cosine * NORMALS + np.sqrt(1 - cosine**2) * across
            views.append(
                np.column_stack([NORMALS, np.full(len(NORMALS), roughness), towards, 0 * NORMALS[:, :1]])
            )
    return np.concatenate(views).astype(np.float32)


def test_density_of_samples_is_one_over_all_directions(lobes: Callable[..., np.ndarray]) -> None:
    """But for half-vectors that v does not see, a share of (1 - n.v) / 2 at roughness 1; as [D] eq. 4.22 is printed,
    four times that."""
    even = np.ones((32, 32, 3), np.float32)
    found = lobes(even, 1, directions=20000)[:, 3].reshape(len(ROUGHNESSES), len(COSINES), -1)
    assert found[-1].mean(axis=1) == pytest.approx((1 + np.array(COSINES)) / 2, abs=0.01)
    assert found[2, -1].mean() == pytest.approx(1.0, abs=0.02)


def test_even_light_is_reflected_as_it_is(lobes: Callable[..., np.ndarray]) -> None:
    for samples in (1, 3, 40):
        found = lobes(np.full((64, 64, 3), 0.75, np.float32), samples)[:, :3]
        assert found == pytest.approx(0.75, rel=1e-3)


def errors(lobes: Callable[..., np.ndarray], radiance: np.ndarray, samples: int, **kind: bool) -> np.ndarray:
    """Mean error by roughness and cosine, relative to 4096 unfiltered samples."""
    shape = (len(ROUGHNESSES), len(COSINES), -1)
    reference = lobes(radiance, 4096, filtered=False)[:, :3]
    found = lobes(radiance, samples, **kind)[:, :3]
    error, size = (np.reshape(each, shape).mean(axis=2) for each in (np.abs(found - reference), reference))
    return np.asarray(error / size)


def test_few_filtered_samples_come_near_many_unfiltered_ones(lobes: Callable[..., np.ndarray]) -> None:
    found = {samples: errors(lobes, sky(20.0), samples) for samples in (1, 10, 40)}
    for samples, error in found.items():
        print(f"{samples} samples: mean {error.mean():.1%}, worst {error.max():.1%}")
    assert found[40].max() < 0.05
    assert found[40].mean() < found[10].mean() < 0.05 < found[1].mean()


@pytest.mark.data
@pytest.mark.parametrize("name", ["st_fagans_interior", "kiara_1_dawn", "studio_small_03"])
def test_filtered_samples_in_real_rooms(
    lobes: Callable[..., np.ndarray], shared_data: Path, name: str
) -> None:
    path = shared_data / f"hdr_env/polyhaven_1k/{name}_1k.hdr"
    environment = load_environment(documents.EnvironmentLights(map=str(path)))
    radiance = resample_to_octahedral(environment.sample, 256)
    filtered = [errors(lobes, radiance, samples).mean() for samples in (10, 20, 40)]
    unfiltered = errors(lobes, radiance, 36, filtered=False).mean()
    print(f"{name}: 10, 20, 40 filtered samples {np.round(filtered, 3)}, 36 unfiltered {unfiltered:.3f}")
    assert filtered[2] < filtered[1] < filtered[0]
    assert filtered[2] < 0.16
    assert filtered[2] < 0.6 * unfiltered


def image_based(document: SceneDocument, **settings: object) -> SceneDocument:
    return document.replaced(shading=Shading(name="image_based").replaced(**settings), method=NoneMethod())


@dataclass
class Shaded:
    """Of the pixels that show objects alone: radiance, world normal and position, open fraction (blocks averaged)."""

    radiance: np.ndarray
    normal: np.ndarray
    position: np.ndarray
    open: np.ndarray


def shaded(gpu: GpuContext, document: SceneDocument, view: ViewFrame | None = None) -> Shaded:
    renderer = SceneRenderer(gpu, document)
    found = shaded_by(renderer, frame() if view is None else view)
    renderer.release()
    return found


def shaded_by(renderer: SceneRenderer, view: ViewFrame) -> Shaded:
    renderer.render(view)
    graph = renderer.graph
    assert graph is not None
    surface = graph["object surface"]
    pixels = array_of(surface.coverage.texture)[..., 0] == 1
    pixels &= with_neighbours(with_neighbours(pixels))
    open_ = uniform_filter(array_of(graph["ambient occlusion"].open)[..., 0], 4)
    return Shaded(
        array_of(graph["image-based radiance"])[pixels, :3],
        array_of(surface.buffer.normal)[pixels, :3],
        array_of(surface.buffer.position)[pixels, :3],
        open_[pixels],
    )


def test_white_furnace(gpu: GpuContext, tmp_path: Path) -> None:
    """A white ball in even light shows that light, whatever it is made of and however rough."""
    stage = Stage(tmp_path, COARSE)
    around = 0.5
    matt = stage.virtual(ball(detail=5), (1.0, 1.0, 1.0))
    document = image_based(stage.document([matt], [ambient(around)], floor()), samples=4)
    renderer = SceneRenderer(gpu, document)
    for finish in ({"specular": 0.0}, {"metallic": 1.0}, {"specular": 1.0}):
        for roughness in (0.1, 0.5, 1.0):
            (item,) = document.objects
            assert isinstance(item.material, Material)
            material = item.material.replaced(**finish, roughness=roughness)
            renderer.set_scene(document.replaced(objects=(item.replaced(material=material),)))
            share = shaded_by(renderer, frame()).radiance / around
            assert share.max() <= 1.02
            assert share.mean() == pytest.approx(1.0, abs=0.02)
    renderer.release()


def test_matt_ball_shows_the_irradiance_of_the_lights_map(gpu: GpuContext, tmp_path: Path) -> None:
    stage = Stage(tmp_path, COARSE)
    lamps = [sphere_light((0.4, -0.6, 0.9), 1.0, 0.1), ambient(0.1)]
    item = stage.virtual(ball(detail=5), (0.5, 0.5, 0.5))
    document = stage.document([item], lamps, floor())
    found = shaded(gpu, image_based(document))
    lights = build_lights(document.lights)
    coefficients = irradiance_coefficients(light_map(lights, np.array([0, 0, 0.06])))
    wanted = 0.5 / np.pi * np.maximum(harmonics(found.normal, 3) @ coefficients, 0)
    assert found.radiance == pytest.approx(wanted, abs=0.02 * wanted.max())


def test_flat_and_convex_things_hide_nothing_of_themselves(gpu: GpuContext, tmp_path: Path) -> None:
    stage = Stage(tmp_path, COARSE)
    plate = shifted(trimesh.creation.box((0.5, 0.5, 0.02)), 0, 0, 0.05)
    found = shaded(gpu, image_based(stage.document([stage.virtual(plate)], [ambient(0.5)], floor())))
    assert found.open[found.normal[:, 2] > 0.9] == pytest.approx(1.0, abs=0.01)
    round_ = shaded(
        gpu, image_based(stage.document([stage.virtual(ball(detail=5))], [ambient(0.5)], floor()))
    )
    assert round_.open.mean() == pytest.approx(1.0, abs=0.02)


def test_corner_hides_what_its_wall_does(gpu: GpuContext, tmp_path: Path) -> None:
    """At distance x from a long wall of height h the floor sees 1/2 (1 + x / sqrt(x^2 + h^2)) of the light."""
    stage = Stage(tmp_path, COARSE)
    height, far = 0.25, 1.5
    wall = shifted(trimesh.creation.box((2 * far, 0.02, height)), 0, 0.01, height / 2)
    ground = shifted(trimesh.creation.box((2 * far, 0.6, 0.02)), 0, -0.3, -0.01)
    item = stage.virtual(trimesh.util.concatenate([wall, ground]), pose={"translation_m": [0, 0, 0.05]})
    document = image_based(stage.document([item], [ambient(0.5)], floor()), occlusion_radius_m=1.0)
    found = shaded(gpu, document, frame(pose=look_at((0.0, -1.0, 0.8), (0.0, -0.1, 0.1))))
    x, y, z = found.position.T
    on_floor = (found.normal[:, 2] > 0.9) & (np.abs(x) < 0.2) & (y < -0.03) & (y > -0.5) & (z < 0.06)
    wanted = 0.5 * (1 - y / np.hypot(y, height))
    error = (found.open - wanted)[on_floor]
    print(f"corner: mean error {error.mean():+.3f}, r.m.s. {np.sqrt((error**2).mean()):.3f}")
    assert on_floor.sum() > 500
    assert abs(error.mean()) < 0.02
    assert np.sqrt((error**2).mean()) < 0.03


def test_occlusion_can_be_left_out(gpu: GpuContext, tmp_path: Path) -> None:
    stage = Stage(tmp_path, COARSE)
    bowl = trimesh.util.concatenate(
        [shifted(trimesh.creation.box((0.3, 0.3, 0.02)), 0, 0, 0.01), ball(0.05, (0, 0, 0.07))]
    )
    document = stage.document([stage.virtual(bowl)], [ambient(0.5)], floor())
    assert shaded(gpu, image_based(document)).open.min() < 0.9
    assert shaded(gpu, image_based(document, occlusion_radius_m=0.0)).open.min() > 0.999


def test_method_does_not_shade_the_objects_too(gpu: GpuContext, tmp_path: Path) -> None:
    """Whatever the method, and switched while it runs; the real scene changes as before."""
    stage = Stage(tmp_path, COARSE)
    item = stage.virtual(ball(), (0.8, 0.3, 0.2), {"roughness": 0.3, "specular": 1.0})
    document = stage.document([item], [sphere_light((0.4, -0.6, 0.9)), ambient(0.1)], floor())
    switched = document.replaced(shading=Shading(name="image_based", samples=4))
    renderer = SceneRenderer(gpu, document, checks=True)
    plain = renderer.render(frame()).color
    renderer.set_scene(switched)
    other = renderer.render(frame()).color
    graph = renderer.graph
    assert graph is not None
    unshaded = array_of(graph["object surface"].coverage.texture)[..., 0] == 0
    assert "image-based radiance" in graph
    assert graph.resource("object radiance").version == 0
    assert not np.array_equal(plain[~unshaded], other[~unshaded])
    assert np.array_equal(plain[unshaded], other[unshaded])
    renderer.release()
