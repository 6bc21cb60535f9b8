"""Light that smooth objects throw on others: where optics says, as much as they reflect, nothing through walls."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from deltalight.protocol.scene import SceneDocument
from deltalight.protocol.scene_objects import Material
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Bindings
from deltalight.render_server.passes.caustics import GREATEST_ALPHA, Caustics
from deltalight.render_server.renderer import SceneRenderer
from tests.render_server.scenes import (
    COARSE,
    EYE,
    HEIGHT,
    WIDTH,
    Fields,
    Stage,
    ball,
    cube,
    directional,
    fields_of,
    floor,
    frame,
    sent_flux,
    shifted,
    sphere_light,
)

pytestmark = pytest.mark.usefixtures("clean_gl")
SILVER, IRRADIANCE = 0.9, 2.0
RADIUS, HEIGHT_M = 0.04, 0.2
DOWN = {"base_color": (SILVER,) * 3, "metallic": 1.0, "roughness": 0.02}


@pytest.fixture
def stage(tmp_path: Path) -> Stage:
    return Stage(tmp_path, {**COARSE, "cone_scale": 1})


def fields(gpu: GpuContext, document: SceneDocument) -> Fields:
    renderer = SceneRenderer(gpu, document)
    renderer.render(frame())
    found = fields_of(renderer)
    renderer.release()
    return found


def thrown(gpu: GpuContext, document: SceneDocument) -> tuple[np.ndarray, Fields]:
    """Irradiance that beams bring to real pixels (h, w, 3), zeros where none were traced; and the fields."""
    renderer = SceneRenderer(gpu, document)
    renderer.render(frame())
    found = fields_of(renderer)
    assert renderer.graph is not None
    caustics = renderer.graph["caustics"]
    light = np.zeros((HEIGHT, WIDTH, 3))
    if caustics is not None:
        # Sharp parts a pixel, smooth ones a texel of the reduced grid, which is the picture's here (cone_scale 1).
        buffer = caustics.bindings["CausticSums"]
        sums = np.frombuffer(buffer.read(), np.int32).reshape(2, HEIGHT, WIDTH, 2, 3)
        light = sums[:, :, :, 0].sum(axis=0) / 2.0**20
    renderer.release()
    return light, found


def plate() -> trimesh.Trimesh:
    """A mirror at x = 0.1 that sends what comes along +x down to the floor."""
    mesh = trimesh.creation.box((0.08, 0.08, 0.002))
    mesh.apply_transform(trimesh.transformations.rotation_matrix(np.radians(45), (0, 1, 0)))
    return shifted(mesh, 0.1, 0.0, 0.12)


def mirror_document(
    stage: Stage,
    real: trimesh.Trimesh | None = None,
    more: list[dict[str, Any]] | None = None,
    **material: Any,  # noqa: ANN401
) -> SceneDocument:
    objects = [stage.virtual(plate(), material={**DOWN, **material}), *(more or [])]
    light = directional((1.0, 0.0, 0.0), IRRADIANCE)
    return stage.document(objects, [light], floor() if real is None else real)


def patch(found: Fields, half_m: float = 0.02) -> np.ndarray:
    """Pixels of the floor below the middle of the plate."""
    place = found.position
    on_floor = (place[..., 3] > 0) & (np.abs(place[..., 2]) < 1e-3) & (found.matte == 0)
    return np.asarray(on_floor & (np.abs(place[..., 0] - 0.1) < half_m) & (np.abs(place[..., 1]) < half_m))


def test_beams_add_to_the_light_with_objects(gpu: GpuContext, stage: Stage) -> None:
    document = mirror_document(stage)
    light, on = thrown(gpu, document)
    off = fields(gpu, document.replaced(method=document.method.replaced(caustics=False)))
    np.testing.assert_allclose(on.direct_rho - off.direct_rho, light * on.fade[..., None], atol=4e-3)
    np.testing.assert_array_equal(on.direct_mu, off.direct_mu)


def test_flat_mirror_lights_a_patch_of_the_floor(gpu: GpuContext, stage: Stage) -> None:
    """What falls on the plate falls on the floor below it: F E within 5 %, and nothing aside."""
    light, found = thrown(gpu, mirror_document(stage))
    inside = patch(found)
    assert inside.sum() > 10
    np.testing.assert_allclose(light[inside].mean(), SILVER * IRRADIANCE, rtol=0.05)
    place = found.position
    aside = (place[..., 3] > 0) & (np.abs(place[..., 1]) > 0.08)
    assert not light[aside].any()


def test_light_beside_an_object_hardly_depends_on_the_reduced_grid(gpu: GpuContext, tmp_path: Path) -> None:
    """Below a ball on the floor, beams are narrower than what four pixels can hold."""
    light = []
    for scale in (1, 4):
        stage = Stage(tmp_path, {**COARSE, "cone_scale": scale})
        objects = [stage.virtual(ball(RADIUS, (0, 0, RADIUS), detail=5), material={**DOWN, "roughness": 0.2})]
        document = stage.document(objects, [directional((-0.3, 1.0, -1.0), IRRADIANCE)], floor())
        without = document.replaced(method=document.method.replaced(caustics=False))
        light.append(fields(gpu, document).direct_rho - fields(gpu, without).direct_rho)
    fine, coarse = light
    assert np.abs(coarse - fine).sum() < 0.03 * fine.sum()


def shown_area(found: Fields) -> np.ndarray:
    """Area of the surface that each pixel shows, up to a factor."""
    away = np.asarray(EYE) - found.position[..., :3]
    cosine = (away * found.normal[..., :3]).sum(axis=-1) / np.linalg.norm(away, axis=-1)
    return np.asarray(found.position[..., 3] ** 2 / np.maximum(cosine, 0.1))


def test_ball_throws_what_it_reflects_into_a_ring(gpu: GpuContext, stage: Stage) -> None:
    """Parallel light from above: what meets a mirroring ball r from its axis falls on the floor further out."""
    material = {**DOWN, "roughness": 0.05}
    objects = [stage.virtual(ball(RADIUS, (0, 0, HEIGHT_M), detail=5), material=material)]
    light, found = thrown(gpu, stage.document(objects, [directional((0.0, 0.0, -1.0), IRRADIANCE)], floor()))
    met = np.linspace(0.75, 1.0, 1000)[:-1]
    falls = RADIUS * met + (HEIGHT_M + RADIUS * np.sqrt(1 - met**2)) * np.tan(2 * np.arccos(met))
    inner, outer = 0.1, 0.22
    first, last = RADIUS * np.interp([outer, inner], falls[::-1], met[::-1])
    # So near to grazing, silver reflects 2 % more (Schlick).
    expected = 1.02 * SILVER * IRRADIANCE * (last**2 - first**2) / (outer**2 - inner**2)
    out = np.linalg.norm(found.position[..., :2], axis=-1)
    ring = (found.position[..., 3] > 0) & (found.matte == 0) & (out > inner) & (out < outer)
    assert (found.fade[ring] == 1).all()
    mean = np.average(light[ring].mean(axis=1), weights=shown_area(found)[ring])
    assert abs(mean / expected - 1) < 0.08


@pytest.mark.slow
@pytest.mark.parametrize("roughness", [0.1, 0.2, 0.35])
def test_rough_mirror_blurs_and_keeps_most_of_the_flux(
    gpu: GpuContext, stage: Stage, roughness: float
) -> None:
    sharp, found = thrown(gpu, mirror_document(stage))
    rough, _ = thrown(gpu, mirror_document(stage, roughness=roughness))
    area = shown_area(found)
    flux = [float((part.mean(axis=2) * area * (found.matte == 0)).sum()) for part in (sharp, rough)]
    assert 0.95 < flux[1] / flux[0] < 1.1
    assert rough[patch(found)].mean() < sharp[patch(found)].mean()


@pytest.mark.parametrize("tilt_deg", [10, 45, 70, 80])
def test_beams_of_white_metal_carry_all_light_that_meets_it(
    gpu: GpuContext, stage: Stage, tilt_deg: float
) -> None:
    """Polished or rough, and from every side: within 3 %."""
    edge, thickness, tilt = 0.08, 0.002, np.radians(tilt_deg)
    mesh = trimesh.creation.box((edge, edge, thickness))
    mesh.apply_transform(trimesh.transformations.rotation_matrix(tilt, (0, 1, 0)))
    item = stage.virtual(shifted(mesh, 0, 0, 0.12), (1.0, 1.0, 1.0), {"metallic": 1.0})
    document = stage.document([item], [directional((0.0, 0.0, -1.0), IRRADIANCE)], floor())
    met = IRRADIANCE * edge * (edge * np.cos(tilt) + thickness * np.sin(tilt))
    renderer, (plate_,) = SceneRenderer(gpu, document), document.objects
    assert isinstance(plate_.material, Material)
    shares = []
    for roughness in (0.02, 0.17, 0.18, 0.35, 0.41):  # of mirrors, and from 0.177 on of sampled lobes
        material = plate_.material.replaced(roughness=roughness)
        renderer.set_scene(document.replaced(objects=(plate_.replaced(material=material),)))
        renderer.render(frame())
        shares.append(sent_flux(renderer) / met)
    renderer.release()
    print(f"{tilt_deg} degrees: {np.round(shares, 3)}")
    assert shares == pytest.approx(np.ones(len(shares)), abs=0.03)


@pytest.mark.slow
def test_real_and_virtual_things_stand_in_the_way(gpu: GpuContext, stage: Stage) -> None:
    """A board below the mirror has the light that the floor had; a wall takes the light that the mirror had."""
    free, found = thrown(gpu, mirror_document(stage))
    shelf = shifted(trimesh.creation.box((0.1, 0.1, 0.004)), 0.1, 0.0, 0.05)
    behind_real, with_shelf = thrown(gpu, mirror_document(stage, trimesh.util.concatenate([floor(), shelf])))
    on_shelf = (np.abs(with_shelf.position[..., 2] - 0.052) < 2e-3) & (with_shelf.matte == 0)
    assert behind_real[on_shelf].mean() > 0.2 * free[patch(found)].mean()
    virtual_shelf = [stage.virtual(shelf)]
    behind_object, _ = thrown(gpu, mirror_document(stage, more=virtual_shelf))
    assert behind_object[patch(found)].mean() < 0.1 * free[patch(found)].mean()
    wall = shifted(trimesh.creation.box((0.01, 0.3, 0.3)), -0.2, 0.0, 0.15)
    unlit, _ = thrown(gpu, mirror_document(stage, trimesh.util.concatenate([floor(), wall])))
    assert unlit[patch(found)].mean() < 0.1 * free[patch(found)].mean()


def test_objects_are_lit_by_each_other(gpu: GpuContext, stage: Stage) -> None:
    """A matt block in the mirror's light is brighter with beams."""
    block = [stage.virtual(cube(0.05, (0.1, 0.0, 0.0)))]
    document = mirror_document(stage, more=block)
    on = fields(gpu, document)
    off = fields(gpu, document.replaced(method=document.method.replaced(caustics=False)))
    gained = (on.virtual_radiance - off.virtual_radiance)[..., :3].mean(axis=2)
    assert gained.max() > 0.5 * 0.5 / np.pi * SILVER * IRRADIANCE


def test_tiles_leave_out_only_beams_that_light_nothing_there(
    gpu: GpuContext, stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Sums are the same to the bit if every tile takes every beam whose bounds it meets."""
    other = stage.virtual(shifted(cube(0.05), -0.08, 0.05, 0.03))
    shining = stage.virtual(shifted(ball(), 0.02, 0.0, 0.06), material={**DOWN, "roughness": 0.3})
    document = stage.document([shining, other], [directional()], floor())
    marked = sums_and_beams_of_tiles(gpu, document)

    def endless_balls(self: Caustics, shared: Bindings, scene: Bindings) -> None:
        balls = np.tile(np.array([0, 0, 0, 1e6], np.float32), self._balls.width * self._balls.height)
        find_tiles = self._find_tiles.run

        def with_endless_balls(threads: tuple[int, int], *scene: Bindings) -> None:
            self._balls.write(balls.tobytes())
            find_tiles(threads, *scene)

        monkeypatch.setattr(self._find_tiles, "run", with_endless_balls)
        add_beams(self, shared, scene)

    add_beams = Caustics._add_beams
    monkeypatch.setattr(Caustics, "_add_beams", endless_balls)
    everywhere = sums_and_beams_of_tiles(gpu, document)
    assert marked[0] == everywhere[0] != bytes(len(marked[0]))
    assert 0 < marked[1] < 0.8 * everywhere[1]


def sums_and_beams_of_tiles(gpu: GpuContext, document: SceneDocument) -> tuple[bytes, int]:
    """The light of beams, and how many beams all tiles together look at."""
    renderer = SceneRenderer(gpu, document)
    renderer.render(frame())
    assert renderer.graph is not None
    caustics = renderer.graph["caustics"]
    bits = np.unpackbits(np.frombuffer(caustics._tile_beams.read(), np.uint8))
    found = caustics.bindings["CausticSums"].read(), int(bits.sum())
    renderer.release()
    return found


def test_nothing_is_thrown_by_rough_or_interfaceless_objects(gpu: GpuContext, stage: Stage) -> None:
    rough = float(np.sqrt(GREATEST_ALPHA)) + 0.01
    materials: list[dict[str, Any]] = [{"roughness": rough}, {"metallic": 0.0, "specular": 0.0}]
    for material in materials:
        light, _ = thrown(gpu, mirror_document(stage, **material))
        assert not light.any()


def test_same_picture_twice_and_after_the_object_was_elsewhere(gpu: GpuContext, stage: Stage) -> None:
    document = mirror_document(stage, roughness=0.3)
    away = document.objects[0].replaced(pose={"translation_m": [0.03, 0.02, 0.01]})
    renderer = SceneRenderer(gpu, document)
    first = renderer.render(frame()).color
    renderer.set_scene(document.replaced(objects=(away,)))
    moved = renderer.render(frame()).color
    renderer.set_scene(document)
    again = renderer.render(frame()).color
    renderer.release()
    assert (moved != first).any()
    np.testing.assert_array_equal(again, first)


def test_linear_in_the_light_and_the_same_with_dlpv(gpu: GpuContext, stage: Stage) -> None:
    """Twice the light throws twice as much; beams do not depend on the method."""
    objects = [stage.virtual(ball(RADIUS, (0, 0, 0.1), detail=4), material={**DOWN, "roughness": 0.2})]
    once, found = thrown(gpu, stage.document(objects, [sphere_light((0.3, -0.3, 0.6), 0.3, 0.03)], floor()))
    twice, _ = thrown(gpu, stage.document(objects, [sphere_light((0.3, -0.3, 0.6), 0.6, 0.03)], floor()))
    assert once.max() > 1e-3
    np.testing.assert_allclose(twice, 2 * once, rtol=0.02, atol=2e-3)
    assert (found.direct_rho >= 0).all()
