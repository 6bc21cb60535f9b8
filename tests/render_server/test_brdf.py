"""Energy of shaded surfaces: in even light a white one cannot be told from its surroundings (docs/method.md 4.7)."""

from pathlib import Path

import numpy as np
import pytest
from jaxtyping import Float32, Float64

from deltalight.protocol.frames import decode_lut
from deltalight.protocol.scene_objects import Material
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Kernel
from deltalight.render_server.renderer import SceneRenderer
from tests.render_server.scenes import (
    COARSE,
    GREY,
    Stage,
    ambient,
    array_of,
    ball,
    camera,
    fields_of,
    floor,
    frame,
    look_at,
    shifted,
    with_neighbours,
)

pytestmark = pytest.mark.usefixtures("clean_gl")
COSINES = np.array([0.05, 0.1, 0.2, 0.35, 0.5, 0.75, 1.0])
ROUGHNESSES = np.array([0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 0.85, 1.0])
WHITE = {"metal": (0.0, 1.0), "plastic": (1.0, 0.04), "glossy": (1.0, 0.08), "matt": (1.0, 0.0)}


def reflected(gpu: GpuContext, diffuse: float, f0: float) -> Float32[np.ndarray, "roughnesses cosines 4"]:
    """Of radiance 1 from everywhere: lights, gathered light, mean over all directions, wide lamps in the lobe."""
    roughness, cosine = np.meshgrid(ROUGHNESSES, COSINES, indexing="ij")
    surfaces = np.zeros((roughness.size, 8), np.float32)
    surfaces[:, :3], surfaces[:, 3] = diffuse, cosine.ravel()
    surfaces[:, 4:7], surfaces[:, 7] = f0, roughness.ravel()
    given, found = gpu.ctx.buffer(surfaces.tobytes()), gpu.ctx.buffer(reserve=16 * len(surfaces))
    kernel = Kernel(gpu, Path(__file__).with_name("furnace"))
    kernel.run((len(surfaces),), Surfaces=given, Found=found, count=len(surfaces))
    values = np.frombuffer(found.read(), np.float32).reshape(*roughness.shape, 4).copy()
    for item in (given, found, kernel):
        item.release()
    return values


@pytest.mark.parametrize("name", WHITE)
def test_white_surfaces_reflect_all_light(gpu: GpuContext, name: str) -> None:
    """From every side and at every roughness, by every path: within 2 %."""
    found = reflected(gpu, *WHITE[name])[..., :3]
    for path, values in zip(("lights", "gathered", "mean"), np.moveaxis(found, -1, 0), strict=True):
        print(f"{name}, {path}: {values.min():.3f} .. {values.max():.3f}")
    assert found == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize("f0", [0.3, 0.7])
def test_lights_and_gathered_light_reflect_alike(gpu: GpuContext, f0: float) -> None:
    found = reflected(gpu, 0.0, f0)
    assert found[..., 0] == pytest.approx(found[..., 1], abs=0.02)
    assert found[..., 0].max() < 1.0


def test_lamps_wider_than_the_lobe_keep_its_light(gpu: GpuContext) -> None:
    """A mirror shows lamps of half-angle 0.15 from all sides as one even light, within 5 %."""
    shown = reflected(gpu, 0.0, 1.0)[ROUGHNESSES <= 0.2][..., 3]
    print(f"{shown.min():.3f} .. {shown.max():.3f}")
    assert shown == pytest.approx(1.0, abs=0.05)


def highlights(radius: float, roughness: float) -> Float64[np.ndarray, "k 8"]:
    """Views and lamps around the mirrored direction, up to six times as far as both are wide, on all sides."""
    rows = []
    for inclined in np.radians([0.0, 20.0, 40.0]):
        view, mirrored = (np.array([side * np.sin(inclined), 0, np.cos(inclined)]) for side in (1, -1))
        for away in np.linspace(0, 6, 13) * (roughness**2 + radius / 2):
            for turn in np.radians([0.0, 90.0, 180.0]):
                beside = np.array([mirrored[2] * np.cos(turn), np.sin(turn), -mirrored[0] * np.cos(turn)])
                light = np.cos(away) * mirrored + np.sin(away) * beside
                rows.append([*view, roughness, *light, radius])
    lamps = np.array(rows)
    return lamps[lamps[:, 6] > np.sin(2 * radius)]  # wholly above the horizon


@pytest.mark.parametrize(("roughness", "radius"), [(0.2, 0.04), (0.3, 0.05), (0.3, 0.15), (0.5, 0.2)])
def test_a_highlight_is_the_mean_over_the_lamp(gpu: GpuContext, roughness: float, radius: float) -> None:
    """From its peak out to its tails: within 2 % at half of all places, within 20 % at every one."""
    given = highlights(radius, roughness).astype(np.float32)
    rows, kept = gpu.ctx.buffer(given.tobytes()), gpu.ctx.buffer(reserve=8 * len(given))
    kernel = Kernel(gpu, Path(__file__).with_name("lamp_lobe"))
    kernel.run((len(given),), Highlights=rows, Found=kept, count=len(given))
    found, mean = np.frombuffer(kept.read(), np.float32).reshape(-1, 2).T
    for item in (rows, kept, kernel):
        item.release()
    off = np.abs(found / mean - 1)
    print(f"{roughness}, {radius}: median {np.median(off):.4f}, worst {off.max():.3f}")
    assert np.median(off) < 0.02
    assert off.max() < 0.2


ANGLES = np.array([0.3, 0.45, 0.6, 0.75, 0.9, 1.0])  # bounds of the cosines between normal and view
PATHS: dict[str, dict[str, object]] = {
    "exact": {"name": "dvct", **COARSE, "volume_size": 32, "volume_edge_m": 0.8, "cone_scale": 2},
    "paper": {"name": "dvct", "operator": "paper", **COARSE, "volume_size": 32, "cone_scale": 2},
    "differential": {"name": "differential", **COARSE, "volume_size": 32, "volume_edge_m": 0.8},
    "dlpv": {"name": "dlpv", "volume_size": 32, "volume_edge_m": 0.8, "query_scale": 2},
    "dlpv-paper": {"name": "dlpv", "operator": "paper", "volume_size": 32, "query_scale": 2},
    "aroof": {"name": "aroof", "resolution": 16, "rays": 256, "shading_scale": 2},
}
ALONE, ON_FLOOR = 2.0, 0.0  # m that the floor lies below
EYE = (0.0, -0.6, 0.4)


def white_ball(
    gpu: GpuContext, stage: Stage, path: str, below_m: float
) -> dict[str, Float64[np.ndarray, " angles"]]:
    """Radiance of a white ball beside a matt one by finish, mean of the pixels at each of the ANGLES.

    All that surrounds them has radiance 1: the sky, and a floor that reflects all light.
    """
    around = float(decode_lut(None)[GREY, 0])
    balls = [ball(0.06, (-0.07, 0, 0.1), 4), ball(0.06, (0.07, -0.02, 0.09), 4)]
    if path == "paper":
        del balls[1]  # [P1] lights objects by lamps alone where others see them
    objects = [stage.virtual(mesh, (1.0, 1.0, 1.0)) for mesh in balls]
    document = stage.document(objects, [ambient(around)], shifted(floor(0.25), 0, 0, -below_m))
    real = document.real.replaced(unseen_albedo=0.95)
    document = document.replaced(real=real, method=PATHS[path])
    picture = np.full((240, 320, 3), GREY, np.uint8)  # of the whole floor
    view = frame(picture, pose=look_at(EYE, (0.0, 0.0, 0.06)), camera=camera(320, 240, 300.0))
    renderer, found = SceneRenderer(gpu, document), {}
    renderer.render(view)  # waits for what is precomputed of these objects
    first = document.objects[0]
    assert isinstance(first.material, Material)
    for name, finish in FINISHES.items():
        item = first.replaced(material=first.material.replaced(**finish))
        renderer.set_scene(document.replaced(objects=(item, *document.objects[1:])))
        renderer.render(view)
        found[name] = by_angle(renderer) / around
    renderer.release()
    return found


def by_angle(renderer: SceneRenderer) -> Float64[np.ndarray, " angles"]:
    """Mean radiance of the object on the left, for each of the ANGLES that are shown."""
    fields, graph = fields_of(renderer), renderer.graph
    assert graph is not None
    surface = graph["object surface"].buffer
    position, normal = (array_of(each)[..., :3] for each in (surface.position, surface.normal))
    away = np.asarray(EYE) - position
    cosine = (away * normal).sum(axis=-1) / np.linalg.norm(away, axis=-1)
    shown = with_neighbours(fields.matte == 1) & (position[..., 0] < 0)
    place = np.digitize(cosine, ANGLES)
    groups = [shown & (place == number) for number in range(1, len(ANGLES))]
    assert all(group.sum() > 30 for group in groups)
    return np.array([fields.virtual_radiance[group].mean() for group in groups])


FINISHES: dict[str, dict[str, float]] = {
    "matt": {"specular": 0.0},
    **{f"metal {r}": {"metallic": 1.0, "roughness": r} for r in (0.02, 0.25, 0.35, 0.5, 1.0)},
    **{f"glossy {r}": {"specular": 1.0, "roughness": r} for r in (0.02, 0.35, 1.0)},
}


@pytest.mark.parametrize(
    ("path", "below_m", "bound"),
    [
        ("exact", ON_FLOOR, 0.02),  # rays between objects, cones over the picture, cones through voxels
        ("differential", ON_FLOOR, 0.02),
        ("dlpv", ON_FLOOR, 0.02),
        ("dlpv-paper", ALONE, 0.02),
        ("paper", ALONE, 0.09),  # cones start two voxels off, and meet the object's own
        pytest.param("aroof", ALONE, 0.03, marks=pytest.mark.slow(seconds=25)),  # nine harmonics
        pytest.param("aroof", ON_FLOOR, 0.1, marks=pytest.mark.slow(seconds=25)),
    ],
)
def test_white_balls_cannot_be_told_from_their_surroundings(
    gpu: GpuContext, tmp_path: Path, path: str, below_m: float, bound: float
) -> None:
    """Of every finish and from every side."""
    found = white_ball(gpu, Stage(tmp_path), path, below_m)
    for name, shares in found.items():
        print(f"{path}, {name}: {np.round(shares, 3)}")
    for name, shares in found.items():
        assert shares == pytest.approx(1.0, abs=bound), name
