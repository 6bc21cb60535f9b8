"""Mitsuba's pictures agree with `CameraModel` and with the scene's own geometry and light."""

import importlib.util
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from jaxtyping import Float64

from deltalight.benchmarks.ground_truth import fisheye, scene_demo
from deltalight.benchmarks.ground_truth.assembly import environment_light, material
from deltalight.benchmarks.ground_truth.benchmark_scene import Finish
from deltalight.benchmarks.ground_truth.lamps import Ambient
from deltalight.benchmarks.ground_truth.parts import looking, placed, rectangle, rgb, shape, turned, two_sided
from deltalight.benchmarks.ground_truth.render import RoomRenderer, choose_variant, passes
from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.errors import DeltalightError
from deltalight.render_server.lights.environment import EnvironmentMap, map_directions

if importlib.util.find_spec("mitsuba") is None:
    pytest.skip("Mitsuba is not installed (dev extra)", allow_module_level=True)

# Off-centre on purpose: the principal point must reach Mitsuba.
CAMERA = CameraModel(
    width=96,
    height=72,
    matrix=np.array([[88.0, 0.0, 40.0], [0.0, 88.0, 39.0], [0.0, 0.0, 1.0]]),
    distortion_model="plumb_bob",
    distortion=np.zeros(5),
)


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> RoomRenderer:
    choose_variant()
    return RoomRenderer(scene_demo.mitsuba_scene(tmp_path_factory.mktemp("meshes"), with_object=True), CAMERA)


def test_depth_is_the_distance_of_the_table_along_the_axis(room: RoomRenderer) -> None:
    pose = scene_demo.world_from_camera(0)
    depth_m = room.depth(pose, spp=64, seed=1)
    rays = np.concatenate([CAMERA.rays(), np.ones((72, 96, 1))], axis=2) @ pose[:3, :3].T
    table_m = (scene_demo.TABLE_Z_M - pose[2, 3]) / rays[..., 2]
    nearest_row = 70  # only table there
    assert np.abs(depth_m - table_m)[nearest_row].max() < 0.002
    assert np.all(depth_m > 0.3)


def test_few_samples_are_right_in_the_mean(room: RoomRenderer) -> None:
    """Mitsuba's stratified sampler is not."""
    pose = scene_demo.world_from_camera(0)
    few = np.mean([room.color(pose, spp=16, seed=seed) for seed in range(24)], axis=0)
    many = room.color(pose, spp=512, seed=99)
    assert few.mean() == pytest.approx(many.mean(), rel=0.004)


def test_object_stands_where_the_scene_document_says(room: RoomRenderer) -> None:
    pose = scene_demo.world_from_camera(0)
    color = room.color(pose, spp=16, seed=1)
    green = (color[..., 1] > 2 * color[..., 0]) & (color[..., 1] > 0.1)
    rows, columns = np.nonzero(green)
    middle = np.add(scene_demo.OBJECT_TRANSLATION_M, (0, 0, 0.075))
    camera_from_world = np.linalg.inv(pose)
    (u, v) = CAMERA.project((camera_from_world[:3, :3] @ middle + camera_from_world[:3, 3])[None])[0]
    assert green.sum() > 100
    assert (columns.mean(), rows.mean()) == pytest.approx((u, v), abs=4)


def test_lens_distortion_is_refused(room: RoomRenderer, tmp_path: Path) -> None:
    del room  # the variant is set
    bent = CameraModel(
        width=96,
        height=72,
        matrix=CAMERA.matrix,
        distortion_model="plumb_bob",
        distortion=np.array([0.1, 0.0, 0.0, 0.0]),
    )
    renderer = RoomRenderer(scene_demo.mitsuba_scene(tmp_path, with_object=False), bent)
    with pytest.raises(DeltalightError, match="distortion"):
        renderer.color(scene_demo.world_from_camera(0), spp=1, seed=0)


def test_map_shines_from_where_the_renderer_reads_it() -> None:
    """One bright texel among black ones, met by the centre pixel of a camera that looks its way."""
    choose_variant()
    sky = np.zeros((8, 16, 3), np.float32)
    directions = map_directions(8, 16)
    for row, column in ((2, 3), (6, 11), (0, 9)):
        sky[:] = 0
        sky[row, column] = (1.0, 2.0, 4.0)
        scene = {"type": "scene", "sky": environment_light(sky)}
        x, y, z = (float(v) for v in directions[row, column])
        picture = RoomRenderer(scene, CAMERA).color(looking((0.0, 0.0, 0.0), (x, y, z)), spp=4, seed=1)
        assert picture[39, 40] == pytest.approx((1.0, 2.0, 4.0), rel=0.1)


def test_map_is_the_same_function_as_the_renderers() -> None:
    choose_variant()
    sky = np.random.default_rng(3).uniform(0, 1, (8, 16, 3)).astype(np.float32)
    scene = {"type": "scene", "sky": environment_light(sky)}
    pose = looking((0.0, 0.0, 0.0), (-0.5, 0.6, 0.3))
    picture = RoomRenderer(scene, CAMERA).color(pose, spp=64, seed=1)
    rays = np.concatenate([CAMERA.rays(), np.ones((72, 96, 1), np.float32)], axis=2) @ pose[:3, :3].T
    expected = EnvironmentMap(sky, np.eye(3)).sample(rays.astype(np.float32))
    assert np.abs(picture - expected)[2:-2, 2:-2].max() < 0.02


def test_fisheye_sees_each_direction_at_its_angle() -> None:
    """A sky whose colour is the direction itself: the picture must show each pixel's own, also below the horizon."""
    choose_variant()
    sky = 0.5 + 0.5 * map_directions(64, 128)
    scene = {"type": "scene", "sky": environment_light(sky)}
    camera = fisheye.CAMERA.resized(60, 60)
    picture = RoomRenderer(scene, camera).color(np.eye(4), spp=16, seed=1)
    columns, rows = np.meshgrid(np.arange(60) - 29.5, np.arange(60) - 29.5)
    radius = np.hypot(columns, rows)
    angle = np.radians(190) / 60 * radius
    around = np.stack([columns, rows], axis=2) / radius[..., None] * np.sin(angle)[..., None]
    expected = np.concatenate([around, np.cos(angle)[..., None]], axis=2)
    inside, outside = radius < 28, radius > 33.5
    assert angle[inside].max() > np.pi / 2 - 0.05
    assert np.abs(2 * picture - 1 - expected)[inside].max() < 0.03
    assert not picture[outside].any()


def test_cover_of_an_edge_is_as_soft_as_colour() -> None:
    """A white square before a black room: its cover is its colour when it shines with 1."""
    choose_variant()
    square = rectangle(placed((0.013, 0.0, 1.0), scale=(0.2, 0.2, 1.0)) @ turned("x", 180), (0.0, 0.0, 0.0))
    shining = {**square, "emitter": {"type": "area", "radiance": rgb((1.0, 1.0, 1.0))}}
    room = RoomRenderer({"type": "scene", "square": shining}, CAMERA)
    cover = room.cover(np.eye(4), spp=16, seed=5)
    assert np.array_equal(cover, np.clip(room.color(np.eye(4), spp=16, seed=5)[..., 0], 0, 1))
    assert cover.sum() == pytest.approx((0.4 * 88) ** 2, rel=0.01)
    edge_px = 40 + 88 * (0.013 - 0.2)
    assert np.interp(0.5, cover[39, 15:35], np.arange(15, 35)) == pytest.approx(edge_px, abs=0.1)
    # Blurred by a Gaussian of half a pixel, an edge rises from 16 % to 84 % within a pixel.
    rise = np.interp([0.16, 0.84], cover[39, 15:35], np.arange(15, 35))
    assert rise[1] - rise[0] == pytest.approx(1.0, abs=0.25)


@pytest.mark.parametrize("spp", [1, 4, 30, 192, 2048])
def test_passes_add_up_and_fit(spp: int) -> None:
    plan = passes(spp, 640 * 480)
    assert 4 * sum(plan) == 4 * math.ceil(spp / 4)
    assert all(size in (1, 4, 16) for size in plan)


def test_pixels_that_are_not_square_are_refused() -> None:
    choose_variant()
    with pytest.raises(DeltalightError, match="aspect"):
        RoomRenderer({"type": "scene"}, CAMERA.resized(96, 48)).color(np.eye(4), spp=4, seed=0)


@pytest.mark.parametrize("metallic", [0.0, 1.0])
def test_furnace_keeps_materials_below_the_light(metallic: float) -> None:
    """In a uniform surrounding nothing is brighter than it, and a Lambertian surface shows its albedo."""
    choose_variant()
    for finish, expected in (
        (Finish((0.5, 0.25, 0.1), specular=0.0), (0.5, 0.25, 0.1)),
        (Finish((0.5, 0.25, 0.1), metallic=metallic), None),
    ):
        ball = shape("sphere", placed((0.0, 0.0, 1.0), scale=(0.3,) * 3), bsdf=two_sided(material(finish)))
        scene = {"type": "scene", "sky": Ambient(1.0).mitsuba(), "ball": ball}
        middle = RoomRenderer(scene, CAMERA).color(np.eye(4), spp=256, seed=1)[36:42, 37:43].mean(axis=(0, 1))
        assert middle.max() < 1.0
        if expected is not None:
            assert middle == pytest.approx(expected, rel=0.02)


COSINES = np.array([0.05, 0.1, 0.2, 0.5, 0.75, 1.0])


def reflected(bsdf: dict[str, Any], *, evenly: bool = False) -> Float64[np.ndarray, "6 3"]:
    """What a material shows of radiance 1 from everywhere, seen from COSINES: by its own samples, or by even ones."""
    import drjit as dr
    import mitsuba as mi

    count = 1 << 16
    cosine = np.repeat(COSINES, count)
    si = dr.zeros(mi.SurfaceInteraction3f, len(cosine))
    si.wi = mi.Vector3f(np.sqrt(1 - cosine**2), 0.0, cosine)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(1, len(cosine))
    made, context = mi.load_dict(bsdf), mi.BSDFContext()
    if evenly:
        even = mi.warp.square_to_uniform_hemisphere(sampler.next_2d())
        values = 2 * np.pi * np.array(made.eval(context, si, even))
    else:
        values = np.array(made.sample(context, si, sampler.next_1d(), sampler.next_2d())[1])
    return np.asarray(values.reshape(3, len(COSINES), count).mean(axis=2).T)


@pytest.mark.parametrize(
    ("roughness", "metallic", "low", "high"),
    [(0.3, 0.0, 1.03, 1.22), (1.0, 0.0, 1.04, 1.52), (0.3, 1.0, 0.87, 1.0), (1.0, 1.0, 0.30, 0.59)],
)
def test_truths_materials_keep_the_light(roughness: float, metallic: float, low: float, high: float) -> None:
    """A white surface in even light of 1 shows 1. Mitsuba's `principled`, which truth had before, adds lobe and base,
    and loses what microfacets throw at each other: from `low` to `high`, as docs/quality.md says."""
    choose_variant()
    own = material(Finish((1.0, 1.0, 1.0), roughness=roughness, metallic=metallic))
    disney = reflected({**own, "type": "principled"})[:, 0]
    kept = reflected(own)
    print(
        f"roughness {roughness}, metallic {metallic}: {np.round(kept[:, 0], 3)}, principled {np.round(disney, 3)}"
    )
    assert kept == pytest.approx(1.0, abs=0.01)
    assert low - 0.01 < disney.min()
    assert disney.max() < high + 0.01


@pytest.mark.parametrize(("coat", "sheen"), [((1.0, 0.5), 0.0), ((0.0, 0.0), 1.0), ((1.0, 0.6), 1.0)])
def test_truths_coats_and_sheens_keep_the_light(coat: tuple[float, float], sheen: float) -> None:
    """A white surface under them shows 1 in even light of 1, and they are sampled as they are evaluated."""
    choose_variant()
    from deltalight.benchmarks.ground_truth.coated_bsdf import coated

    for metallic in (0.0, 1.0):
        bsdf = coated(
            (1.0, 1.0, 1.0),
            roughness=0.5,
            metallic=metallic,
            coat=coat,
            sheen=(sheen, sheen, sheen),
            sheen_roughness=0.5,
        )
        kept = reflected(bsdf)
        print(f"coat {coat}, sheen {sheen}, metallic {metallic}: {np.round(kept[:, 0], 3)}")
        assert kept == pytest.approx(1.0, abs=0.03)
        assert reflected(bsdf, evenly=True) == pytest.approx(kept, rel=0.02, abs=0.005)


def test_truths_materials_are_sampled_as_they_are_evaluated() -> None:
    """Means over the material's own samples and over even ones agree, colours apart; light goes both ways alike."""
    import drjit as dr
    import mitsuba as mi

    choose_variant()
    for finish in (
        Finish((0.2, 0.5, 0.8), roughness=0.6),
        Finish((0.9, 0.6, 0.3), roughness=0.7, metallic=1.0),
    ):
        bsdf = material(finish)
        assert reflected(bsdf, evenly=True) == pytest.approx(reflected(bsdf), rel=0.02, abs=0.005)
        made, context, si = mi.load_dict(bsdf), mi.BSDFContext(), dr.zeros(mi.SurfaceInteraction3f, 1)
        one, other = mi.Vector3f(0.6, 0.0, 0.8), mi.Vector3f(0.0, -0.96, 0.28)
        si.wi = one
        there = np.array(made.eval(context, si, other)) / 0.28
        si.wi = other
        assert np.array(made.eval(context, si, one)) / 0.8 == pytest.approx(there, rel=1e-4)
