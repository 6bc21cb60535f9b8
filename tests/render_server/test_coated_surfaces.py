"""Clear coats and sheens over surfaces (docs/method.md 4.12): energy, closed forms, maps."""

from collections.abc import Callable
from itertools import count, product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from jaxtyping import Float32, Float64

from deltalight.benchmarks.gltf_plate import Plate, even
from deltalight.protocol.frames import ViewFrame, decode_lut
from deltalight.protocol.scene_output import Shading
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Kernel
from deltalight.render_server.renderer import SceneRenderer
from tests.render_server.scenes import (
    FOCAL,
    GREY,
    HEIGHT,
    WIDTH,
    ObjectsRenderer,
    Stage,
    ambient,
    camera,
    depth_image,
    directional,
    floor,
    floor_depth,
    frame,
    look_at,
    plain,
    sent_flux,
    solve,
    unlit,
)

pytestmark = pytest.mark.usefixtures("clean_gl")
COSINES = (0.05, 0.1, 0.2, 0.35, 0.5, 0.75, 1.0)
BASES = (0.1, 0.3, 0.6, 1.0)  # roughnesses
COATS = (0.0, 0.1, 0.2, 0.3, 0.5, 0.7, 1.0)
WHITE = {"metal": (0.0, 1.0), "plastic": (1.0, 0.04), "glossy": (1.0, 0.08), "matt": (1.0, 0.0)}
EVEN = float(decode_lut(None)[GREY, 0])  # radiance
EDGE = 96 / FOCAL  # m of a plate 1 m away, at the picture's middle
INSIDE = np.s_[HEIGHT // 2 - 30 : HEIGHT // 2 + 30, WIDTH // 2 - 30 : WIDTH // 2 + 30]


def reflected(
    gpu: GpuContext, base: tuple[float, float], coat: float, sheen: float
) -> Float32[np.ndarray, "n 3"]:
    """Of radiance 1 from everywhere, at all roughnesses and cosines: lights, gathered light, voxels."""
    over = COATS if coat else (0.5,), COATS if sheen else (0.5,)
    rows = [
        (*(base[0],) * 3, cosine, *(base[1],) * 3, roughness, coat, smooth, 0, 0, *(sheen,) * 3, fibres)
        for roughness, smooth, fibres, cosine in product(BASES, *over, COSINES)
    ]
    surfaces = np.array(rows, np.float32)
    given, found = gpu.ctx.buffer(surfaces.tobytes()), gpu.ctx.buffer(reserve=16 * len(surfaces))
    kernel = Kernel(gpu, Path(__file__).with_name("coated_furnace"), EXTENDED=1)
    switches = {"EXTENDED": True, "MATERIAL_MAPS": False, "MEASURED": False}
    kernel.run((len(surfaces),), Surfaces=given, Found=found, count=len(surfaces), **switches)
    values = np.frombuffer(found.read(), np.float32).reshape(-1, 4)[:, :3].copy()
    for item in (given, found, kernel):
        item.release()
    return values


@pytest.mark.parametrize(
    ("coat", "sheen", "error"), [(1.0, 0.0, 0.02), (0.5, 0.0, 0.02), (0.0, 1.0, 0.02), (1.0, 1.0, 0.03)]
)
@pytest.mark.parametrize("name", WHITE)
def test_white_surfaces_under_coats_and_sheens_reflect_all_light(
    gpu: GpuContext, name: str, coat: float, sheen: float, error: float
) -> None:
    found = reflected(gpu, WHITE[name], coat, sheen)
    for path, values in zip(("lights", "gathered", "mean"), found.T, strict=True):
        print(f"{name}, coat {coat}, sheen {sheen}, {path}: {values.min():.3f} .. {values.max():.3f}")
    assert found[:, 0] == pytest.approx(1.0, abs=error)
    assert found[:, 1:] == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize(("coat", "sheen"), [(1.0, 0.0), (0.0, 0.8), (1.0, 0.8)])
def test_lights_and_gathered_light_reflect_alike_on_black(gpu: GpuContext, coat: float, sheen: float) -> None:
    """Here nothing but coat and sheen reflects: the fits against the lobes themselves."""
    found = reflected(gpu, (0.0, 0.0), coat, sheen)
    assert found[:, 0] == pytest.approx(found[:, 1], abs=0.02)
    assert found[:, 0].max() < 1.0


def seen_from_above(code: int = 0) -> ViewFrame:
    """A camera 1 m above the origin; all that it sees but objects has one code."""
    depth = depth_image(np.full((HEIGHT, WIDTH), 3.0, np.float32))
    return frame(plain(code), pose=look_at((0.0, 0.0, 1.0), (0.0, 0.0, 0.0)), depth=depth)


Draw = Callable[..., np.ndarray]


@pytest.fixture
def draw(objects: ObjectsRenderer, tmp_path: Path) -> Draw:
    """Draws a plate under some lights; returns the linear picture."""

    numbers = count()  # of files: renderers keep an asset that they loaded

    def drawn(made: Plate, lights: list[dict[str, Any]]) -> np.ndarray:
        asset = {"asset": str(made.write(tmp_path / f"plate{next(numbers)}.glb")), "up_axis": "z"}
        return objects.linear(unlit(Stage(tmp_path).document([asset], lights)), seen_from_above())

    return drawn


def coated(
    coat: dict[str, Any] | None = None, sheen: dict[str, Any] | None = None, color: float = 0.5
) -> Plate:
    """A matt plate under them."""
    made = Plate(EDGE, EDGE)
    made.material["pbrMetallicRoughness"] = {"baseColorFactor": [color] * 3 + [1], "metallicFactor": 0}
    if coat is not None:
        made.material["extensions"]["KHR_materials_clearcoat"] = coat
    if sheen is not None:
        made.material["extensions"]["KHR_materials_sheen"] = sheen
    return made


Vectors = Float64[np.ndarray, "*n 3"]


def ggx(n: Vectors, v: Vectors, l: Vectors, alpha: float) -> np.ndarray:  # noqa: E741
    """Lobe of index 1.5, single reflection, without its cosine."""
    h = (l + v) / np.linalg.norm(l + v, axis=-1, keepdims=True)
    nh, nl, nv = ((n * each).sum(axis=-1) for each in (h, l, v))
    a2 = alpha**2
    d = a2 / (np.pi * (nh**2 * (a2 - 1) + 1) ** 2)
    g = 0.5 / (nl * np.sqrt(nv**2 * (1 - a2) + a2) + nv * np.sqrt(nl**2 * (1 - a2) + a2))
    return np.asarray((0.04 + 0.96 * (1 - (l * h).sum(axis=-1)) ** 5) * d * g)


def coat_albedo(cosine: float, alpha: float, side: int = 400) -> float:
    """Of that lobe, by quadrature over half a turn: the other half is its image in a mirror."""
    z, turn = np.meshgrid((np.arange(side) + 0.5) / side, 2 * np.pi * (np.arange(side // 2) + 0.5) / side)
    level = np.sqrt(1 - z * z)
    l = np.stack([level * np.cos(turn), level * np.sin(turn), z], axis=-1)  # noqa: E741
    v = np.array([np.sqrt(1 - cosine**2), 0, cosine])
    return float((ggx(np.array([0, 0, 1.0]), v, l, alpha) * z).mean() * 2 * np.pi)


def directions_to_camera() -> Vectors:
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    away = np.dstack([(x - (WIDTH - 1) / 2) / FOCAL, -(y - (HEIGHT - 1) / 2) / FOCAL, np.zeros_like(x)])
    v = np.array([0, 0, 1.0]) - away
    return np.asarray(v / np.linalg.norm(v, axis=-1, keepdims=True))


def test_a_coat_over_a_matt_plate_under_a_lamp_is_its_closed_form(draw: Draw) -> None:
    """The lobe of a coat, over Lambert's base that it dims on the way in and out."""
    lamp, roughness = np.array([0.35, 0.2, -1.0]), 0.4
    alpha = roughness**2
    picture = draw(
        coated({"clearcoatFactor": 0.8, "clearcoatRoughnessFactor": roughness}),
        [directional(tuple(lamp), 2.0)],
    )
    l = -lamp / np.linalg.norm(lamp)  # noqa: E741
    up, v = np.array([0, 0, 1.0]), directions_to_camera()[INSIDE]
    at = np.linspace(0.02, 1, 50)
    albedos = np.array([0.8 * coat_albedo(each, alpha) for each in at])
    mean = 2 * np.trapezoid(albedos * at, at)
    out = 1 - np.interp(v[..., 2], at, albedos)
    base = 0.5 / np.pi * (1 - np.interp(l[2], at, albedos)) * out / (1 - mean)
    wanted = 2.0 * l[2] * (base + 0.8 * ggx(up, v, l, alpha))
    found = picture[INSIDE][..., 1]
    print(f"brightest {wanted.max():.3f}, error at most {np.abs(found / wanted - 1).max():.4f}")
    assert wanted.max() > 1.3 * wanted.min(), "a highlight is seen"
    assert found == pytest.approx(wanted, rel=0.02)


MAPPED: dict[str, tuple[dict[str, Any], dict[str, Any], dict[str, tuple[int, ...]]]] = {
    "coat": (
        {"clearcoatFactor": 0.9 * 102 / 255, "clearcoatRoughnessFactor": 0.8 * 128 / 255},
        {"clearcoatFactor": 0.9, "clearcoatRoughnessFactor": 0.8},
        {"clearcoatTexture": (102, 0, 0), "clearcoatRoughnessTexture": (0, 128, 0)},
    ),
    "sheen": (
        {
            "sheenColorFactor": [float(decode_lut(None)[code, 0]) for code in (200, 150, 90)],
            "sheenRoughnessFactor": 128 / 255,
        },
        {"sheenColorFactor": [1, 1, 1], "sheenRoughnessFactor": 1.0},
        {"sheenColorTexture": (200, 150, 90, 255), "sheenRoughnessTexture": (0, 0, 0, 128)},
    ),
}


@pytest.mark.parametrize("name", MAPPED)
def test_maps_of_coats_and_sheens_are_as_the_factors(draw: Draw, name: str) -> None:
    factors, given, textures = MAPPED[name]
    lights = [directional((0.5, 0.3, -0.6), 5.0, 2.0), ambient(0.5)]
    by_factors = draw(coated(**{name: factors}, color=0.0), lights)[INSIDE]
    made = coated(color=0.0)
    extension = {**given, **{key: made.texture(even(*code)) for key, code in textures.items()}}
    made.material["extensions"][f"KHR_materials_{'clearcoat' if name == 'coat' else 'sheen'}"] = extension
    by_maps = draw(made, lights)[INSIDE]
    assert by_maps == pytest.approx(by_factors, rel=0.02)
    assert by_maps.mean() > 0.01, "what lies over the black plate is seen"


def test_a_smooth_coat_with_maps_has_the_highlight_of_one_without(draw: Draw) -> None:
    """A roughness between two steps of eight bits: the peak of the lobe goes by its fourth power."""
    coat = {"clearcoatFactor": 1.0, "clearcoatRoughnessFactor": 20.5 / 255}
    lamp = [directional((0.0, 0.0, -1.0), 0.01)]
    by_factors = draw(coated(dict(coat), color=0.0), lamp)[INSIDE]
    made = coated(dict(coat), color=0.0)
    made.material["normalTexture"] = made.texture(even(128, 128, 255), scale=0.0)
    by_maps = draw(made, lamp)[INSIDE]
    print(f"peak {by_maps.max() / by_factors.max() - 1:+.4f} from that without maps")
    assert by_maps.max() == pytest.approx(by_factors.max(), rel=0.01)


@pytest.mark.parametrize(("texture", "wanted"), [(None, 0.96), ((51, 0, 0), 0.992)])
def test_a_coat_darkens_the_shadow_of_glass(
    gpu: GpuContext, tmp_path: Path, texture: tuple[int, ...] | None, wanted: float
) -> None:
    """By what it reflects of light that comes straight, where no beams bring it."""
    kept = []
    for coat in (0.0, 1.0):
        made = coated({"clearcoatFactor": coat}, color=1.0)
        if texture is not None:
            made.material["extensions"]["KHR_materials_clearcoat"]["clearcoatTexture"] = made.texture(
                even(*texture)
            )
        made.material["extensions"]["KHR_materials_transmission"] = {"transmissionFactor": 1.0}
        path, pose = str(made.write(tmp_path / f"{coat}.glb")), {"translation_m": [0, 0, 0.3]}
        asset = {"asset": path, "up_axis": "z", "pose": pose}
        document = Stage(tmp_path).document([asset], [directional((0, 0, -1))], floor(), caustics=False)
        found = solve(gpu, document)
        at_middle = (np.abs(found.position[..., :2]) < 0.1).all(axis=-1) & (found.matte == 0)
        kept.append(found.direct_rho[at_middle].mean() / found.direct_mu[at_middle].mean())
    print(f"{kept[0]:.4f} of the light without a coat, {kept[1]:.4f} with it")
    assert kept[1] / kept[0] == pytest.approx(wanted, abs=0.002)


def test_a_coat_has_a_normal_map_of_its_own(draw: Draw) -> None:
    """The base's tilt does not move the coat's highlight; the coat's own does."""
    lamp, tilt = [directional((0.35, 0.0, -1.0), 2.0, 1.0)], (204, 128, 231)
    coat = {"clearcoatFactor": 1.0, "clearcoatRoughnessFactor": 0.25}
    highlights = []
    for of_base, of_coat in ((False, False), (True, False), (False, True)):
        made = coated(dict(coat), color=0.0)
        if of_base:
            made.material["normalTexture"] = made.texture(even(*tilt), scale=0.3)
        if of_coat:
            normal = made.texture(even(*tilt), scale=0.3)
            made.material["extensions"]["KHR_materials_clearcoat"]["clearcoatNormalTexture"] = normal
        highlights.append(draw(made, lamp)[INSIDE][..., 1])
    assert highlights[1] == pytest.approx(highlights[0], rel=0.02, abs=1e-3)
    assert not np.allclose(highlights[2], highlights[0], rtol=0.2)


def test_a_coat_dims_what_glows_below(draw: Draw) -> None:
    made = coated({"clearcoatFactor": 1.0}, color=0.0)
    made.material["emissiveFactor"] = [0.5, 0.5, 0.5]
    assert draw(made, [])[INSIDE] == pytest.approx(np.full((60, 60, 3), 0.96 * 0.5), rel=0.01)


@pytest.mark.parametrize(
    "over", [{"clearcoatFactor": 1.0}, {"clearcoatFactor": 1.0, "clearcoatRoughnessFactor": 0.8}, None]
)
@pytest.mark.parametrize("shading", ["volume", "image_based", "precomputed"])
def test_in_even_light_white_plates_show_it(
    gpu: GpuContext, tmp_path: Path, shading: str, over: dict[str, Any] | None
) -> None:
    """Cones, rays across the picture and maps of light: under a smooth coat, a rough one and a sheen."""
    made = coated(
        over, None if over else {"sheenColorFactor": [1, 1, 1], "sheenRoughnessFactor": 0.5}, color=1.0
    )
    asset = {"asset": str(made.write(tmp_path / "plate.glb")), "up_axis": "z"}
    document = unlit(Stage(tmp_path).document([asset], [ambient(EVEN)]))
    renderer = SceneRenderer(
        gpu, document.replaced(shading=Shading(rays=64, bounces=0).replaced(name=shading)), with_linear=True
    )
    try:
        linear = renderer.render(seen_from_above(GREY)).linear
    finally:
        renderer.release()
    assert linear is not None
    assert linear[INSIDE] == pytest.approx(np.full((60, 60, 3), EVEN), rel=0.02)


@pytest.mark.parametrize("bumps", [False, True])
def test_a_smooth_coat_mirrors_objects(gpu: GpuContext, tmp_path: Path, bumps: bool) -> None:
    """By Schlick's term, over a black and rough base, whatever its normal map: a plate that glows behind it."""
    height, behind, half = 0.01, 0.15, 0.15
    made, glows = coated({"clearcoatFactor": 1.0}, color=0.0), Plate(2 * half, 2 * half)
    if bumps:
        made.material["normalTexture"] = made.texture(even(204, 128, 231), scale=0.3)
    glows.material |= {"pbrMetallicRoughness": {"baseColorFactor": [0, 0, 0, 1], "metallicFactor": 0}}
    glows.material |= {"emissiveFactor": [1, 1, 1], "doubleSided": True}
    upright = [np.sqrt(0.5), np.sqrt(0.5), 0, 0]
    poses = {"translation_m": [0, 0, height]}, {"translation_m": [0, behind, half], "rotation_wxyz": upright}
    assets = [
        {"id": name, "asset": str(plate.write(tmp_path / f"{name}.glb")), "up_axis": "z", "pose": pose}
        for name, plate, pose in zip(("coated", "glows"), (made, glows), poses, strict=True)
    ]
    view = frame(plain(0))
    found = solve(gpu, Stage(tmp_path).document(assets, [], floor()), view)
    assert view.pose is not None
    matrix = view.pose.world_from_camera
    rays = np.dstack([camera().rays(), np.ones((HEIGHT, WIDTH))]) @ matrix[:3, :3].T
    point = matrix[:3, 3] + floor_depth(view.pose, height)[..., None] * rays
    way = rays * (1, 1, -1) / np.linalg.norm(rays, axis=-1, keepdims=True)
    met = point + ((behind - point[..., 1]) / way[..., 1])[..., None] * way
    shows = (np.abs(point[..., :2]) < 0.4 * EDGE).all(axis=-1) & (way[..., 1] > 0)
    shows &= (np.abs(met[..., 0]) < 0.9 * half) & (met[..., 2] < 1.8 * half) & (met[..., 2] > 0.02)
    wanted = 0.04 + 0.96 * (1 - way[..., 2]) ** 5
    print(f"{shows.sum()} pixels of reflectance {wanted[shows].min():.3f} .. {wanted[shows].max():.3f}")
    assert shows.sum() > 200
    assert found.virtual_radiance[shows][:, 1] == pytest.approx(wanted[shows], abs=0.012)  # as lobe_albedo


def test_beams_and_voxels_share_what_coated_metal_reflects(gpu: GpuContext, tmp_path: Path) -> None:
    """Beams carry the metal's lobe alone, dimmed by the coat: by 0.04 where light comes straight from above."""
    sent = []
    for coat in (0.0, 1.0):
        made = coated({"clearcoatFactor": coat, "clearcoatRoughnessFactor": 0.6}, color=1.0)
        made.material["pbrMetallicRoughness"] |= {"metallicFactor": 1, "roughnessFactor": 0.1}
        path, pose = str(made.write(tmp_path / f"{coat}.glb")), {"translation_m": [0, 0, 0.1]}
        asset = {"asset": path, "up_axis": "z", "pose": pose}
        renderer = SceneRenderer(gpu, Stage(tmp_path).document([asset], [directional((0, 0, -1))], floor()))
        renderer.render(frame())
        sent.append(sent_flux(renderer))
        renderer.release()
    assert sent[1] / sent[0] == pytest.approx(0.96, abs=0.005)
