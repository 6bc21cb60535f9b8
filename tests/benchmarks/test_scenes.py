"""Benchmark scenes: what stands where, shadow edges against ray casting, lamps against closed forms."""

import importlib.util
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from deltalight.benchmarks.ground_truth import meshes
from deltalight.benchmarks.ground_truth.benchmark_scene import BenchmarkScene
from deltalight.benchmarks.ground_truth.document import scene_document
from deltalight.benchmarks.ground_truth.lamps import Ambient, Lamp, Panel, SphereLamp, Spot
from deltalight.benchmarks.ground_truth.parts import diffuse, looking, placed, rgb, shape
from deltalight.benchmarks.ground_truth.scenes import SCENES, scene_named
from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.scene import parse_scene
from deltalight.render_server.lights.environment import map_directions, pixel_solid_angles

if importlib.util.find_spec("mitsuba") is None:
    pytest.skip("Mitsuba is not installed (dev extra)", allow_module_level=True)

from deltalight.benchmarks.ground_truth.assembly import Assembly, environment_light
from deltalight.benchmarks.ground_truth.render import RoomRenderer, choose_variant

each_scene = pytest.mark.parametrize("scene", SCENES, ids=lambda scene: scene.name)
PATCH_CAMERA = CameraModel(
    width=8,
    height=8,
    matrix=np.array([[400.0, 0.0, 3.5], [0.0, 400.0, 3.5], [0.0, 0.0, 1.0]]),
    distortion_model="plumb_bob",
    distortion=np.zeros(5),
)
"""Sees 2 cm of a patch from 1 m away."""
PATCH_M = (0.1, -0.2, 0.0)
STANDS_WITHIN_M = 0.001
FLUSH_M = 0.00001


@pytest.fixture(scope="module", autouse=True)
def variant() -> str:
    return choose_variant()


def test_scenes_have_names_of_their_own() -> None:
    assert len({scene.name for scene in SCENES}) == len(SCENES) == 10
    assert all(scene_named(scene.name) is scene for scene in SCENES)


def test_unknown_scene_names_the_nearest_and_all_known() -> None:
    with pytest.raises(DeltalightError, match=r"did you mean `tabletop`\?.*cornell"):
        scene_named("tabeltop")


@each_scene
def test_poses_are_rigid_and_one_for_each_frame(scene: BenchmarkScene) -> None:
    tracks = [scene.world_from_camera, *(item.world_from_object for item in scene.objects)]
    assert {len(track) for track in tracks} == {scene.frame_count}
    for pose in (pose for track in tracks for pose in track):
        assert pose[:3, :3] @ pose[:3, :3].T == pytest.approx(np.eye(3), abs=1e-12)
        assert np.linalg.det(pose[:3, :3]) == pytest.approx(1)


@each_scene
def test_document_is_valid_and_has_every_lamp(scene: BenchmarkScene) -> None:
    documents = [parse_scene(scene_document(scene, frame)) for frame in range(scene.frame_count)]
    lights = documents[0].lights
    assert (lights.mode == "environment") == (scene.environment is not None)
    assert len(lights.manual) == len(scene.lamps)
    for frame, document in enumerate(documents):
        for item, said in zip(scene.objects, document.objects, strict=True):
            assert said.world_from_object() == pytest.approx(item.world_from_object[frame], abs=1e-12)


@each_scene
def test_whole_board_is_in_view(scene: BenchmarkScene) -> None:
    corners = np.concatenate(list(scene.board.corner_points().values()))
    for pose in scene.world_from_camera:
        camera_from_world = np.linalg.inv(pose)
        pixels = scene.camera.project(corners @ camera_from_world[:3, :3].T + camera_from_world[:3, 3])
        assert pixels.min() > 0
        assert np.all(pixels.max(axis=0) < [scene.camera.width - 1, scene.camera.height - 1])


@each_scene
def test_objects_stand_on_something_and_touch_nothing_else(scene: BenchmarkScene, tmp_path: Path) -> None:
    real = Rays(_without_lamps(Assembly(scene, tmp_path).without()))
    up = np.array([0.0, 0.0, 1.0])
    for item in scene.objects:
        mesh = item.mesh()
        for pose in item.world_from_object:
            vertices = mesh.vertices @ pose[:3, :3].T + pose[:3, 3]
            # From 1 mm above each vertex down to what is real below.
            gap_m = real.distance(vertices + 0.001 * up, -up) - 0.001
            assert gap_m.min() > -FLUSH_M, f"{item.id} reaches into a real thing"
            assert gap_m.min() < STANDS_WITHIN_M, f"{item.id} floats"
            ends = vertices[mesh.edges_unique] + STANDS_WITHIN_M * up
            assert not real.blocked(ends[:, 0], ends[:, 1]).any(), f"{item.id} cuts a real thing"


@pytest.mark.parametrize(
    "scene", [scene for scene in SCENES if scene.shadow_edges], ids=lambda scene: scene.name
)
def test_light_falls_from_all_to_none_along_shadow_edges(scene: BenchmarkScene, tmp_path: Path) -> None:
    assembly = Assembly(scene, tmp_path)
    empty, full = (Rays(_without_lamps(room)) for room in (assembly.without(), assembly.with_objects(0)))
    for edge in scene.shadow_edges:
        start, end = np.array(edge.start_m), np.array(edge.end_m)
        way = start + np.linspace(0, 1, 81)[:, None] * (end - start)
        lamp = _hidden_lamp(scene, full, way[-1:])
        assert _lit_share(empty, lamp, way) == pytest.approx(1.0)
        share = _lit_share(full, lamp, way)
        assert share[0] == 1
        assert share[-1] == 0
        assert np.diff(share).max() < 0.01
        assert share[40] == pytest.approx(0.5, abs=0.1)
        assert 0.2 < np.count_nonzero((share > 0.1) & (share < 0.9)) / 81 < 0.8


def test_three_scenes_have_shadow_edges() -> None:
    assert sum(bool(scene.shadow_edges) for scene in SCENES) >= 3


def test_sphere_shines_with_its_intensity() -> None:
    lamp = SphereLamp((0.5, 0.1, 0.8), 3.0, 0.08, (1.0, 0.5, 0.25))
    to_lamp = np.subtract(lamp.position_m, PATCH_M)
    distance = np.linalg.norm(to_lamp)
    expected = lamp.intensity * to_lamp[2] / distance**3 * np.array(lamp.color_linear)
    assert _irradiance(lamp) == pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize(
    ("share_of_half", "light"), [(0.0, 1.0), (0.55, 1.0), (0.8, 0.5), (0.9, 0.25), (1.05, 0.0)]
)
def test_spot_falls_linearly_in_angle_at_its_rim(share_of_half: float, light: float) -> None:
    position, half_deg = np.array([0.1, -0.2, 0.9]), 30.0
    tilt = np.radians(share_of_half * half_deg)
    direction = (float(np.sin(tilt)), 0.0, float(-np.cos(tilt)))
    lamp = Spot((0.1, -0.2, 0.9), direction, 2.0, 2 * half_deg, 0.4)
    expected = light * lamp.intensity / position[2] ** 2
    assert _irradiance(lamp) == pytest.approx(np.full(3, expected), rel=0.02, abs=1e-6)


def test_panel_shines_as_the_integral_over_it_says() -> None:
    lamp = Panel((-0.4, 0.1, 0.6), (0.0, 0.5, 0.0), (0.3, 0.0, 0.3), 4.0)
    steps = (np.arange(400) + 0.5) / 400 - 0.5
    u, v = np.meshgrid(steps, steps)
    edge_u, edge_v = np.array(lamp.edge_u_m), np.array(lamp.edge_v_m)
    points = np.array(lamp.center_m) + u[..., None] * edge_u + v[..., None] * edge_v
    normal = np.cross(edge_u, edge_v)
    beam = np.array(PATCH_M) - points
    distance = np.linalg.norm(beam, axis=-1)
    # The cross product's length is the area, so its cosine already carries it.
    kernel = np.maximum(beam @ normal, 0) * -beam[..., 2] / distance**4
    assert kernel.min() > 0
    assert _irradiance(lamp) == pytest.approx(np.full(3, lamp.radiance * kernel.mean()), rel=0.01)


def test_panel_is_dark_behind() -> None:
    lamp = Panel((-0.4, 0.1, 0.6), (0.3, 0.0, 0.3), (0.0, 0.5, 0.0), 4.0)
    assert _irradiance(lamp) == pytest.approx(np.zeros(3))


def test_ambient_gives_pi_times_its_radiance() -> None:
    lamp = Ambient(0.3, (1.0, 0.8, 0.5))
    assert _irradiance(lamp) == pytest.approx(np.pi * 0.3 * np.array(lamp.color_linear), rel=0.01)


def test_sky_lights_the_ground_as_its_map_says() -> None:
    make_sky = scene_named("natural_light").environment
    assert make_sky is not None
    sky = make_sky()
    assert np.array_equal(sky, make_sky())
    rows, columns = sky.shape[:2]
    cosine = np.maximum(map_directions(rows, columns)[..., 2:], 0)
    expected = (sky * cosine * pixel_solid_angles(rows, columns)[..., None]).sum(axis=(0, 1))
    assert _patch_irradiance(environment_light(sky)) == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize("make", [meshes.rabbit, meshes.pawn, meshes.vase, meshes.ball, meshes.ring])
def test_meshes_are_closed_small_and_stand_on_the_ground(make: Callable[[], trimesh.Trimesh]) -> None:
    mesh = make()
    assert mesh.is_watertight
    assert mesh.volume > 0
    assert len(mesh.split()) == 1
    assert len(mesh.faces) < 20_000
    assert mesh.bounds[0, 2] == pytest.approx(0, abs=1e-9)
    assert np.einsum("ij,ij->i", mesh.face_normals, mesh.vertex_normals[mesh.faces].mean(axis=1)).min() > 0


class Rays:
    """Ray casting in a Mitsuba scene."""

    def __init__(self, scene: dict[str, Any]) -> None:
        import mitsuba as mi

        self._scene = mi.load_dict(scene)

    def distance(self, origin: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """Distance to the first thing hit; inf where nothing is."""
        return np.array(self._scene.ray_intersect_preliminary(_ray(origin, direction)).t)

    def blocked(self, start: np.ndarray, end: np.ndarray) -> np.ndarray:
        """Whether anything is between two points."""
        ray = _ray(start, end - start)
        ray.maxt = 1.0
        return np.array(self._scene.ray_test(ray))


def _ray(origin: np.ndarray, direction: np.ndarray) -> Any:  # noqa: ANN401 - a Mitsuba type
    import mitsuba as mi

    o, d = (np.array(v, np.float32).T for v in np.broadcast_arrays(origin, direction))
    return mi.Ray3f(mi.Point3f(o), mi.Vector3f(d))


def _without_lamps(scene: dict[str, Any]) -> dict[str, Any]:
    return {name: part for name, part in scene.items() if not name.startswith("lamp_")}


def _hidden_lamp(scene: BenchmarkScene, full: Rays, dark_end: np.ndarray) -> SphereLamp:
    """The one lamp that the dark end of an edge does not see."""
    spheres = [lamp for lamp in scene.lamps if isinstance(lamp, SphereLamp)]
    (hidden,) = (lamp for lamp in spheres if _lit_share(full, lamp, dark_end) == 0)
    return hidden


def _lit_share(rays: Rays, lamp: SphereLamp, points: np.ndarray) -> np.ndarray:
    """Share of the lamp's disc that each point sees."""
    rng = np.random.default_rng(1)
    radius, angle = lamp.radius_m * np.sqrt(rng.random(4000)), 2 * np.pi * rng.random(4000)
    beam = np.array(lamp.position_m) - points[len(points) // 2]
    across = np.linalg.svd(beam[None])[2][1:]
    disc = np.array(lamp.position_m) + (radius * np.stack([np.cos(angle), np.sin(angle)])).T @ across
    lifted = points + np.array([0.0, 0.0, 1e-5])
    starts = np.repeat(lifted, len(disc), axis=0)
    return 1 - rays.blocked(starts, np.tile(disc, (len(points), 1))).reshape(len(points), -1).mean(axis=1)


def _irradiance(lamp: Lamp) -> np.ndarray:
    return _patch_irradiance(lamp.mitsuba())


def _patch_irradiance(light: dict[str, Any]) -> np.ndarray:
    """Irradiance R G B of a white patch that looks up: its radiance times pi."""
    place = placed(PATCH_M, scale=(0.02, 0.02, 1.0))
    patch = shape("rectangle", place, bsdf=diffuse(rgb((1.0, 1.0, 1.0))))
    renderer = RoomRenderer({"type": "scene", "patch": patch, "light": light}, PATCH_CAMERA)
    eye = (PATCH_M[0], PATCH_M[1] - 0.01, 1.0)
    return np.pi * renderer.color(looking(eye, PATCH_M), spp=4096, seed=1).mean(axis=(0, 1))
