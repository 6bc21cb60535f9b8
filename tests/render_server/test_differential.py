"""Two full solutions subtracted: what `dvct` must agree with (docs/method.md 6 and 7).

Removal is not expressible as a scene of its own: the fields are the difference of solutions rho and mu, so exchanging
them changes the sign and nothing else.
"""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import decode_lut
from deltalight.protocol.scene import SceneDocument, parse_scene
from deltalight.protocol.scene_method import DifferentialMethod, VoxelConeSettings
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.timers import QUERIES_IN_FLIGHT
from deltalight.render_server.renderer import SceneRenderer
from tests.render_server.scenes import (
    GREY,
    Fields,
    Stage,
    ambient,
    array_of,
    ball,
    checkered,
    composite,
    cube,
    everyday,
    fields_of,
    floor,
    frame,
    noisy,
    pass_times_ms,
    shifted,
    solve,
    sphere_light,
    with_neighbours,
)

pytestmark = pytest.mark.usefixtures("clean_gl")


@pytest.fixture
def stage(tmp_path: Path) -> Stage:
    return Stage(tmp_path, {"cone_count": 6})


def differential(document: SceneDocument) -> SceneDocument:
    """The document with this method and the same settings."""
    shared = {name: getattr(document.method, name) for name in VoxelConeSettings.model_fields}
    return document.replaced(method=DifferentialMethod(**shared))


def inside(fields: Fields) -> NDArray[np.bool_]:
    """Pixels of real surfaces where nothing of the delta has faded."""
    return np.asarray((fields.position[..., 3] > 0) & (fields.matte == 0) & (fields.fade == 1))


def share_off(ours: NDArray[np.float64], reference: NDArray[np.float64]) -> float:
    """Mean deviation over the reference's mean amount."""
    return float(np.abs(ours - reference).sum() / np.abs(reference).sum())


@pytest.mark.slow
@pytest.mark.parametrize("bounces", [0, 1, 2])
def test_indirect_fields_of_dvct_are_those_of_two_full_solutions(
    gpu: GpuContext, stage: Stage, bounces: int
) -> None:
    """Natural light alone: equal to the last bit but for the changes below 1/512 that dvct leaves out of bounces."""
    document = everyday(stage, bounces=bounces, caustics=False)
    document = document.replaced(lights=stage.document([], [ambient(0.3)]).lights)
    ours, reference = solve(gpu, document), solve(gpu, differential(document))
    seen = inside(ours)
    assert np.count_nonzero(seen) > 1500
    assert np.abs(reference.cones_rho - reference.cones_mu)[seen].max() > 0.2
    assert np.array_equal(ours.cones_mu[seen], reference.cones_mu[seen])
    assert np.abs(ours.cones_rho - reference.cones_rho)[seen].max() <= 2**-10
    assert np.abs(ours.on_object - reference.on_object).max() <= 2**-10


@pytest.mark.parametrize("bounces", [0, 1])
def test_fields_of_dvct_under_a_lamp_are_those_of_two_full_solutions(
    gpu: GpuContext, stage: Stage, bounces: int
) -> None:
    """A map of objects and one of the room, multiplied, against one joint map that shows objects coarser. (Beams of
    objects' reflections are no part of differential.)"""
    document = everyday(stage, bounces=bounces, rsm_size=1024, caustics=False)
    ours, reference = solve(gpu, document), solve(gpu, differential(document))
    seen, shown = inside(ours), ours.matte == 1
    assert np.array_equal(ours.direct_mu[seen], reference.direct_mu[seen])
    assert np.array_equal(ours.cones_mu[seen], reference.cones_mu[seen])
    changes = {
        kind: [
            getattr(one, f"{kind}_rho")[seen] - getattr(one, f"{kind}_mu")[seen] for one in (ours, reference)
        ]
        for kind in ("direct", "cones")
    }
    off = {kind: share_off(*change) for kind, change in changes.items()}
    off["object"] = share_off(ours.virtual_radiance[shown], reference.virtual_radiance[shown])
    print({name: f"{100 * value:.2f} %" for name, value in off.items()})
    assert changes["direct"][0].sum() == pytest.approx(changes["direct"][1].sum(), rel=0.03)
    assert off["direct"] < 0.1  # edges of shadows
    assert off["cones"] < 0.01
    assert off["object"] < 0.01


def specular_of(renderer: SceneRenderer) -> dict[str, NDArray[np.float64]]:
    assert renderer.graph is not None
    cones, direct = renderer.graph["cones"], renderer.graph["direct light"]
    textures = {"cone": cones.specular_rho, "lobe": direct.lobes.rho}
    without = {"cone": cones.specular_mu, "lobe": direct.lobes.mu}
    return {name: array_of(textures[name])[..., :3] - array_of(without[name])[..., :3] for name in textures}


def test_specular_fields_of_dvct_are_those_of_two_full_solutions(gpu: GpuContext, stage: Stage) -> None:
    document = everyday(stage, reflections="cones", rsm_size=1024, caustics=False)
    glossy = {"region": {"plane": {"point_m": (0, 0, 0), "normal": (0, 0, 1)}}, "roughness": 0.4}
    document = document.replaced(
        real=parse_scene({"real": {**document.real.model_dump(), "surfaces": [glossy]}}).real
    )
    found = []
    for one in (document, differential(document)):
        renderer = SceneRenderer(gpu, one)
        renderer.render(frame())
        seen = inside(fields_of(renderer))
        found.append({name: field[seen] for name, field in specular_of(renderer).items()})
        renderer.release()
    assert np.abs(found[1]["cone"]).max() > 0.05
    assert share_off(found[0]["cone"], found[1]["cone"]) < 0.02
    assert found[0]["lobe"].sum() == pytest.approx(found[1]["lobe"].sum(), rel=0.1)


def grey_world() -> float:
    """Ambient radiance under which albedo 0.5 shows the radiance of code GREY: measured and predicted agree."""
    return float(2 * decode_lut(None)[GREY, 0])


@pytest.mark.slow
@pytest.mark.parametrize("shape", ["cube", "ball"])
def test_an_inserted_object_lights_as_if_it_were_real(gpu: GpuContext, stage: Stage, shape: str) -> None:
    """E_rho of an inserted object is E_mu of a renderer to which the object is part of the given model, where both
    know the same radiance of every surface (bounces would change the room's). (The second one's own object is a speck
    inside it.)"""
    mesh = {"cube": cube(0.12), "ball": ball(0.07, (0.02, 0.03, 0.09))}[shape]
    speck = shifted(trimesh.creation.box((0.002,) * 3), *mesh.bounds.mean(axis=0))
    room = floor(1.0) + shifted(trimesh.creation.box((0.02, 1, 0.4)), -0.2, 0, 0.2)
    lights = [ambient(grey_world()), sphere_light((0.5, -0.4, 0.9), 2.0, 0.05)]
    settings = {"bounces": 0, "rsm_size": 1024, "radiance": "predicted"}
    inserted, given = (
        solve(gpu, differential(stage.document([stage.virtual(one)], lights, real, **settings)))
        for one, real in ((mesh, room), (speck, room + mesh))
    )
    same = inside(inserted) & (np.abs(inserted.position - given.position).max(axis=-1) < 1e-4)
    assert np.count_nonzero(same) > 2000
    assert np.abs(inserted.cones_rho - inserted.cones_mu)[same].max() > 0.2
    off = np.abs(inserted.cones_rho - given.cones_mu)[same]
    print(f"indirect: {np.mean(off == 0):.4f} of the pixels equal, greatest deviation {off.max():.5f}")
    assert share_off(inserted.cones_rho[same], given.cones_mu[same]) < 0.005
    ours, theirs = inserted.direct_rho[same], given.direct_mu[same]
    assert ours.mean() == pytest.approx(theirs.mean(), rel=0.01)
    assert np.mean(np.abs(ours - theirs).max(axis=-1) > 0.1 * theirs.max()) < 0.03


def test_mu_does_not_know_the_object(gpu: GpuContext, stage: Stage) -> None:
    """Two objects in the same bounds (so volume and maps lie alike) leave the same solution without object."""
    lights = [sphere_light((0.5, -0.4, 1.0), 2.0, 0.05), ambient(0.15)]
    room = floor() + shifted(cube(0.5), -0.5, 0, 0)
    corners = cube(0.03, (-0.045, -0.045, 0)) + cube(0.03, (0.045, 0.045, 0.09))
    a, b = (
        solve(gpu, differential(stage.document([stage.virtual(mesh)], lights, room)))
        for mesh in (cube(0.12), corners)
    )
    both = with_neighbours(inside(a) & inside(b))
    assert np.array_equal(a.cones_mu[both], b.cones_mu[both])
    assert np.array_equal(a.direct_mu[both], b.direct_mu[both])
    assert not np.array_equal(a.cones_rho[both], b.cones_rho[both])


def test_what_objects_do_not_change_is_the_cameras(gpu: GpuContext, stage: Stage) -> None:
    """Though both solutions are computed everywhere; and a still picture stays, at no cost."""
    document = differential(everyday(stage))
    renderer = SceneRenderer(gpu, document)
    first = renderer.render(frame(noisy()))
    times_ms = pass_times_ms(renderer)
    second = [renderer.render(frame(noisy())) for _ in range(QUERIES_IN_FLIGHT)][-1]
    ran = set(second.pass_times_ms)
    found = fields_of(renderer)
    renderer.release()
    fresh = composite(gpu, document, frame(noisy()))
    same = (found.matte == 0) & (found.fade == 0)
    for name in ("direct", "cones"):
        same &= (getattr(found, f"{name}_mu") == getattr(found, f"{name}_rho")).all(axis=-1)
    assert np.count_nonzero(same) > 1000
    assert np.array_equal(first.color[same], noisy()[same])
    assert not np.array_equal(first.color, noisy())
    assert np.array_equal(first.color, second.color)
    assert np.array_equal(first.color, fresh)
    assert ran == {"upload", "composite", "readback"}
    assert second.reused_pass_times_ms == {name: ms for name, ms in times_ms.items() if name not in ran}


@pytest.mark.slow
def test_it_takes_its_turn_while_running(gpu: GpuContext, stage: Stage) -> None:
    cones = everyday(stage)
    documents = [cones, differential(cones)]
    alone = [composite(gpu, document, frame(checkered())) for document in documents]
    renderer = SceneRenderer(gpu, cones)
    for document, expected in zip(documents * 2, alone * 2, strict=True):
        renderer.set_scene(document)
        assert np.array_equal(renderer.render(frame(checkered())).color, expected)
    renderer.release()


@pytest.mark.parametrize("key", ["operator", "shadow"])
def test_settings_without_meaning_are_refused(key: str) -> None:
    with pytest.raises(DeltalightError, match=rf"method.*{key}"):
        parse_scene({"method": {"name": "differential", key: "map"}})
