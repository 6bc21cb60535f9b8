"""Precomputed transfer ([D] 4.3.1, docs/method.md 6.5): closed forms, a path tracer, files, pictures."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from jaxtyping import Float64

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import ViewFrame
from deltalight.protocol.scene import SceneDocument
from deltalight.protocol.scene_method import NoneMethod
from deltalight.protocol.scene_output import Shading
from deltalight.render_server.geometry_state import PlacedObject
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.lights.light_map import COSINE_BANDS, coefficients_around, distant_coefficients
from deltalight.render_server.lights.lights import build_lights
from deltalight.render_server.lights.octahedral import even_directions, harmonics, turned_harmonics
from deltalight.render_server.precomputation.light_transfers import ObjectTransfers, transfer_settings
from deltalight.render_server.renderer import SceneRenderer
from deltalight.render_server.scene.bvh import RayCaster
from deltalight.render_server.scene.materials import Material
from deltalight.render_server.scene.precomputed_transfer import (
    ObjectTransfer,
    TransferSettings,
    TransferSurface,
    compute_object_transfer,
    transfer_surface,
)
from deltalight.render_server.scene.triangle_mesh import FileGeometry, TriangleMesh, converted
from tests.render_server.scenes import (
    COARSE,
    EYE,
    Stage,
    ambient,
    array_of,
    ball,
    camera,
    directional,
    floor,
    frame,
    look_at,
    shifted,
    sphere_light,
    with_neighbours,
)

pytestmark = pytest.mark.usefixtures("clean_gl")
EVEN = np.sqrt(4 * np.pi)  # coefficient of light of radiance 1 from everywhere


def mesh_of(shape: trimesh.Trimesh, color: tuple[float, float, float] = (0.5, 0.5, 0.5)) -> TriangleMesh:
    given = FileGeometry(np.asarray(shape.vertices, np.float32), np.asarray(shape.faces, np.int64))
    made = converted(given, Material(base_color=np.array(color, np.float32)), Path("test"))
    assert made is not None
    return made.mesh


def computed(*meshes: TriangleMesh, order: int = 3, bounces: int = 0, rays: int = 1024) -> ObjectTransfer:
    surface = transfer_surface(meshes, None)
    return compute_object_transfer(surface, TransferSettings(order, bounces, rays), lambda _share: None)


def test_convex_things_have_the_cosines_own_coefficients() -> None:
    bands = np.concatenate([COSINE_BANDS, np.zeros(7)])  # a clamped cosine has no third band
    for shape in (trimesh.creation.icosphere(3, 0.4), trimesh.creation.box((0.3, 0.2, 0.5))):
        found = computed(mesh_of(shape), order=4)
        wanted = bands * harmonics(found.normals, 4)
        for channel in range(3):
            assert found.transfer[..., channel] == pytest.approx(wanted, abs=3e-3)
        assert np.abs(found.transfer[..., 3]).max() == 0


def bowl(color: tuple[float, float, float]) -> TriangleMesh:
    """The inside of half a ball, open to +z."""
    half = trimesh.creation.icosphere(4)
    half.update_faces(half.triangles_center[:, 2] < 0)
    half.remove_unreferenced_vertices()
    half.invert()
    return mesh_of(half, color)


@pytest.mark.parametrize("bounces", [0, 1, 3])
def test_light_in_a_bowl_is_that_of_the_closed_form(bounces: int) -> None:
    """From within half a sphere every place sees the other half as half of its light: E = pi/2 sum (rho/2)^i."""
    color = (0.8, 0.5, 0.2)
    found = computed(bowl(color), bounces=bounces)
    deep = found.positions[:, 2] < -0.3
    irradiance = EVEN * found.transfer[deep, 0, :3].astype(float)
    wanted = np.pi / 2 * sum((np.array(color) / 2) ** number for number in range(bounces + 1))
    print(f"{bounces} bounces: {irradiance.mean(axis=0) / wanted - 1}")
    assert irradiance == pytest.approx(np.broadcast_to(wanted, irradiance.shape), rel=0.05)
    assert irradiance.mean(axis=0) == pytest.approx(wanted, rel=0.02)


def corner() -> list[TriangleMesh]:
    """A floor and a wall of other colours, each with a thickness."""
    ground = trimesh.creation.box((1.0, 1.0, 0.05))
    wall = shifted(trimesh.creation.box((1.0, 0.05, 0.5)), 0, 0.3, 0.27)
    return [mesh_of(ground, (0.7, 0.7, 0.7)), mesh_of(wall, (0.9, 0.2, 0.1))]


def traced(
    meshes: list[TriangleMesh],
    surface: TransferSurface,
    vertices: np.ndarray,
    light: np.ndarray,
    bounces: int,
) -> Float64[np.ndarray, "v 3"]:
    """Irradiance under light of these coefficients by random walks, without anything of the transfer's own code."""
    rng = np.random.default_rng(5)
    positions = np.concatenate([mesh.positions for mesh in meshes])
    counts = np.cumsum([0, *(len(mesh.positions) for mesh in meshes)])
    triangles = np.concatenate([mesh.triangles + start for mesh, start in zip(meshes, counts, strict=False)])
    colors = np.concatenate([np.tile(mesh.material.base_color, (len(mesh.triangles), 1)) for mesh in meshes])
    corners = positions[triangles]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    facing = across / np.linalg.norm(across, axis=1, keepdims=True)
    caster = RayCaster(positions, triangles.astype(np.int32))
    walks = 20_000
    owner = np.repeat(np.arange(len(vertices)), walks)
    normal, place = surface.normals[vertices][owner], surface.positions[vertices][owner]
    weight, found = np.full((len(owner), 3), np.pi), np.zeros((len(vertices), 3))
    for _ in range(bounces + 1):
        way = rng.normal(size=normal.shape)
        way = normal + way / np.linalg.norm(way, axis=1, keepdims=True)  # cosine-weighted
        way /= np.linalg.norm(way, axis=1, keepdims=True)
        start = np.asarray(place + 1e-4 * normal, np.float32)
        hits = caster.cast(start, way.astype(np.float32))
        free = hits.triangle < 0
        arriving = weight[free] * (harmonics(way[free], 3) @ light)
        np.add.at(found, owner[free], arriving)
        met = hits.triangle[~free]
        u, v = (np.asarray(each)[~free, None] for each in (hits.u, hits.v))
        place = (1 - u - v) * corners[met, 0] + u * corners[met, 1] + v * corners[met, 2]
        front = (way[~free] * facing[met]).sum(axis=1) < 0
        owner, weight = owner[~free], weight[~free] * colors[met] * front[:, None]
        normal = facing[met]
    return found / walks


def test_shadows_and_bounces_are_those_of_a_path_tracer() -> None:
    meshes, bounces = corner(), 3
    surface = transfer_surface(meshes, None)
    found = compute_object_transfer(surface, TransferSettings(3, bounces, 2048), lambda _share: None)
    x, y, z = surface.positions.T
    up, to_front = surface.normals[:, 2] > 0.9, surface.normals[:, 1] < -0.9
    near = (up & (y < 0.2) & (y > -0.4) & (z > 0)) | (to_front & (z > 0.1) & (z < 0.45) & (y > 0.2))
    some = np.flatnonzero(near & (np.abs(x) < 0.45))[::12]
    assert len(some) > 8
    light = np.zeros((9, 3))
    light[:, :] = np.outer([1.0, -0.5, 0.4, 0.2, 0.1, -0.2, 0.15, 0.1, -0.1], [1.0, 0.8, 0.6])
    wanted = traced(meshes, surface, some, light, bounces)
    values = np.einsum("vkc,kc->vc", found.transfer[some, :, :3].astype(float), light)
    error = np.abs(values - wanted) / wanted.max(axis=0)
    without = np.einsum("vkc,kc->vc", computed(*meshes).transfer[some, :, :3].astype(float), light)
    missing = (np.abs(without - wanted) / wanted.max(axis=0)).mean()
    print(f"path tracer: mean {error.mean():.2%}, worst {error.max():.2%}; without bounces {missing:.2%}")
    assert error.mean() < 0.01
    assert error.max() < 0.03
    assert missing > 0.03


def test_what_is_hidden_is_hidden_from_its_side() -> None:
    """On the floor at the wall's foot light from behind the wall does not count, light from the front does."""
    found = computed(*corner())
    x, y, z = found.positions.T
    floor_ = (found.normals[:, 2] > 0.9) & (np.abs(x) < 0.2) & (y > 0.15) & (y < 0.25) & (z < 0.1)
    from_behind, from_front = (
        found.transfer[floor_, :, 0].astype(float)
        @ harmonics(np.array([[0, way, 0.3]]) / np.hypot(1, 0.3), 3)[0]
        for way in (1.0, -1.0)
    )
    assert (from_front > from_behind + 0.1).all()


def test_harmonics_turn_as_their_directions() -> None:
    rng = np.random.default_rng(1)
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    turn *= np.sign(np.linalg.det(turn))
    coefficients, directions = rng.normal(size=16), even_directions(50)
    turned = turned_harmonics(turn, 4) @ coefficients
    assert harmonics(directions @ turn.T, 4) @ turned == pytest.approx(
        harmonics(directions, 4) @ coefficients
    )


def placed(mesh: TriangleMesh, color: tuple[float, float, float] = (0.8, 0.8, 0.8)) -> PlacedObject:
    return PlacedObject("thing", (mesh,), np.eye(4), Material(base_color=np.array(color, np.float32)))


SETTINGS = TransferSettings(3, 1, 64)


def test_a_transfer_is_computed_once_and_again_where_its_file_is_damaged_or_of_another_mesh(
    tmp_path: Path,
) -> None:
    said: list[str] = []
    thing, other = placed(mesh_of(trimesh.creation.box((1, 1, 1)))), placed(mesh_of(ball(0.3)))
    first = ObjectTransfers(said.append, tmp_path).find(thing, SETTINGS)
    (file,) = tmp_path.glob("*.npz")
    again = ObjectTransfers(said.append, tmp_path).find(thing, SETTINGS)
    assert first is not None
    assert again is not None
    assert (again.transfer == first.transfer).all()
    ObjectTransfers(said.append, tmp_path).find(other, SETTINGS)
    (strange,) = set(tmp_path.glob("*.npz")) - {file}
    whole = file.read_bytes()
    for wrong in (whole[: len(whole) // 2], strange.read_bytes()):
        file.write_bytes(wrong)
        for given in (None, strange.with_name(f"{strange.name}.sha256").read_bytes()):
            if given is not None:
                file.with_name(f"{file.name}.sha256").write_bytes(given)
            mended = ObjectTransfers(said.append, tmp_path).find(thing, SETTINGS)
            assert mended is not None
            assert (mended.transfer == first.transfer).all()
            assert file.read_bytes() == whole
            file.write_bytes(wrong)
    assert said == []


def test_what_is_broken_off_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken_off(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(
        "deltalight.render_server.precomputation.light_transfers.compute_object_transfer", broken_off
    )
    with pytest.raises(KeyboardInterrupt):
        ObjectTransfers(pytest.fail, tmp_path).find(placed(mesh_of(ball())), SETTINGS)
    assert list(tmp_path.iterdir()) == []


def test_colours_that_were_passed_over_are_not_computed(tmp_path: Path) -> None:
    mesh = mesh_of(ball(detail=4))
    transfers = ObjectTransfers(lambda _: None, tmp_path, waits=False)
    transfers._one_at_a_time.acquire()
    for shade in (0.1, 0.2, 0.3):
        assert transfers.find(placed(mesh, (shade, 0.5, 0.5)), SETTINGS) is None
    transfers._one_at_a_time.release()
    transfers.waits = True
    assert transfers.find(placed(mesh, (0.3, 0.5, 0.5)), SETTINGS) is not None
    assert len(list(tmp_path.glob("*.npz"))) == 1


def precomputed(document: SceneDocument, **settings: object) -> SceneDocument:
    shading = Shading(name="precomputed", rays=256).replaced(**settings)
    return document.replaced(shading=shading, method=NoneMethod())


class Shown:
    """What a picture shows of objects alone: radiance, world normal and position of its pixels."""

    def __init__(self, renderer: SceneRenderer) -> None:
        graph = renderer.graph
        assert graph is not None
        surface = graph["object surface"]
        pixels = array_of(surface.coverage.texture)[..., 0] == 1
        self.pixels = pixels & with_neighbours(with_neighbours(pixels))
        self.radiance = array_of(graph["precomputed radiance"])[self.pixels, :3]
        self.normal = array_of(surface.buffer.normal)[self.pixels, :3]
        self.position = array_of(surface.buffer.position)[self.pixels, :3]


def shown(gpu: GpuContext, document: SceneDocument, view: ViewFrame | None = None) -> Shown:
    renderer = SceneRenderer(gpu, document, checks=True)
    renderer.render(frame() if view is None else view)
    found = Shown(renderer)
    renderer.release()
    return found


def test_matt_ball_shows_the_irradiance_of_its_lights(gpu: GpuContext, tmp_path: Path) -> None:
    stage = Stage(tmp_path, COARSE)
    item = stage.virtual(ball(detail=5), (0.5, 0.5, 0.5), pose={"rotation_wxyz": [0.8, 0.3, 0.4, 0.2]})
    document = stage.document([item], [sphere_light((0.4, -0.6, 0.9), 1.0, 0.1), ambient(0.1)], floor())
    found = shown(gpu, precomputed(document))
    lights = build_lights(document.lights)
    (thing,) = document.objects
    middle = (thing.world_from_object() @ (0, 0, 0.06, 1))[:3]
    coefficients = COSINE_BANDS[:, None] * coefficients_around(
        lights, distant_coefficients(lights, 3), middle
    )
    wanted = 0.5 / np.pi * np.maximum(harmonics(found.normal, 3) @ coefficients, 0)
    assert found.radiance == pytest.approx(wanted, abs=0.02 * wanted.max())


def test_white_furnace(gpu: GpuContext, tmp_path: Path) -> None:
    """A white ball in even light shows that light, whatever it is made of."""
    stage = Stage(tmp_path, COARSE)
    document = precomputed(
        stage.document([stage.virtual(ball(detail=5))], [ambient(0.5)], floor()), samples=4
    )
    renderer = SceneRenderer(gpu, document)
    for finish in ({"specular": 0.0}, {"metallic": 1.0, "roughness": 0.3}, {"specular": 1.0}):
        (item,) = document.objects
        material = item.material.replaced(base_color=(1.0, 1.0, 1.0), **finish)  # type: ignore[union-attr]
        renderer.set_scene(document.replaced(objects=(item.replaced(material=material),)))
        renderer.render(frame())
        share = Shown(renderer).radiance / 0.5
        assert share.max() <= 1.02
        assert share.mean() == pytest.approx(1.0, abs=0.02)
    renderer.release()


def step() -> trimesh.Trimesh:
    """A plate with a block on it that hides light to one side."""
    parts = [shifted(trimesh.creation.box((0.3, 0.3, 0.02)), 0, 0, 0.01)]
    return trimesh.util.concatenate(
        [*parts, shifted(trimesh.creation.box((0.05, 0.15, 0.12)), 0.04, 0, 0.07)]
    )


def test_object_light_and_camera_turned_alike_give_the_same_picture(gpu: GpuContext, tmp_path: Path) -> None:
    stage, turn = Stage(tmp_path, COARSE), np.radians(70.0)
    matrix = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    way = np.array([-0.7, 0.2, -0.6])
    lit = [directional(tuple(way)), ambient(0.1)]
    turned = [directional(tuple(matrix @ way)), ambient(0.1)]
    half = {"rotation_wxyz": [np.cos(turn / 2), 0, 0, np.sin(turn / 2)]}
    plain = precomputed(stage.document([stage.virtual(step())], lit, floor()), coefficients=16)
    other = precomputed(stage.document([stage.virtual(step(), pose=half)], turned, floor()), coefficients=16)
    still = precomputed(stage.document([stage.virtual(step())], turned, floor()), coefficients=16)
    target = (0.0, 0.0, 0.06)
    moved = frame(pose=look_at(tuple(matrix @ EYE), target))
    a, b = shown(gpu, plain, frame(pose=look_at(EYE, target))), shown(gpu, other, moved)
    assert a.pixels.sum() > 500
    same = a.pixels & b.pixels
    assert same.sum() > 0.99 * a.pixels.sum()
    difference = np.abs(a.radiance[same[a.pixels]] - b.radiance[same[b.pixels]]).mean()
    unturned = shown(gpu, still, frame(pose=look_at(EYE, target)))
    changed = np.abs(a.radiance - unturned.radiance).mean()
    print(f"turned alike {difference:.5f}, light alone {changed:.5f} of {a.radiance.mean():.4f}")
    assert difference < 0.005 * a.radiance.mean()
    assert changed > 0.05 * a.radiance.mean()


def test_picture_shows_the_transfer_of_its_places(gpu: GpuContext, tmp_path: Path) -> None:
    """Pixel by pixel that of the nearest vertices, with several samples a pixel and through a lens that bends too."""
    stage = Stage(tmp_path, COARSE)
    item = stage.virtual(step(), (0.5, 0.5, 0.5))
    document = precomputed(stage.document([item], [directional((-0.7, 0.2, -0.6)), ambient(0.1)], floor()))
    (thing,) = document.objects
    from deltalight.render_server.scene.mesh_loading import load_mesh

    surface = transfer_surface(load_mesh(Path(thing.asset)), Material(base_color=np.full(3, 0.5, np.float32)))
    made = compute_object_transfer(surface, transfer_settings(document.shading), lambda _share: None)
    lights = build_lights(document.lights)
    light = coefficients_around(lights, distant_coefficients(lights, 3), np.zeros(3))
    at_vertices = np.einsum("vkc,kc->vc", made.transfer[..., :3].astype(float), light) * 0.5 / np.pi
    from scipy.spatial import cKDTree

    tree = cKDTree(np.hstack([made.positions, made.normals]))
    bent = camera(distortion=(-0.3, 0.1, 0.0, 0.0, 0.0))
    for lens, antialiasing in ((camera(), False), (camera(), True), (bent, True)):
        output = document.output.replaced(antialiasing=antialiasing)
        found = shown(gpu, document.replaced(output=output), frame(camera=lens))
        _, near = tree.query(np.hstack([found.position, found.normal]))
        error = np.abs(found.radiance - at_vertices[near])
        share = error.mean(axis=1) / at_vertices.mean()
        print(f"antialiasing {antialiasing}: mean {share.mean():.3%}, median {np.median(share):.3%}")
        assert np.median(share) < 0.015
        assert share.mean() < 0.04


def test_only_the_objects_change(gpu: GpuContext, tmp_path: Path) -> None:
    stage = Stage(tmp_path, COARSE)
    item = stage.virtual(step(), (0.8, 0.3, 0.2), {"roughness": 0.3, "specular": 1.0})
    document = stage.document([item], [sphere_light((0.4, -0.6, 0.9)), ambient(0.1)], floor())
    renderer = SceneRenderer(gpu, document, checks=True)
    plain = renderer.render(frame()).color
    renderer.set_scene(document.replaced(shading=Shading(name="precomputed", rays=64)))
    other = renderer.render(frame()).color
    graph = renderer.graph
    assert graph is not None
    unshaded = array_of(graph["object surface"].coverage.texture)[..., 0] == 0
    assert graph.resource("object radiance").version == 0
    assert not np.array_equal(plain[~unshaded], other[~unshaded])
    assert np.array_equal(plain[unshaded], other[unshaded])
    renderer.release()


def test_what_plays_an_animation_is_refused_in_one_sentence(gpu: GpuContext, tmp_path: Path) -> None:
    stage = Stage(tmp_path, COARSE)
    document = precomputed(stage.document([stage.virtual(ball())], [ambient(0.5)], floor()))
    (item,) = document.objects
    moving = document.replaced(objects=(item.replaced(rigid=False),))
    with pytest.raises(DeltalightError, match=r"holds for rigid objects only: use image_based, or give it"):
        SceneRenderer(gpu, moving)
