"""Measured materials as they are drawn: closed forms of the same sum of Gaussians."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import ViewFrame, decode_lut
from deltalight.protocol.scene_output import Shading
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.renderer import SceneRenderer
from deltalight.render_server.scene.gaussian_brdf import GaussianBrdf
from deltalight.render_server.scene.material_file import write_material
from tests.render_server.brdf_samples import grey_brdf
from tests.render_server.scenes import (
    GREY,
    HEIGHT,
    WIDTH,
    ObjectsRenderer,
    Stage,
    ambient,
    camera,
    depth_image,
    directional,
    frame,
    look_at,
    plain,
    unlit,
)

pytestmark = pytest.mark.usefixtures("clean_gl")
PAINT = GaussianBrdf(
    np.array([0.05, 0.1, 0.3]),
    np.array([0.05, 0.25]),
    np.array(
        [[[0.04, 0.05, 0.06]] * 5 + [[0.9, 0.9, 0.9]], np.linspace((0.3, 0.1, 0.0), (0.1, 0.2, 0.3), 6)]
    ),
)
EVEN = float(decode_lut(None)[GREY, 0])  # radiance
EYE, RADIUS = (0.0, 0.0, 1.0), 0.25
LAMP = (0.5, 0.3, -0.9)  # the way the light travels


def seen(code: int = 0) -> ViewFrame:
    """A room of one brightness, far away."""
    depth = depth_image(np.full((HEIGHT, WIDTH), 3.0, np.float32))
    return frame(plain(code), pose=look_at(EYE, (0.0, 0.0, 0.0)), depth=depth)


def sphere(stage: Stage, brdf: GaussianBrdf | None, **material: Any) -> dict[str, Any]:  # noqa: ANN401
    made = trimesh.creation.icosphere(5, RADIUS)
    path = stage.folder / "ball.ply"
    made.export(path, vertex_normal=True)
    if brdf is not None:
        write_material(stage.folder / "paint.dlmat", brdf)
        material = {"precomputed": str(stage.folder / "paint.dlmat")}
    return {"asset": str(path), "material": material}


def surface() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixels well inside the sphere's outline; normals and directions to the eye there."""
    rays = np.dstack([camera().rays(), np.ones((HEIGHT, WIDTH))]).reshape(-1, 3)
    along = rays @ look_at(EYE, (0.0, 0.0, 0.0)).world_from_camera[:3, :3].T
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    eye = np.array(EYE)
    b, c = along @ eye, eye @ eye - RADIUS**2
    hits = b * b > c
    distance = -b - np.sqrt(np.where(hits, b * b - c, 0))
    normals = (eye + distance[:, None] * along) / RADIUS
    inside = hits & ((normals * -along).sum(axis=1) > 0.35)
    return inside.reshape(HEIGHT, WIDTH), normals[inside], -along[inside]


def about_normal(normals: np.ndarray, *directions: np.ndarray) -> list[np.ndarray]:
    """Directions in frames whose z are the normals."""
    aside = np.cross(normals, [0.3, 0.9, 0.2])
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    axes = np.stack([aside, np.cross(normals, aside), normals], axis=1)
    return [np.einsum("nij,nj->ni", axes, np.broadcast_to(each, normals.shape)) for each in directions]


def reflected(brdf: GaussianBrdf, normals: np.ndarray, views: np.ndarray, irradiance: float) -> np.ndarray:
    to_light = -np.array(LAMP) / np.linalg.norm(LAMP)
    light, view = about_normal(normals, to_light, views)
    lit = np.maximum(light[:, 2:], 0)
    light[:, 2] = np.maximum(light[:, 2], 1e-4)
    return np.asarray(irradiance * lit * brdf.evaluate(light, view))


def test_a_sphere_under_a_lamp_is_the_sum(objects: ObjectsRenderer, tmp_path: Path) -> None:
    stage = Stage(tmp_path)
    document = unlit(stage.document([sphere(stage, PAINT)], [directional(LAMP, 2.0)]))
    inside, normals, views = surface()
    lit = normals @ LAMP < -0.2 * np.linalg.norm(LAMP)  # beyond, the shadow map's texels show
    found = objects.linear(document, seen())[inside][lit]
    wanted = reflected(PAINT, normals, views, 2.0)[lit]
    error = np.abs(found - wanted)
    print(f"brightest {wanted.max():.2f}, error {error.max():.4f}, mean {error.mean():.5f}")
    assert wanted.max() > 5 * np.median(wanted), "a highlight is seen"
    assert error.mean() < 0.005 * wanted.mean()
    assert np.quantile(error / (wanted + 0.02), 0.99) < 0.02


def test_a_wide_lamp_widens_the_highlight_and_keeps_its_light(
    objects: ObjectsRenderer, tmp_path: Path
) -> None:
    stage = Stage(tmp_path)
    sums, peaks = [], []
    inside, *_ = surface()
    for radius_deg in (0.0, 12.0):
        lights = [directional(LAMP, 2.0, radius_deg)]
        document = unlit(stage.document([sphere(stage, grey_brdf(0.0, (0.08, 0.3, 0.3)))], lights))
        picture = objects.linear(document, seen())[inside]
        sums.append(picture.sum())
        peaks.append(picture.max())
    assert sums[1] == pytest.approx(sums[0], rel=0.06)
    assert peaks[1] == pytest.approx(peaks[0] * 0.08**2 / (0.08**2 + np.radians(12) ** 2 / 16), rel=0.1)


def test_lambertian_data_are_a_lambertian_surface(objects: ObjectsRenderer, tmp_path: Path) -> None:
    stage = Stage(tmp_path)
    lights = [directional(LAMP, 1.5), ambient(0.3)]
    plain = sphere(stage, None, base_color=[0.6] * 3, specular=0)
    pictures = [
        objects.draw(unlit(stage.document([each], lights)), seen()).color
        for each in (sphere(stage, grey_brdf(0.6)), plain)
    ]
    assert np.abs(pictures[0].astype(int) - pictures[1]).max() <= 1


@pytest.mark.parametrize("shading", ["volume", "image_based", "precomputed"])
def test_in_even_light_it_reflects_its_albedo(gpu: GpuContext, tmp_path: Path, shading: str) -> None:
    stage = Stage(tmp_path)
    document = stage.document([sphere(stage, PAINT)], [ambient(EVEN)])
    document = unlit(document).replaced(shading=Shading(rays=64, bounces=0).replaced(name=shading))
    renderer = SceneRenderer(gpu, document, with_linear=True)
    try:
        linear = renderer.render(seen(GREY)).linear
    finally:
        renderer.release()
    assert linear is not None
    inside, normals, views = surface()
    cosines = (normals * views).sum(axis=1)
    at = np.linspace(0, 1, 16)
    lobes = PAINT.lobe_albedos.sum(axis=1)
    wanted = EVEN * (PAINT.diffuse + np.stack([np.interp(cosines, at, each) for each in lobes.T], axis=1))
    error = np.abs(linear[inside] - wanted) / wanted
    print(f"{shading}: error {error.mean():.4f}, at most {error.max():.4f}")
    assert error.mean() < 0.003
    assert error.max() < 0.02


def test_what_is_none_is_refused(gpu: GpuContext, tmp_path: Path) -> None:
    stage = Stage(tmp_path)
    document = stage.document([sphere(stage, PAINT)], [ambient(0.4)])
    for content, sentence in (
        (b"ply\n", "paint.dlmat is not a precomputed material"),
        (None, "cannot be read"),
    ):
        path = tmp_path / "paint.dlmat"
        path.unlink()
        if content is not None:
            path.write_bytes(content)
        with pytest.raises(DeltalightError, match=sentence):
            SceneRenderer(gpu, document)
        path.touch()
