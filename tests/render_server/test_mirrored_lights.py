"""Smooth real planes throw lights back: as much as they reflect, onto what is free to receive it."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from deltalight.protocol.scene import SceneDocument
from deltalight.protocol.scene_objects import Surface
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.lights.light_models import DirectionalLight, RectangleLight, SphereLight
from deltalight.render_server.lights.mirror_lights import MIRROR_ROUGHNESS, mirror_lights
from deltalight.render_server.renderer import SceneRenderer
from deltalight.render_server.scene.declared_surfaces import SurfaceTable, build_surface_table
from tests.render_server.scenes import (
    COARSE,
    Fields,
    Stage,
    ball,
    cube,
    directional,
    fields_of,
    floor,
    frame,
    shifted,
    sphere_light,
)

pytestmark = pytest.mark.usefixtures("clean_gl")
SILVER, IRRADIANCE = 0.9, 2.0
SLANT = (0.0, float(np.sqrt(0.5)), -float(np.sqrt(0.5)))
PLANE = {"plane": {"point_m": [0, 0, 0], "normal": [0, 0, 1], "tolerance_m": 0.003}}
OVER = np.array([0.0, 0.0, 0.1])


@pytest.fixture
def stage(tmp_path: Path) -> Stage:
    return Stage(tmp_path, COARSE)


def mirror(roughness: float = 0.02, **more: Any) -> Surface:  # noqa: ANN401
    surface = {"region": PLANE, "metallic": 1.0, "albedo": [SILVER] * 3, "roughness": roughness, **more}
    return Surface.model_validate(surface)


def table(*surfaces: Surface) -> SurfaceTable:
    return build_surface_table(surfaces)


def declared(document: SceneDocument, *surfaces: Surface) -> SceneDocument:
    return document.replaced(real=document.real.model_copy(update={"surfaces": surfaces}))


def room() -> trimesh.Trimesh:
    """A floor and a wall at y = 0.2 that faces the camera."""
    return trimesh.util.concatenate([floor(), shifted(trimesh.creation.box((2, 0.02, 0.6)), 0, 0.21, 0.3)])


def fields(gpu: GpuContext, document: SceneDocument) -> Fields:
    renderer = SceneRenderer(gpu, document)
    renderer.render(frame())
    found = fields_of(renderer)
    renderer.release()
    return found


def gained(
    gpu: GpuContext, document: SceneDocument, *surfaces: Surface
) -> tuple[np.ndarray, np.ndarray, Fields]:
    """Mean direct irradiance that the mirror adds to real pixels without and with objects, and the fields with it."""
    on = fields(gpu, declared(document, *surfaces))
    plain = document.method.replaced(mirrored_lights=False)
    off = fields(gpu, declared(document.replaced(method=plain), *surfaces))
    return (on.direct_mu - off.direct_mu).mean(axis=2), (on.direct_rho - off.direct_rho).mean(axis=2), on


def on_wall(found: Fields, low_m: float = 0.03, high_m: float = 0.2) -> np.ndarray:
    place = found.position
    inside = (np.abs(place[..., 1] - 0.2) < 1e-3) & (place[..., 2] > low_m) & (place[..., 2] < high_m)
    return np.asarray(inside & (np.abs(place[..., 0]) < 0.15) & (found.matte == 0))


def test_image_lies_behind_the_plane_and_is_as_wide_as_the_lobe() -> None:
    lamp = SphereLight(np.array([0.1, 0.2, 1.0], np.float32), np.ones(3, np.float32), 0.05)
    sun = DirectionalLight(np.array(SLANT, np.float32), np.ones(3, np.float32), 0.0)
    images = mirror_lights([lamp, sun], table(mirror(0.2)), OVER)
    assert [image.source for image in images] == [0, 1]
    moved, turned = images[0].light, images[1].light
    assert isinstance(moved, SphereLight)
    assert isinstance(turned, DirectionalLight)
    np.testing.assert_allclose(moved.position, (0.1, 0.2, -1.0), atol=1e-6)
    np.testing.assert_allclose(turned.direction, (0.0, SLANT[1], -SLANT[2]), atol=1e-6)
    distance = (
        np.linalg.norm(OVER - moved.position) / 1.1
    )  # from the lamp to the plane, on the way to the objects
    np.testing.assert_allclose(moved.radius_m, np.hypot(0.05, 2 * 0.2**2 * distance), rtol=1e-3)
    np.testing.assert_allclose(np.tan(turned.angular_radius_rad), 2 * 0.2**2, rtol=1e-3)


def test_image_of_a_panel_faces_the_objects_with_the_same_flux() -> None:
    panel = RectangleLight(
        np.array([0, 0, 1], np.float32),
        np.array([0.4, 0, 0], np.float32),
        np.array([0, -0.2, 0], np.float32),
        np.full(3, 5, np.float32),
    )
    np.testing.assert_allclose(panel.normal, (0, 0, -1), atol=1e-6)
    image = mirror_lights([panel], table(mirror(0.25)), OVER)[0].light
    assert isinstance(image, RectangleLight)
    np.testing.assert_allclose(image.normal, (0, 0, 1), atol=1e-6)
    before, after = (
        np.linalg.norm(np.cross(one.axis_u, one.axis_v)) * one.radiance[0] for one in (panel, image)
    )
    np.testing.assert_allclose(after, before, rtol=1e-5)


def test_no_image_of_what_is_rough_not_a_plane_or_turned_away() -> None:
    lamp = SphereLight(np.array([0, 0, 1], np.float32), np.ones(3, np.float32), 0.05)
    box = {"box": {"min_m": [-1, -1, -0.01], "max_m": [1, 1, 0.01]}}
    for surface in (mirror(MIRROR_ROUGHNESS), mirror(region=box), mirror(metallic=0.0, specular=0.0)):
        assert not mirror_lights([lamp], table(surface), OVER)
    below = SphereLight(np.array([0, 0, -1], np.float32), np.ones(3, np.float32), 0.05)
    assert not mirror_lights([below], table(mirror()), OVER)


def test_mirror_throws_as_much_as_it_reflects(gpu: GpuContext, stage: Stage) -> None:
    """Light at 45 degrees meets the wall directly and by the floor: F E cos more, within 3 %."""
    objects = [stage.virtual(ball(0.06, (0.25, 0.0, 0.06)))]
    document = stage.document(objects, [directional(SLANT, IRRADIANCE)], room())
    mu, rho, found = gained(gpu, document, mirror())
    wall = on_wall(found)
    assert wall.sum() > 100
    np.testing.assert_allclose(np.median(mu[wall]), SILVER * IRRADIANCE * SLANT[1], rtol=0.03)
    np.testing.assert_array_equal(mu[wall], rho[wall])
    ground = (found.normal[..., 2] > 0.9) & (found.matte == 0)
    assert not mu[ground].any()


def test_what_stands_before_or_behind_the_mirror_casts_a_shadow(gpu: GpuContext, stage: Stage) -> None:
    """An object on the way down to the floor, or up from it, takes the light."""
    block = stage.virtual(cube(0.1, (0.0, -0.05, 0.0)))
    document = stage.document([block], [directional(SLANT, IRRADIANCE)], room())
    mu, rho, found = gained(gpu, document, mirror())
    # Rays that reach the wall at height z were mirrored at y = 0.2 - z: under the block and beside it.
    across = np.abs(found.position[..., 0])
    hidden = on_wall(found, 0.15, 0.28) & (across < 0.03)
    free = on_wall(found) & (across > 0.09)
    assert hidden.sum() > 10
    assert rho[hidden].mean() < 0.1 * mu[hidden].mean()
    np.testing.assert_allclose(rho[free], mu[free], atol=0.02)


@pytest.mark.slow
def test_plane_mirrors_only_where_it_is(gpu: GpuContext, stage: Stage) -> None:
    """A board laid on it and a surface declared before it cover it."""
    objects = [stage.virtual(ball(0.06, (0.25, 0.0, 0.06)))]
    light = [directional(SLANT, IRRADIANCE)]
    bare, _, found = gained(gpu, stage.document(objects, light, room()), mirror())
    board = shifted(trimesh.creation.box((0.6, 1.0, 0.02)), 0, -0.3, 0.01)
    real = trimesh.util.concatenate([room(), board])
    covered, _, over = gained(gpu, stage.document(objects, light, real), mirror())
    wall = on_wall(found, 0.06, 0.2) & on_wall(over, 0.06, 0.2)
    assert covered[wall].mean() < 0.1 * bare[wall].mean()
    paper = {"box": {"min_m": [-1, -1, -0.01], "max_m": [1, 0.3, 0.003]}}
    first = Surface.model_validate({"region": paper, "roughness": 1.0, "specular": 0.0})
    papered, _, _ = gained(gpu, stage.document(objects, light, room()), first, mirror())
    assert papered[wall].mean() < 0.1 * bare[wall].mean()


def test_objects_are_lit_from_below_and_the_picture_repeats(gpu: GpuContext, stage: Stage) -> None:
    objects = [stage.virtual(ball(0.05, (0.0, 0.0, 0.12)))]
    document = declared(
        stage.document(objects, [sphere_light((0.3, -0.5, 0.5), 0.5, 0.03)], floor()), mirror(0.1)
    )
    renderer = SceneRenderer(gpu, document)
    first = renderer.render(frame()).color
    on = fields_of(renderer)
    moved = document.objects[0].replaced(pose={"translation_m": [0.03, 0.0, 0.02]})
    renderer.set_scene(document.replaced(objects=(moved,)))
    renderer.render(frame())
    renderer.set_scene(document)
    np.testing.assert_array_equal(renderer.render(frame()).color, first)
    renderer.release()
    off = fields(gpu, document.replaced(method=document.method.replaced(mirrored_lights=False)))
    more = (on.virtual_radiance - off.virtual_radiance)[..., :3].mean(axis=2)
    rows = np.flatnonzero((on.matte == 1).any(axis=1))
    lower = more[rows[len(rows) // 2] :][on.matte[rows[len(rows) // 2] :] == 1]
    assert lower.max() > 0.02
    assert lower.mean() > 3 * abs(more[: rows[len(rows) // 4]][on.matte[: rows[len(rows) // 4]] == 1].mean())
