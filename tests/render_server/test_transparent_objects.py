"""Transparent objects by closed forms: where rays go, what is left of them, where their light falls."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from jaxtyping import Float64

from deltalight.benchmarks.gltf_plate import Plate
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import decode_lut
from deltalight.protocol.scene import SceneDocument
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Kernel
from deltalight.render_server.gpu.textures import read_texture
from deltalight.render_server.renderer import SceneRenderer
from deltalight.render_server.scene.asset_check import left_out, read_gltf
from deltalight.render_server.scene.mesh_loading import load_mesh
from tests.render_server.scenes import (
    COARSE,
    EYE,
    FOCAL,
    GREY,
    HEIGHT,
    WIDTH,
    Fields,
    Stage,
    ambient,
    array_of,
    ball,
    checkered,
    cube,
    directional,
    fields_of,
    floor,
    frame,
    look_at,
    plain,
    shifted,
    sphere_light,
)

pytestmark = pytest.mark.usefixtures("clean_gl")
IOR = 1.5
CLEAR: dict[str, Any] = {
    "base_color": (1.0, 1.0, 1.0),
    "roughness": 0.0,
    "specular": 0.5,
    "ior": IOR,
    "transmission": 1.0,
}
RADIUS, ABOVE = 0.04, 0.2
IRRADIANCE = 2.0
# Irradiance beside which colours of the picture do not count: what objects change of light is grey.
STRONG = 50.0
SHADINGS = ("auto", "image_based", "precomputed")


@pytest.fixture
def stage(tmp_path: Path) -> Stage:
    return Stage(tmp_path, {**COARSE, "cone_scale": 1})


def glass(stage: Stage, mesh: trimesh.Trimesh, **material: Any) -> dict[str, Any]:  # noqa: ANN401
    return stage.virtual(mesh, material={**CLEAR, **material})


def pane(thickness: float = 0.03, half: float = 0.12, height: float = 0.1) -> trimesh.Trimesh:
    return shifted(trimesh.creation.box((2 * half, 2 * half, thickness)), 0, 0, height)


def rendered(
    gpu: GpuContext, document: SceneDocument, color: np.ndarray | None = None
) -> tuple[np.ndarray, Fields, np.ndarray]:
    """What the objects let through (h, w, 3), the fields, and the irradiance of beams on real pixels (h, w, 3)."""
    renderer = SceneRenderer(gpu, document)
    renderer.render(frame(color))
    found, graph = fields_of(renderer), renderer.graph
    assert graph is not None
    through = array_of(graph["transmitted light"])[..., :3] - found.virtual_radiance
    beams, light = graph["caustics"], np.zeros((HEIGHT, WIDTH, 3))
    if beams is not None:
        sums = np.frombuffer(beams.bindings["CausticSums"].read(), np.int32).reshape(2, HEIGHT, WIDTH, 2, 3)
        light = sums[:, :, :, 0].sum(axis=0) / 2.0**20
    renderer.release()
    return through, found, light


def shaded_by(name: str, document: SceneDocument) -> SceneDocument:
    return document.replaced(shading=document.shading.replaced(name=name))


def fresnel(cosine: np.ndarray, eta: np.ndarray | float) -> Float64[np.ndarray, " n"]:
    """Reflectance by Fresnel's equations in angles (Born and Wolf, 1.5.2)."""
    entering = np.arccos(cosine)
    sine = np.asarray(eta * np.sin(entering))
    leaving = np.arcsin(np.minimum(sine, 1.0))
    across = (np.sin(entering - leaving) / np.sin(entering + leaving)) ** 2
    along = (np.tan(entering - leaving) / np.tan(entering + leaving)) ** 2
    return np.where(sine >= 1, 1.0, (across + along) / 2)


def test_fresnel_and_total_reflection(gpu: GpuContext) -> None:
    """Reflectance from both sides; the same along a ray's way back; total from the critical angle on."""
    cosines = np.concatenate(
        [np.linspace(0.02, 0.999, 90), np.cos(np.arcsin(1 / IOR)) + np.array([-1e-3, 1e-3])]
    )
    pairs = np.array([(c, eta) for eta in (1 / IOR, IOR) for c in cosines], np.float32)
    given, out = gpu.ctx.buffer(pairs.tobytes()), gpu.ctx.buffer(reserve=4 * len(pairs))
    kernel = Kernel(gpu, Path(__file__).with_name("refraction"))
    kernel.run((len(pairs),), Surfaces=given, Found=out, count=len(pairs))
    found = np.frombuffer(out.read(), np.float32).astype(float)
    for item in (given, out, kernel):
        item.release()
    assert found == pytest.approx(fresnel(pairs[:, 0].astype(float), pairs[:, 1].astype(float)), abs=2e-4)
    assert found[-2] == 1.0
    assert found[-1] < 1.0


def ramps() -> np.ndarray:
    """A picture whose red and green tell a pixel's column and row relative to its blue."""
    code = np.full((HEIGHT, WIDTH, 3), 150.0)
    code[..., 0] = 60 + np.arange(WIDTH)
    code[..., 1] = 60 + np.arange(HEIGHT)[:, None]
    return code.astype(np.uint8)


def place_in_ramps(through: np.ndarray) -> np.ndarray:
    """Columns and rows (n, 2) of the picture that pixels (n, 3) see, whatever their brightness."""
    decode = decode_lut(None)[:, 0].astype(float)
    shown = through[..., :2] / through[..., 2:] * decode[150]
    return np.interp(shown, decode, np.arange(256)) - 60


def evenly_lit(through: np.ndarray, among: np.ndarray) -> np.ndarray:
    """Pixels behind which neither shadow nor beams end: there the light is not grey beside the picture's colours."""
    blue = through[..., 2]
    return np.asarray(np.abs(blue / np.median(blue[among]) - 1) < 0.15)


def test_slab_shifts_what_is_behind(gpu: GpuContext, stage: Stage) -> None:
    """t sin(a) (1 - cos a / sqrt(n^2 - sin^2 a)) aside, within a pixel (Hecht, Optics, 4.4)."""
    thickness = 0.06
    document = stage.document(
        [glass(stage, pane(thickness))], [directional((0.0, 0.0, -1.0), STRONG)], floor()
    )
    through, found, _ = rendered(gpu, document, ramps())
    pose = look_at().world_from_camera
    rays = np.dstack([frame().camera.rays(), np.ones((HEIGHT, WIDTH))]) @ pose[:3, :3].T
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    cosine = -rays[..., 2]
    sine = np.sqrt(1 - cosine**2)
    aside = thickness * sine * (1 - cosine / np.sqrt(IOR**2 - sine**2))
    down = np.array([0.0, 0.0, -1.0])
    # The ray leaves parallel to itself, nearer to the normal's foot.
    sideways = down - cosine[..., None] * rays
    sideways /= np.linalg.norm(sideways, axis=2, keepdims=True)
    start = np.asarray(EYE) + aside[..., None] * sideways
    met = start - rays * (start[..., 2:] / rays[..., 2:])
    c = (met - pose[:3, 3]) @ pose[:3, :3]
    expected = FOCAL * c[..., :2] / c[..., 2:] + np.array([(WIDTH - 1) / 2, (HEIGHT - 1) / 2])
    plain_place = np.stack(np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT)), axis=-1)
    middle = np.zeros((HEIGHT, WIDTH), bool)
    middle[49:57, 70:90] = True  # enters by the top face and leaves by the bottom
    assert (found.matte[middle] == 1).all()
    middle &= evenly_lit(through, middle)
    assert middle.sum() > 100
    off = place_in_ramps(through[middle]) - expected[middle]
    shift = np.linalg.norm((expected - plain_place)[middle], axis=1)
    print(f"shift {shift.mean():.2f} px, off {np.abs(off).max():.2f} px")
    assert shift.min() > 3.0
    assert np.abs(off).max() < 1.0


@pytest.mark.parametrize("shading", SHADINGS)
def test_absorption_follows_beers_law(gpu: GpuContext, stage: Stage, shading: str) -> None:
    """A path l inside turns white light into color^(l / distance)."""
    thickness, color, distance_m = 0.03, (0.2, 0.5, 0.9), 0.04
    lights = [ambient(0.0)]
    tint = {"attenuation_color": color, "attenuation_distance_m": distance_m}
    below = shifted(floor(6.0), 0, 0, -2.0)  # so far that the pane does not tint its light
    clear, found, _ = rendered(
        gpu, shaded_by(shading, stage.document([glass(stage, pane(thickness))], lights, below))
    )
    tinted, _, _ = rendered(
        gpu, shaded_by(shading, stage.document([glass(stage, pane(thickness), **tint)], lights, below))
    )
    pixel = (58, 80)
    rays = np.append(frame().camera.rays()[pixel], 1.0) @ look_at().world_from_camera[:3, :3].T
    sine = np.sqrt(1 - (rays[2] / np.linalg.norm(rays)) ** 2)
    path = thickness / np.sqrt(1 - (sine / IOR) ** 2)
    assert found.matte[pixel] == 1
    assert tinted[pixel] / clear[pixel] == pytest.approx(np.array(color) ** (path / distance_m), rel=0.02)


@pytest.mark.parametrize("shading", SHADINGS)
def test_clear_objects_neither_make_nor_lose_light(gpu: GpuContext, stage: Stage, shading: str) -> None:
    """In surroundings of one radiance a clear ball and a clear cube show just that: R + T = 1 at all angles."""
    around = float(decode_lut(None)[GREY, 0])
    far_below = shifted(floor(0.05), 0, 0, -2.0)
    for mesh in (ball(0.1, (0, 0, 0.06), 4), cube(0.16)):
        document = stage.document([glass(stage, mesh)], [ambient(around)], far_below)
        through, found, _ = rendered(gpu, shaded_by(shading, document))
        inside = found.matte == 1
        whole = (found.virtual_radiance[..., :3] + through)[inside] / around
        print(f"{whole.min():.3f} .. {whole.max():.3f}, mean {whole.mean():.3f}")
        low, high = np.quantile(whole, (0.05, 0.95))
        assert low > 0.95
        assert high < 1.03
        assert whole.mean() == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize(
    "method",
    [
        {"name": "dvct", **COARSE, "cone_scale": 1},
        {"name": "dlpv", "query_scale": 1},
        {"name": "aroof", "shading_scale": 1, "resolution": 12, "rays": 64},
    ],
)
def test_what_lies_behind_is_seen_whatever_shades_the_object(
    gpu: GpuContext, stage: Stage, method: dict[str, object]
) -> None:
    """Refracted as with the method's own shading: of the picture, and of what is out of it."""
    lights = [sphere_light((0.4, -0.6, 0.9), 1.0, 0.05), ambient(0.2)]
    document = stage.document([glass(stage, ball(0.1, (0, 0, 0.15), 4))], lights, floor())
    document = document.replaced(method=method)
    own, found, _ = rendered(gpu, document, checkered())
    inside = found.matte == 1
    assert own[inside].std() > 0.2 * own[inside].mean() > 0.01
    for shading in SHADINGS[1:]:
        through, other, _ = rendered(gpu, shaded_by(shading, document), checkered())
        brightest = own + np.maximum(found.virtual_radiance, other.virtual_radiance)
        rounding = (2e-3 * brightest)[inside]  # sums with what surfaces reflect have 11 bits
        assert (np.abs(through - own)[inside] < rounding).all()


def test_a_pane_shows_the_lamp_behind_it(gpu: GpuContext, stage: Stage) -> None:
    """As large as it is seen, as bright but for what both faces reflect, and without a halo."""
    eye, at, radius, intensity = np.array([0.0, -0.9, 0.3]), np.array([0.0, 1.1, 0.8]), 0.12, 0.05
    pane = shifted(trimesh.creation.box((0.4, 0.002, 0.4)), 0, 0, 0.55)
    lamp = sphere_light((at[0], at[1], at[2]), intensity, radius)
    renderer = SceneRenderer(gpu, stage.document([glass(stage, pane)], [lamp], floor()))
    renderer.render(frame(pose=look_at((eye[0], eye[1], eye[2]), (0.0, 0.0, 0.55))))
    assert renderer.graph is not None
    through = array_of(renderer.graph["transmitted light"]) - array_of(renderer.graph["object radiance"])
    renderer.release()
    shown = through[..., 1]
    passing = float((1 - fresnel(np.array([0.96]), 1 / IOR)[0]) ** 2)
    radiance = intensity / (np.pi * radius**2)
    assert np.quantile(shown[shown > 0.5 * radiance], 0.5) == pytest.approx(passing * radiance, rel=0.03)
    disc_px = FOCAL * radius / np.linalg.norm(at - eye)
    assert (shown / (passing * radiance)).sum() == pytest.approx(np.pi * disc_px**2, rel=0.1)
    assert np.count_nonzero(shown > 1e-4 * radiance) < np.pi * (disc_px + 1.5) ** 2


def beams_of(gpu: GpuContext, document: SceneDocument) -> np.ndarray:
    """Beams (k, 16) as shaders/common/beams.glsl packs them: start, direction, flux, footprint."""
    renderer = SceneRenderer(gpu, document)
    renderer.render(frame())
    assert renderer.graph is not None
    caustics = renderer.graph["caustic ends"]
    count = int(np.frombuffer(caustics._count.read(), np.uint32)[0])
    beams = read_texture(caustics._beams).reshape(-1, 16)[:count]  # rows of 256
    renderer.release()
    return beams.astype(float)


def test_ball_lens_gathers_light_in_its_focus(gpu: GpuContext, stage: Stage) -> None:
    """Beams r from the axis cross it r / sin(2 (asin(r/R) - asin(r/nR))) from the middle, near it nR / (2 (n - 1)).

    And they carry what two surfaces let through.
    """
    document = stage.document(
        [glass(stage, ball(RADIUS, (0, 0, ABOVE), 5))], [directional((0.0, 0.0, -1.0), IRRADIANCE)], floor()
    )
    beams = beams_of(gpu, document)
    down = beams[(beams[:, 6] < -0.5) & (beams[:, 2] < ABOVE)]
    start, direction, flux = down[:, :3] - [0, 0, ABOVE], down[:, 4:7], down[:, 8]
    across = np.linalg.norm(direction[:, :2], axis=1)
    inward = -(start[:, :2] * direction[:, :2]).sum(axis=1) / np.maximum(across**2, 1e-12)
    axis_z = -(start + inward[:, None] * direction)[:, 2]
    # Distance from the axis before the ball: that of the ray that leaves, for the ball is symmetric.
    offset = np.linalg.norm(np.cross(start, direction), axis=1)
    focus = offset / np.sin(2 * (np.arcsin(offset / RADIUS) - np.arcsin(offset / (IOR * RADIUS))))
    some = (offset > 0.1 * RADIUS) & (offset < 0.8 * RADIUS)
    assert some.sum() > 500
    assert np.median(np.abs(axis_z / focus - 1)[some]) < 0.01
    paraxial = (offset > 0.05 * RADIUS) & (offset < 0.25 * RADIUS)
    assert axis_z[paraxial].mean() == pytest.approx(IOR * RADIUS / (2 * (IOR - 1)), rel=0.03)
    met = np.linspace(0, 0.85, 20001)[1:]
    passed = np.average((1 - fresnel(np.sqrt(1 - met**2), 1 / IOR)) ** 2, weights=met)
    within = flux[offset < 0.85 * RADIUS].sum()
    assert within == pytest.approx(passed * np.pi * (0.85 * RADIUS) ** 2 * IRRADIANCE, rel=0.03)


def test_both_faces_of_a_pane_throw_light_back(gpu: GpuContext, stage: Stage) -> None:
    """Of light on a pane 2 R / (1 + R) is thrown back and (1 - R) / (1 + R) goes through (Stokes 1862)."""
    elevation = np.radians(30)
    sun = directional((0.0, np.cos(elevation), -np.sin(elevation)), IRRADIANCE)
    upright = shifted(trimesh.creation.box((0.16, 0.0005, 0.06)), 0, 0, 0.04)
    beams = beams_of(gpu, stage.document([glass(stage, upright)], [sun], floor()))
    level = np.abs(beams[:, 6] + np.sin(elevation)) < 1e-3
    through, back = (beams[level & (sign * beams[:, 5] > 0.5), 8].sum() for sign in (1, -1))
    reflectance = fresnel(np.array([np.cos(elevation)]), 1 / IOR)[0]
    met = IRRADIANCE * 0.16 * 0.06 * np.cos(elevation)
    print(f"back {back / met:.4f}, through {through / met:.4f}, R {reflectance:.4f}")
    assert back / met == pytest.approx(2 * reflectance / (1 + reflectance), rel=0.04)
    assert through / met == pytest.approx((1 - reflectance) / (1 + reflectance), rel=0.01)
    assert back + through < 1.005 * met


def below_pane(found: Fields) -> np.ndarray:
    """Pixels of the floor below the middle of the pane."""
    place = found.position
    on_floor = (place[..., 3] > 0) & (np.abs(place[..., 2]) < 1e-3)
    return np.asarray(on_floor & (np.abs(place[..., :2]) < 0.06).all(axis=2))


def test_light_through_a_tinted_pane_counts_once(gpu: GpuContext, stage: Stage) -> None:
    """Its colour twice, Fresnel twice and Beer: by beams, and without them by the shadow maps."""
    tint, color = np.array((0.9, 0.6, 0.3)), np.array((0.5, 0.7, 0.9))
    thickness, distance_m = 0.01, 0.02
    material = {
        "base_color": tuple(tint),
        "attenuation_color": tuple(color),
        "attenuation_distance_m": distance_m,
    }
    expected = IRRADIANCE * (0.96 * tint) ** 2 * color ** (thickness / distance_m)
    sun = [directional((0.0, 0.0, -1.0), IRRADIANCE)]
    pane_above = [glass(stage, pane(thickness, 0.12, 0.06), **material)]
    _, found, light = rendered(gpu, stage.document(pane_above, sun, floor()))
    below = below_pane(found)
    assert below.sum() > 100
    assert light[below].mean(axis=0) == pytest.approx(expected, rel=0.04)
    assert found.direct_rho[below].mean(axis=0) == pytest.approx(expected, rel=0.04)
    _, mapped, none = rendered(gpu, stage.document(pane_above, sun, floor(), caustics=False))
    assert not none.any()
    # The mean path through a box 2 cm thinner than wide is a little shorter than twice the thickness.
    path = 4 * (0.24 * 0.24 * thickness) / (2 * 0.24 * 0.24 + 4 * 0.24 * thickness)
    by_maps = IRRADIANCE * (0.96 * tint) ** 2 * color ** (path / distance_m)
    assert mapped.direct_rho[below].mean(axis=0) == pytest.approx(by_maps, rel=0.02)
    np.testing.assert_allclose(mapped.direct_mu[below], IRRADIANCE, rtol=2e-3)


@pytest.mark.parametrize(("incidence_deg", "gap"), [(0, 0.0005), (50, 0.0005), (50, -0.0005)])
def test_slanting_light_through_a_slab_that_lies_on_the_floor(
    gpu: GpuContext, stage: Stage, incidence_deg: float, gap: float
) -> None:
    """Beams end where they start, and light the floor on both sides of that: (1 - R) / (1 + R) goes through.

    So they do if noise of depth lifts the floor above the slab's lower face.
    """
    angle, thickness = np.radians(incidence_deg), 0.02
    sun = directional((np.sin(angle), 0.0, -np.cos(angle)), IRRADIANCE)
    slab = glass(stage, pane(thickness, 0.12, gap + thickness / 2))
    _, found, light = rendered(gpu, stage.document([slab], [sun], floor()))
    reflectance = 0.04 if incidence_deg == 0 else fresnel(np.array([np.cos(angle)]), 1 / IOR)[0]
    expected = IRRADIANCE * np.cos(angle) * (1 - reflectance) / (1 + reflectance)
    below = below_pane(found)
    print(f"{incidence_deg} degrees, {1000 * gap} mm: {light[below].mean() / expected:.3f} of the light")
    assert light[below].mean(axis=0) == pytest.approx(np.full(3, expected), rel=0.04)


def test_transparent_walls_hide_less_natural_light(gpu: GpuContext, stage: Stage) -> None:
    """Voxels of a clear cube block what it reflects, those of a matt one all; thin walls, which bend no cones."""
    kept = []
    for transmission in (0.0, 1.0):
        item = glass(stage, cube(0.1), transmission=transmission, thin_walled=True)
        document = stage.document([item], [ambient(1.0)], floor())
        _, found, _ = rendered(gpu, document)
        place = found.position
        beside = (place[..., 3] > 0) & (np.abs(place[..., 2]) < 1e-3) & (found.matte == 0)
        beside &= (np.abs(place[..., 0]) < 0.05) & (place[..., 1] < -0.055) & (place[..., 1] > -0.09)
        kept.append((found.cones_rho[beside] / found.cones_mu[beside]).mean())
    assert kept[0] < 0.95
    assert 1 - kept[1] < 0.35 * (1 - kept[0])


def test_thin_walls_bend_nothing(gpu: GpuContext, stage: Stage) -> None:
    """What is behind a thin-walled ball is seen where it is, once tinted for each wall."""
    tint = (0.5, 0.8, 1.0)
    item = glass(stage, ball(0.1, (0, 0, 0.15), 4), base_color=tint, thin_walled=True)
    through, found, _ = rendered(
        gpu, stage.document([item], [directional((0.0, 0.0, -1.0), STRONG)], floor()), ramps()
    )
    rows, columns = np.nonzero(found.matte == 1)
    middle = (rows > 48) & (rows < 57) & (np.abs(columns - columns.mean()) < 8)
    middle &= evenly_lit(through[rows, columns], middle)
    assert middle.sum() > 80
    seen = np.stack([columns, rows], axis=1)[middle]
    white = place_in_ramps(through[seen[:, 1], seen[:, 0]] / np.square(tint))
    assert white == pytest.approx(seen, abs=1.0)


def test_opaque_parts_of_a_scene_with_glass_keep_their_light(gpu: GpuContext, stage: Stage) -> None:
    """A matt cube far from a glass ball is drawn as without it."""
    matt = {**stage.virtual(cube(0.06, (-0.15, 0.0, 0.0))), "id": "matt"}
    far = {**glass(stage, ball(0.02, (0.22, 0.1, 0.05), 3)), "id": "far"}
    lights = [directional((0.0, 0.3, -1.0), IRRADIANCE)]
    through, with_glass, _ = rendered(gpu, stage.document([matt, far], lights, floor()), plain())
    _, alone, _ = rendered(gpu, stage.document([matt], lights, floor()), plain())
    on_cube = (alone.matte == 1) & (with_glass.matte == 1)
    assert on_cube.sum() > 50
    assert not through[on_cube].any()
    a, b = (fields.virtual_radiance[on_cube] for fields in (with_glass, alone))
    np.testing.assert_allclose(a, b, atol=0.02)


def sheet(folder: Path, **extensions: Any) -> Path:  # noqa: ANN401
    plate = Plate(0.1, 0.1)
    names = {f"KHR_materials_{name}": value for name, value in extensions.items()}
    plate.material = {"name": "pane", "extensions": names}
    plate.glb.document["extensionsUsed"] = [*names]
    return plate.write(folder / "sheet.glb")


def test_transmission_and_volume_of_gltf_files(tmp_path: Path) -> None:
    """Factors are read, walls without thickness are thin, nothing counts as left out."""
    volume = {"thicknessFactor": 0.1, "attenuationColor": [0.5, 1.0, 0.25], "attenuationDistance": 0.2}
    path = sheet(tmp_path, transmission={"transmissionFactor": 0.75}, volume=volume, ior={"ior": 1.3})
    assert left_out(read_gltf(path)) is None
    material = load_mesh(path)[0].material
    assert (material.transmission, material.is_thin, material.refraction_index) == (0.75, False, 1.3)
    expected = [np.log(2) / 0.2, 0.0, np.log(4) / 0.2]
    assert material.absorption_per_m == pytest.approx(np.array(expected), rel=1e-5)
    thin = load_mesh(sheet(tmp_path, transmission={"transmissionFactor": 1}))[0].material
    assert thin.is_thin
    assert thin.refraction_index == pytest.approx(1.5)
    assert not thin.absorption_per_m.any()


def test_faulty_volumes_are_refused(tmp_path: Path) -> None:
    for distance in (0.0, -1.0):
        with pytest.raises(
            DeltalightError, match=r"`pane` has an attenuationDistance that is not above 0; correct it"
        ):
            load_mesh(sheet(tmp_path, volume={"thicknessFactor": 1, "attenuationDistance": distance}))
    with pytest.raises(DeltalightError, match="a value below 0 or not finite"):
        load_mesh(sheet(tmp_path, transmission={"transmissionFactor": -0.5}))
