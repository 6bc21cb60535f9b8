"""Irradiances before composition against closed forms (docs/method.md 3 and 7).

Full solutions are in test_differential.py.
"""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt
from scipy.optimize import curve_fit

from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.passes.shadow_maps import CASTER_CELL, ShadowMaps
from deltalight.render_server.passes.volumes import VolumePlacement
from deltalight.render_server.renderer import SceneRenderer
from tests.render_server.scenes import (
    Fields,
    Stage,
    ambient,
    array_of,
    ball,
    cube,
    directional,
    everyday,
    floor,
    frame,
    look_at,
    plain,
    shifted,
    solve,
    sphere_light,
    with_neighbours,
)

pytestmark = pytest.mark.usefixtures("clean_gl")
BURIED = (0.0, 0.0, -0.6)  # under the floor an object changes nothing that is seen


@pytest.fixture
def stage(tmp_path: Path) -> Stage:
    return Stage(tmp_path)


def seen(fields: Fields) -> NDArray[np.bool_]:
    """Pixels of real surfaces."""
    return np.asarray((fields.position[..., 3] > 0) & (fields.matte == 0))


def open_plane(half: float = 3.0) -> trimesh.Trimesh:
    corners = half * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    return trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)


@pytest.mark.parametrize("tilt", [0.0, 0.3, 0.9])
def test_environment_furnace(gpu: GpuContext, stage: Stage, tilt: float) -> None:
    """An open plane under a constant environment R: E = pi R, and an object behind it changes nothing."""
    plane = open_plane()
    plane.apply_transform(trimesh.transformations.rotation_matrix(tilt, (1, 0.3, 0)))
    document = stage.document([stage.virtual(cube(0.05, BURIED))], [ambient(0.25)], plane, volume_edge_m=1.4)
    found = solve(gpu, document, frame(plain(0)))
    irradiance = found.cones_mu[seen(found)]
    assert np.abs(irradiance / (np.pi * 0.25) - 1).max() < 0.01
    assert np.array_equal(found.cones_mu, found.cones_rho)


def test_irradiance_of_a_sphere_light(gpu: GpuContext, stage: Stage) -> None:
    lamp = np.array((0.1, -0.2, 0.8))
    lights = [sphere_light((0.1, -0.2, 0.8), 2.0, 0.03)]
    document = stage.document([stage.virtual(cube(0.05, BURIED))], lights, floor(), volume_edge_m=4.0)
    found = solve(gpu, document, frame(plain(0)))
    to_lamp = lamp - found.position[..., :3]
    expected = 2.0 * to_lamp[..., 2] / np.linalg.norm(to_lamp, axis=-1) ** 3
    assert found.direct_mu[..., 0][seen(found)] == pytest.approx(expected[seen(found)], rel=0.01)


@pytest.mark.parametrize("angular_radius_deg", [0.0, 3.0])
def test_irradiance_of_a_directional_light(gpu: GpuContext, stage: Stage, angular_radius_deg: float) -> None:
    lights = [directional((0.3, 0.2, -1.0), 1.7, angular_radius_deg)]
    document = stage.document([stage.virtual(cube(0.05, BURIED))], lights, floor(), volume_edge_m=4.0)
    found = solve(gpu, document, frame(plain(0)))
    assert found.direct_mu[..., 0][seen(found)] == pytest.approx(1.7 / np.sqrt(1.13), rel=0.01)


def lit_share_of_a_disc(offset: NDArray[np.float64]) -> NDArray[np.float64]:
    """Share of a unit disc on the positive side of a line at `offset` from its middle."""
    x = np.clip(offset, -1, 1)
    return np.asarray(0.5 + (x * np.sqrt(1 - x * x) + np.arcsin(x)) / np.pi)


@pytest.mark.parametrize("radius", [0.06, 0.1])
def test_width_of_a_penumbra(gpu: GpuContext, stage: Stage, radius: float) -> None:
    """Below a straight edge at a sixth of the lamp's height the penumbra is a fifth of the lamp wide."""
    slab = shifted(trimesh.creation.box((0.5, 1.0, 0.002)), 0.25, 0, 0.2)
    lights = [sphere_light((0.0, 0.0, 1.2), 2.0, radius)]
    settings = {"volume_edge_m": 2.0, "rsm_size": 512, "shadow_samples": 64}
    document = stage.document([stage.virtual(slab)], lights, floor(), **settings)
    found = solve(gpu, document, frame(plain(0), pose=look_at((-0.4, 0.0, 0.5), (0.0, 0.0, 0.0))))
    strip = seen(found) & (np.abs(found.position[..., 1]) < 0.1) & (np.abs(found.position[..., 0]) < 0.1)
    x = found.position[..., 0][strip]
    visible = found.direct_rho[..., 0][strip] / found.direct_mu[..., 0][strip]

    def profile(x: NDArray[np.float64], half_width: float, middle: float) -> NDArray[np.float64]:
        return lit_share_of_a_disc((middle - x) / half_width)

    (half_width, middle), _ = curve_fit(profile, x, visible, p0=(0.02, 0.0))
    share = half_width / (0.2 * radius)
    print(f"penumbra of a lamp of {radius} m: {share:.3f} of its width, {middle * 1e3:.1f} mm off")
    assert half_width == pytest.approx(0.2 * radius, rel=0.15)
    assert abs(middle) < 0.002


@pytest.mark.parametrize("direction", [(0.0, 0.0, -1.0), (0.6, 0.2, -1.0)])
def test_place_of_a_balls_shadow(
    gpu: GpuContext, stage: Stage, direction: tuple[float, float, float]
) -> None:
    centre, radius = np.array((0.0, 0.0, 0.25)), 0.06
    document = stage.document(
        [stage.virtual(ball(radius, (0.0, 0.0, 0.25), 4))],
        [directional(direction)],
        floor(),
        volume_edge_m=1.6,
    )
    found = solve(gpu, document, frame(plain(0), pose=look_at((-0.3, -0.6, 0.9), (0.1, 0.0, 0.0))))
    axis = np.array(direction) / np.linalg.norm(direction)
    across = np.cross(found.position[..., :3] - centre, axis)
    distance = np.linalg.norm(across, axis=-1)
    reached = seen(found) & (found.direct_mu[..., 0] > 0) & (np.abs(found.position[..., 2]) < 1e-3)
    visible = found.direct_rho[..., 0][reached] / found.direct_mu[..., 0][reached]
    distance = distance[reached]
    assert np.count_nonzero(distance < radius) > 100
    assert visible[distance < radius - 0.008].max() == 0
    assert visible[distance > radius + 0.008].min() == 1
    assert (1 - visible).sum() == pytest.approx(np.count_nonzero(distance < radius), rel=0.05)


def test_fields_are_linear_in_light_and_picture(gpu: GpuContext, stage: Stage) -> None:
    whole = everyday(stage)
    lights = stage.document([], [sphere_light((0.5, -0.4, 1.0), 1.0, 0.05), ambient(0.075)]).lights
    half = solve(gpu, whole.model_copy(update={"lights": lights}), frame(exposure_scale=2.0))
    full = solve(gpu, whole)
    for name in ("direct_mu", "direct_rho", "cones_mu", "cones_rho", "on_object", "virtual_radiance"):
        a, b = 2 * getattr(half, name), getattr(full, name)
        assert np.abs(a - b).max() < 2e-3 * b.max(), name


def test_mu_does_not_know_the_object(gpu: GpuContext, stage: Stage) -> None:
    """Two objects in the same bounds (so the volume lies alike) leave the same solution without object."""
    lights = [sphere_light((0.5, -0.4, 1.0), 2.0, 0.05), ambient(0.15)]
    room = floor() + shifted(cube(0.5), -0.5, 0, 0)
    corners = cube(0.03, (-0.045, -0.045, 0)) + cube(0.03, (0.045, 0.045, 0.09))
    a, b = (solve(gpu, stage.document([stage.virtual(mesh)], lights, room)) for mesh in (cube(0.12), corners))
    both = with_neighbours(seen(a) & seen(b))
    assert np.array_equal(a.cones_mu[both], b.cones_mu[both])
    assert np.array_equal(a.direct_mu[both], b.direct_mu[both])
    assert not np.array_equal(a.cones_rho[both], b.cones_rho[both])


def test_marching_mu_only_where_it_differs_changes_nothing(
    gpu: GpuContext, stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    document = everyday(stage)
    sparing = solve(gpu, document)
    whole = lambda placement, _: np.array([0, 0, 0, *[-placement.size] * 3], np.int32)  # noqa: E731
    monkeypatch.setattr(VolumePlacement, "voxel_bounds", whole)
    always = solve(gpu, document)
    assert np.array_equal(sparing.cones_mu, always.cones_mu)
    assert np.array_equal(sparing.cones_rho, always.cones_rho)


LAMPS = {
    "wide lamp": sphere_light((0.5, -0.4, 0.5), 2.0, 0.15),
    "sun": directional((-1.0, 0.3, -0.4), 2.0, 3.0),
    "panel": {
        "type": "rectangle",
        "position_m": (0.7, 0.1, 0.4),
        "axis_u_m": (0.0, 0.0, 0.05),
        "axis_v_m": (0.0, 0.05, 0.0),
        "radiance": 5.0,
    },
    "lamp among them": sphere_light((0.06, 0.02, 0.05), 0.05, 0.005),
}


@pytest.mark.parametrize("light", LAMPS.values(), ids=LAMPS)
def test_looking_for_shadows_only_near_casters_changes_nothing(
    gpu: GpuContext, stage: Stage, monkeypatch: pytest.MonkeyPatch, light: dict[str, object]
) -> None:
    objects = [stage.virtual(cube(0.08, (0.12, 0.08, 0))), stage.virtual(ball(0.05, (-0.05, -0.05, 0.09)))]
    document = stage.document(objects, [light, ambient(0.15)], floor(), volume_edge_m=0.3, cone_scale=4)
    sparing = solve(gpu, document)
    monkeypatch.setattr(ShadowMaps, "measure_distances", lambda *_: None)  # then casters may be anywhere
    always = solve(gpu, document)
    reached, all_reached = ((each.direct_mu > 0).any(axis=-1) for each in (sparing, always))
    assert not (reached & ~all_reached).any()
    assert np.array_equal(sparing.direct_mu[reached], always.direct_mu[reached])
    assert np.array_equal(sparing.direct_rho[reached], always.direct_rho[reached])
    left = all_reached & ~reached
    assert left.sum() > 100
    assert np.array_equal(always.direct_mu[left], always.direct_rho[left])
    assert np.abs(sparing.virtual_radiance - always.virtual_radiance).max() < 2e-3


def test_distances_to_casters(gpu: GpuContext, stage: Stage) -> None:
    """In tiles of 130 texels, whose last cells are cut; those of a lamp's other views tell nothing of them."""
    lamps = [sphere_light((0.1, -0.1, 0.3), 1.0), directional((-1.0, 0.3, -1.0))]
    objects = [stage.virtual(cube(0.08, (0.12, 0.08, 0))), stage.virtual(ball(0.02, (-0.2, -0.2, 0.1)))]
    renderer = SceneRenderer(gpu, stage.document(objects, lamps, floor(), rsm_size=130))
    renderer.render(frame())
    assert renderer.graph is not None
    atlas = renderer.graph["shadow maps objects"].object_atlas
    shows = np.frombuffer(atlas.depth.read(alignment=1), np.float32).reshape(atlas.size[::-1]) < 1
    squared, cells = array_of(atlas.caster_distance)[..., 0], atlas.tile_cells
    for tile in range(atlas.tiles):
        x, y, edge, _ = atlas.box(tile)
        texels = distance_transform_edt(~shows[y : y + edge, x : x + edge])
        column, row = x // edge * cells, y // edge * cells
        bound = CASTER_CELL * np.sqrt(squared[row : row + cells, column : column + cells])
        bound = np.kron(bound, np.ones((CASTER_CELL, CASTER_CELL)))[:edge, :edge]
        assert shows[y : y + edge, x : x + edge].any()
        assert (bound <= texels).all()
        assert (bound >= texels - 3 * CASTER_CELL).all()
    renderer.release()
