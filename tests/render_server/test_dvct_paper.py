"""The paper's operator of delta voxel cone tracing, on a box over a floor that are lit in closed form."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import moderngl
import numpy as np
import pytest
import trimesh
from jaxtyping import Bool, Float32, Float64

from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.frames import BoardPose, ViewFrame, decode_lut
from deltalight.protocol.scene import SceneDocument, parse_scene
from deltalight.render_server.gpu import kernel
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.shader_source import shader_source
from deltalight.render_server.graph import Graph
from deltalight.render_server.passes.voxels import VoxelMipmap
from deltalight.render_server.renderer import SceneRenderer
from tests.render_server.protected_scenes import LEAST_PSNR_DB, cases, pictures_of
from tests.render_server.scenes import psnr_db

WIDTH, HEIGHT, VOXELS = 160, 120, 32
EDGE = 0.1995  # of the box, m: a little less than eight voxels, so that it lies in no ninth
VOXEL_M = 0.8 / VOXELS
IRRADIANCE, AMBIENT = 2.0, 0.1
BASE_COLOR = np.array([0.8, 0.4, 0.2])
CODE = 150  # of the camera's picture everywhere
DOWN, OBLIQUE = (0.0, 0.0, -1.0), (0.6, 0.0, -0.8)


def cuboid(size: tuple[float, float, float], centre_z: float) -> trimesh.Trimesh:
    return trimesh.creation.box(size, trimesh.transformations.translation_matrix((0, 0, centre_z)))


@pytest.fixture(scope="module")
def assets(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("assets")
    floor, roof = cuboid((2, 2, 0.02), -0.01), cuboid((0.8, 0.8, 0.02), 0.7)
    floor.export(folder / "floor.ply")
    trimesh.util.concatenate([floor, roof]).export(folder / "roofed.ply")
    wall = trimesh.creation.box((1.0, 0.02, 0.6), trimesh.transformations.translation_matrix((0, 0.2, 0.3)))
    # Not on the border of two voxels: there, rounding decides which of them the light goes to.
    trimesh.util.concatenate([cuboid((2, 2, 0.02), -0.018), wall]).export(folder / "walled.ply")
    cuboid((EDGE, EDGE, EDGE), EDGE / 2).export(folder / "box.ply")
    return folder


def scene(
    assets: Path,
    *,
    real: str = "floor",
    direction: tuple[float, ...] = DOWN,
    gain: float = 1,
    **method: object,
) -> SceneDocument:
    light = {"type": "directional", "direction": direction, "irradiance": IRRADIANCE * gain}
    ambient = {"type": "ambient", "radiance": AMBIENT * gain}
    material = {"base_color": BASE_COLOR.tolist(), "specular": 0}
    return parse_scene(
        {
            "real": {"geometry": {"model": str(assets / f"{real}.ply")}},
            "objects": [{"asset": str(assets / "box.ply"), "material": material}],
            "lights": {"manual": [light, ambient], "surroundings": "none"},
            "method": {"operator": "paper", "volume_size": VOXELS, "volume_edge_m": 0.8, **method},
        }
    )


def frame(exposure_scale: float = 1.0) -> ViewFrame:
    """Looks at the box from the front, a little from above; the whole picture has one code."""
    matrix = np.array([[150.0, 0, 79.5], [0, 150, 59.5], [0, 0, 1]])
    eye = np.array([0.0, -1.0, 0.55])
    forward = (np.array([0, 0, 0.05]) - eye) / np.linalg.norm(np.array([0, 0, 0.05]) - eye)
    right = np.array([1.0, 0, 0])
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    pose[:3, 3] = eye
    return ViewFrame(
        frame_id=0,
        timestamp_ns=0,
        color=np.full((HEIGHT, WIDTH, 3), CODE, np.uint8),
        camera=CameraModel(WIDTH, HEIGHT, matrix, "plumb_bob", np.zeros(5)),
        exposure_scale=exposure_scale,
        pose=BoardPose(pose),
    )


@contextmanager
def rendered(gpu: GpuContext, document: SceneDocument, view: ViewFrame | None = None) -> Iterator[Graph]:
    """The graph of one frame."""
    renderer = SceneRenderer(gpu, document)
    renderer.render(frame() if view is None else view)
    assert renderer.graph is not None
    yield renderer.graph
    renderer.release()


def texels(texture: moderngl.Texture) -> Float64[np.ndarray, "h w 4"]:
    width, height = texture.size
    return np.frombuffer(texture.read(), np.float16).reshape(height, width, 4).astype(np.float64)


def level_0(voxels: VoxelMipmap) -> Float64[np.ndarray, "n n n 3"]:
    cells = np.frombuffer(voxels.texture.read(), np.float16).reshape(-1, VOXELS, VOXELS, 4)
    return cells[:VOXELS, ..., :3].astype(np.float64)


def camera_radiance() -> float:
    return float(decode_lut(None)[CODE, 0])


@pytest.mark.parametrize("rsm_size", [512, 1024, 4096])
def test_the_delta_holds_the_flux_that_the_box_reflects_and_what_the_floor_lost(
    gpu: GpuContext, assets: Path, rsm_size: int
) -> None:
    """However fine the light's map is: of its finest texels one brings half a step of fixed point."""
    with rendered(gpu, scene(assets, rsm_size=rsm_size)) as graph:
        cells = level_0(graph["filter"].delta) * np.pi * VOXEL_M**2
    albedo = np.pi * camera_radiance() / (IRRADIANCE + np.pi * AMBIENT)
    gained = np.clip(cells, 0, None).sum(axis=(0, 1, 2))
    lost = np.clip(cells, None, 0).sum(axis=(0, 1, 2))
    assert gained == pytest.approx(BASE_COLOR * IRRADIANCE * EDGE**2, rel=0.02)
    assert lost == pytest.approx(np.full(3, -albedo * IRRADIANCE * EDGE**2), rel=0.02)


@pytest.mark.parametrize("lights", [(DOWN,), (DOWN, OBLIQUE)], ids=["a light", "two lights"])
@pytest.mark.parametrize("normal", [(0, 0, 1), (0, -1, 1), (1, -1, 1)])
def test_voxels_of_a_plate_hold_its_radiance_however_it_is_turned(
    gpu: GpuContext,
    assets: Path,
    tmp_path: Path,
    normal: tuple[int, ...],
    lights: tuple[tuple[float, ...], ...],
) -> None:
    """albedo / pi times the irradiance of all lights: Phi / (pi A), with the area that the plate has in the voxel."""
    direction = np.array(normal) / np.linalg.norm(normal)
    plate = trimesh.creation.box((0.3, 0.3, 0.01), trimesh.geometry.align_vectors((0, 0, 1), direction))
    plate.apply_translation((0, 0, 0.3))
    plate.export(tmp_path / "plate.ply")
    document = scene(assets)
    plates = document.objects[0].model_copy(update={"asset": str(tmp_path / "plate.ply")})
    manual = [{"type": "directional", "direction": each, "irradiance": IRRADIANCE} for each in lights]
    given = parse_scene({"lights": {"manual": manual, "surroundings": "none"}}).lights
    with rendered(gpu, document.replaced(objects=(plates,), lights=given)) as graph:
        rho, low = level_0(graph["filter"].rho), np.array(graph["volume"].placement.origin)
    irradiance = sum(-IRRADIANCE * float(np.dot(direction, each)) for each in lights)
    centres = low + VOXEL_M * (np.moveaxis(np.indices((VOXELS,) * 3), 0, -1)[..., ::-1] + 0.5)
    inner = (rho[..., 0] > 0) & (
        np.linalg.norm(centres - (0, 0, 0.3), axis=-1) < 0.12
    )  # without the plate's rim
    relative = rho[inner] / (BASE_COLOR / np.pi * irradiance)
    assert len(relative) > 60
    assert relative == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize("tilt", [0.0, 0.5])
def test_the_floor_loses_the_radiance_that_it_had(
    gpu: GpuContext, assets: Path, tmp_path: Path, tilt: float
) -> None:
    """Where the box takes all of a light, V_delta is the negative of what the camera saw less ambient light."""
    turn = trimesh.transformations.rotation_matrix(tilt, (1, 0, 0))
    cuboid((2, 2, 0.02), -0.01).apply_transform(turn).export(tmp_path / "floor.ply")
    box = cuboid((EDGE, EDGE, EDGE), 0.35)
    box.export(tmp_path / "box.ply")
    document = scene(assets)
    floating = document.objects[0].model_copy(update={"asset": str(tmp_path / "box.ply")})
    real = parse_scene({"real": {"geometry": {"model": str(tmp_path / "floor.ply")}}}).real
    with rendered(gpu, document.replaced(objects=(floating,), real=real)) as graph:
        delta = level_0(graph["filter"].delta)[..., 0]
    direct = IRRADIANCE * np.cos(tilt)
    lost = camera_radiance() * direct / (direct + np.pi * AMBIENT)
    relative = -delta[delta < 0] / lost
    assert len(relative) > 30
    assert np.median(relative) == pytest.approx(1.0, abs=0.02)
    assert relative.max() < 1.02


def test_where_the_real_scene_keeps_the_light_off_nothing_changes(gpu: GpuContext, assets: Path) -> None:
    with rendered(gpu, scene(assets, real="roofed")) as graph:
        mu, rho = texels(graph["direct light"].light.mu), texels(graph["direct light"].light.rho)
        cells = level_0(graph["filter"].delta)
    assert (mu[..., 3] > 0).any()
    assert not cells.any()
    assert np.array_equal(mu[..., :3], rho[..., :3])


def test_a_second_run_gives_the_same_bits(gpu: GpuContext, assets: Path) -> None:
    found = []
    for _ in range(2):
        with rendered(gpu, scene(assets, direction=OBLIQUE)) as graph:
            voxels = graph["filter"]
            found.append((voxels.delta.texture.read(), voxels.rho.texture.read(), graph["cones"].rho.read()))
    assert found[0] == found[1]


def test_the_change_is_linear_in_the_light(gpu: GpuContext, assets: Path) -> None:
    changes = []
    for gain in (1.0, 4.0):
        document = scene(assets, gain=gain, direction=OBLIQUE)
        with rendered(gpu, document, frame(exposure_scale=1 / gain)) as graph:
            cones = graph["cones"]
            changes.append((texels(cones.rho) - texels(cones.mu))[..., :3].sum(axis=(0, 1)))
    assert changes[0].max() > 1.0
    assert changes[1] == pytest.approx(4.0 * changes[0], rel=0.01)


@pytest.mark.parametrize("opacity", [0.0, 0.3, 1.0])
def test_the_nine_cones_of_a_constant_field_bring_pi_times_its_radiance(
    gpu: GpuContext, assets: Path, opacity: float
) -> None:
    with rendered(gpu, scene(assets)) as graph:
        filtered = graph.resource("filter")
        rho = filtered.value.rho
        cells = np.full((*rho.texture.size[::-1], 4), opacity * AMBIENT, np.float16)
        cells[..., 3] = opacity
        rho.texture.write(cells.tobytes())
        filtered.write(filtered.value)
        graph.run()
        traced = texels(graph["cones"].virtual)
    assert (traced[..., 3] > 0).sum() > 20
    assert traced[traced[..., 3] > 0][:, :3] == pytest.approx(np.pi * AMBIENT, rel=0.01)


def box_is_met(
    origins: Float64[np.ndarray, "k 3"], directions: Float64[np.ndarray, "k 3"], margin: float
) -> Bool[np.ndarray, " k"]:
    """Which rays meet the box, grown by `margin` m to all sides but the floor."""
    low = np.array([-EDGE / 2 - margin, -EDGE / 2 - margin, 0.0])
    high = np.array([EDGE / 2 + margin, EDGE / 2 + margin, EDGE + margin])
    with np.errstate(divide="ignore"):
        a, b = (low - origins) / directions, (high - origins) / directions
    first, last = np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)
    met: Bool[np.ndarray, " k"] = (first < last) & (last > 0)
    return met


def floor_seen(view_frame: ViewFrame) -> tuple[Float64[np.ndarray, "k 3"], Bool[np.ndarray, " k"]]:
    """Floor point of each pixel, and whether it is seen near the box and not hidden by it."""
    assert view_frame.pose is not None
    pose = view_frame.pose.world_from_camera
    rays: Float32[np.ndarray, "k 2"] = view_frame.camera.rays().reshape(-1, 2)
    directions = np.column_stack([rays, np.ones(len(rays))]) @ pose[:3, :3].T
    eyes = np.repeat(pose[None, :3, 3], len(rays), axis=0)
    points = eyes - directions * (eyes[:, 2:] / directions[:, 2:])
    near = (directions[:, 2] < 0) & (np.abs(points[:, :2]).max(axis=1) < 0.6)
    return points, near & ~box_is_met(eyes, directions, 0.01)


@pytest.mark.parametrize(
    "method",
    [{}, {"shadow": "map"}, {"operator": "exact", "shadow": "cone", "composition": "additive"}],
    ids=["paper", "paper with maps", "exact with cones"],
)
def test_the_shadow_lies_where_geometry_puts_it(
    gpu: GpuContext, assets: Path, method: dict[str, Any]
) -> None:
    renderer = SceneRenderer(gpu, scene(assets, direction=OBLIQUE, **method))
    picture = renderer.render(frame()).color
    renderer.release()
    linear = decode_lut(None)[picture[..., 1], 1].reshape(-1) / camera_radiance()
    points, seen = floor_seen(frame())
    to_light = np.broadcast_to(-np.array(OBLIQUE), points.shape)
    umbra = seen & box_is_met(points, to_light, -VOXEL_M)
    lit = seen & ~box_is_met(points, to_light, 3 * VOXEL_M)
    ambient = np.pi * AMBIENT / (0.8 * IRRADIANCE + np.pi * AMBIENT)
    assert umbra.sum() > 100
    assert np.median(linear[umbra]) == pytest.approx(ambient, abs=0.08)
    assert np.mean(linear[umbra] < 0.5) > 0.95
    assert np.mean(np.abs(linear[lit] - 1) < 0.1) > 0.98


def gathered(graph: Graph, cells: bytes) -> Float64[np.ndarray, "h w 3"]:
    """E of the nine cones at real surfaces, through a volume in place of V_delta."""
    filtered = graph.resource("filter")
    filtered.value.delta.texture.write(cells)
    filtered.write(filtered.value)
    graph.run()
    cones = graph["cones"]
    return np.asarray((texels(cones.rho) - texels(cones.mu))[..., :3])


def test_the_error_of_the_delta_is_the_indirect_light_that_the_box_blocks(
    gpu: GpuContext, assets: Path, tmp_path: Path
) -> None:
    """[P1] eq. 9, E = C_rho - (C_mu + C_delta), with C_mu through the scene without the box: what V_delta holds
    takes nothing away that passes between two real surfaces. So E is never positive.

    C_mu is found anew in a scene whose object is two specks, as far apart as the box's corners, which shine."""
    corners = [trimesh.creation.box((0.002,) * 3) for _ in range(2)]
    for corner, side in zip(corners, (-1, 1), strict=True):
        corner.apply_translation(side * np.array([EDGE / 2] * 3) + (0, 0, EDGE / 2))
    trimesh.util.concatenate(corners).export(tmp_path / "speck.ply")
    document = scene(assets, real="walled", direction=(0.0, 0.6, -0.8))
    speck = document.objects[0].model_copy(update={"asset": str(tmp_path / "speck.ply")})
    with rendered(gpu, document) as graph:
        found = texels(graph["delta error"]())
        held = [each.texture.read() for each in (graph["filter"].rho, graph["filter"].delta)]
        rho, delta = (gathered(graph, cells) for cells in held)
        seen = (found[..., 3] > 0) & (texels(graph["cones"].virtual)[..., 3] == 0)
    with rendered(gpu, document.replaced(objects=(speck,))) as graph:
        mu = gathered(graph, graph["filter"].rho.texture.read())
    error = found[seen, :3].mean(axis=-1)
    difference = error - (rho - mu - delta)[seen].mean(axis=-1)
    of_mu = error.sum() / (rho[seen].mean(axis=-1) - delta[seen].mean(axis=-1) - error).sum()
    print(
        f"E: {of_mu:.3f} of C_mu, {error.min():.3f} .. {error.max():.3f}, rms {np.sqrt((error**2).mean()):.3f}"
    )
    assert seen.sum() > 500
    assert np.mean(np.abs(difference) < 0.01) > 0.95
    assert error.min() < -0.03
    assert error.max() < 0.001


def test_the_view_of_the_error_is_black_where_there_is_none(gpu: GpuContext, assets: Path) -> None:
    """With the exact operator, whose change is the difference of both solutions, E is 0."""
    views = []
    for operator in ("paper", "exact"):
        document = scene(assets, real="walled", direction=(0.0, 0.6, -0.8), operator=operator)
        renderer = SceneRenderer(gpu, document)
        others = renderer.submit(frame(), others=("error",)).finish().others
        views.append(others[0].color.astype(int))
        renderer.release()
    paper, exact = views
    assert exact.max() == 0
    assert paper.max() > 0


def test_rounding_of_a_lights_map_moves_no_light_to_the_voxel_below(
    gpu: GpuContext, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The floor, at z = 0 on the lower border of its voxels, has its underside in those below."""
    (case,) = (one for one in cases() if str(one) == "paper-model-plain")
    exact, _ = pictures_of(gpu, case, tmp_path)
    place = "vec3 p = ray_point(view, s, depth);"
    monkeypatch.setattr(
        kernel, "shader_source", lambda *args: shader_source(*args).replace(place, f"{place} p.z -= 5e-5;")
    )
    rounded, _ = pictures_of(gpu, case, tmp_path)
    assert any(not np.array_equal(*pair) for pair in zip(exact, rounded, strict=True))
    assert min(psnr_db(*pair) for pair in zip(exact, rounded, strict=True)) > LEAST_PSNR_DB
