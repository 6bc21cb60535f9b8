"""Spots and rectangles: their irradiance against closed forms and integrals, their shadows, their flux."""

from pathlib import Path
from typing import Any

import moderngl
import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from scipy.optimize import curve_fit
from scipy.spatial.distance import cdist

from deltalight.protocol.scene import SceneDocument, parse_scene
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Bindings
from deltalight.render_server.gpu.textures import texture_2d
from deltalight.render_server.lights.light_models import RectangleLight, SpotLight
from deltalight.render_server.lights.lights import build_lights
from deltalight.render_server.passes.lights import LightBuffers
from deltalight.render_server.passes.shadow_maps import light_views, pack_view
from deltalight.render_server.renderer import SceneRenderer
from tests.render_server.scenes import (
    COARSE,
    Fields,
    Stage,
    Vector,
    array_of,
    cube,
    fields_of,
    floor,
    frame,
    look_at,
    plain,
    shifted,
    solve,
)
from tests.render_server.tiny_kernel import MakeKernel, floats

pytestmark = pytest.mark.usefixtures("clean_gl")
BURIED = (0.0, 0.0, -0.6)  # under the floor an object changes nothing that is seen
ABOVE = look_at((-0.4, 0.0, 0.5), (0.0, 0.0, 0.0))


@pytest.fixture
def stage(tmp_path: Path) -> Stage:
    return Stage(tmp_path, COARSE)


def spot(**changes: object) -> dict[str, Any]:
    plain_spot = {"position_m": (0.1, -0.1, 0.8), "direction": (0.0, 0.2, -1.0), "intensity": 2.0}
    return {"type": "spot", **plain_spot, "angle_deg": 40.0, "blend": 0.4, "radius_m": 0.0, **changes}


def panel(centre: Vector, axis_u: Vector, axis_v: Vector, radiance: float = 3.0) -> dict[str, Any]:
    axes = {"axis_u_m": axis_u, "axis_v_m": axis_v}
    return {"type": "rectangle", "position_m": centre, **axes, "radiance": radiance}


def bare(stage: Stage, light: dict[str, Any], real: trimesh.Trimesh | None = None) -> SceneDocument:
    """The light over a floor; the object lies where nothing sees it."""
    buried = [stage.virtual(cube(0.05, BURIED))]
    return stage.document(buried, [light], floor() if real is None else real, volume_edge_m=4.0)


def seen(fields: Fields) -> NDArray[np.bool_]:
    """Pixels of real surfaces."""
    return np.asarray((fields.position[..., 3] > 0) & (fields.matte == 0))


def pieces_of(light: dict[str, Any]) -> NDArray[np.float64]:
    """Centres (6400, 3) of the pieces of a rectangle."""
    steps = (np.arange(80) + 0.5) / 80 - 0.5
    a, b = np.meshgrid(steps, steps)
    u, v = np.array(light["axis_u_m"]), np.array(light["axis_v_m"])
    return np.asarray(light["position_m"] + a.reshape(-1, 1) * u + b.reshape(-1, 1) * v)


def integral(light: dict[str, Any], p: NDArray[np.float64], n: NDArray[np.float64]) -> NDArray[np.float64]:
    """Irradiance (k,) at points (k, 3) with normals (k, 3), summed over the rectangle's pieces."""
    across = np.cross(light["axis_u_m"], light["axis_v_m"])
    pieces = pieces_of(light)
    total = np.zeros(len(p))
    for some in np.array_split(pieces, 100):  # those of all would not stay in the cache
        facing = np.maximum(n @ some.T - (n * p).sum(axis=1)[:, None], 0)
        leaving = np.maximum((p @ across)[:, None] - some @ across, 0)
        total += (facing * leaving / cdist(p, some, "sqeuclidean") ** 2).sum(axis=1)
    return np.asarray(light["radiance"] * total / len(pieces))


@pytest.mark.parametrize("blend", [0.0, 0.4, 1.0])
def test_irradiance_of_a_spot(gpu: GpuContext, stage: Stage, blend: float) -> None:
    light = spot(blend=blend)
    found = solve(gpu, bare(stage, light), frame(plain(0)))
    p = found.position[..., :3][seen(found)]
    d = p - light["position_m"]
    distance = np.linalg.norm(d, axis=1)
    axis = np.array(light["direction"]) / np.linalg.norm(light["direction"])
    angle = np.degrees(np.arccos(np.clip(d @ axis / distance, -1, 1)))
    share = np.clip((20 - angle) / max(20 * blend, 1e-9), 0, 1)
    expected = 2.0 * share * -d[:, 2] / distance**3
    irradiance = found.direct_mu[..., 0][seen(found)]
    kept = np.abs(angle - 20) > (0.05 if blend == 0 else 0)
    parts = (angle < 20 * (1 - blend), (angle > 20 * (1 - blend)) & (angle < 20), angle > 20)
    assert [np.count_nonzero(part) > 500 for part in parts] == [blend < 1, blend > 0, True]
    assert irradiance[kept] == pytest.approx(expected[kept], rel=0.01, abs=0.003)
    assert irradiance[angle > 20.1].max() == 0


def solve_unshadowed(gpu: GpuContext, document: SceneDocument) -> tuple[Fields, NDArray[np.float64]]:
    """Fields, and the irradiance of the lights as if nothing were in their way."""
    renderer = SceneRenderer(gpu, document)
    renderer.render(frame(plain(0)))
    assert renderer.graph is not None
    found, unshadowed = fields_of(renderer), array_of(renderer.graph["direct light"].light.mu)[..., 3]
    renderer.release()
    return found, unshadowed


PANELS = {
    "overhead": panel((0.1, 0.0, 0.6), (0.5, 0.0, 0.0), (0.0, -0.3, 0.0)),
    "tilted": panel((0.3, 0.2, 0.5), (0.3, 0.1, 0.2), (0.1, -0.4, 0.1)),
    "slanted parallelogram, large": panel((0.0, 0.0, 0.4), (1.5, 0.3, 0.0), (0.8, -1.2, 0.1)),
    "half below the horizon": panel((0.5, 0.1, 0.05), (0.0, 0.6, 0.0), (0.0, 0.0, -0.5)),
    "small": panel((0.0, 0.1, 0.9), (0.02, 0.0, 0.0), (0.0, -0.02, 0.0), 900.0),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", PANELS)
def test_irradiance_of_a_rectangle(gpu: GpuContext, stage: Stage, name: str) -> None:
    """Floor and a wall, so that both see the light under all angles, some of it below their horizon."""
    wall = shifted(trimesh.creation.box((1.0, 0.02, 0.4)), 0, 0.31, 0.2)
    light = PANELS[name]
    for real in (floor(), wall):
        found, unshadowed = solve_unshadowed(gpu, bare(stage, light, real))
        pixels = np.flatnonzero(seen(found))[::23]
        p = found.position[..., :3].reshape(-1, 3)[pixels]
        # Next to the light its pieces are too coarse for the sum.
        apart = cdist(p, pieces_of(light)).min(axis=1) > 0.06
        p, pixels = p[apart], pixels[apart]
        expected = integral(light, p, found.normal.reshape(-1, 3)[pixels])
        assert np.count_nonzero(expected > 0.01 * expected.max()) > 100
        assert unshadowed.ravel()[pixels] == pytest.approx(expected, rel=0.01, abs=0.002 * expected.max())


def test_nothing_behind_a_rectangle(gpu: GpuContext, stage: Stage) -> None:
    light = panel((0.0, 0.0, 0.5), (0.4, 0.0, 0.0), (0.0, 0.4, 0.0))
    found = solve(gpu, bare(stage, light), frame(plain(0)))
    assert found.direct_mu.max() == 0
    assert found.direct_rho.max() == 0


def test_a_wall_behind_the_rectangle_hides_nothing(gpu: GpuContext, stage: Stage) -> None:
    """Nor does the lamp's own housing, which lies in its plane."""
    light = panel((0.3, 0.0, 0.3), (0.0, 0.3, 0.0), (0.0, 0.0, 0.3))
    light["axis_u_m"], light["axis_v_m"] = light["axis_v_m"], light["axis_u_m"]  # towards -x
    housing = shifted(trimesh.creation.box((0.02, 1.0, 0.6)), 0.31, 0, 0.3)
    open_floor = solve(gpu, bare(stage, light), frame(plain(0)))
    housed = solve(gpu, bare(stage, light, floor() + housing), frame(plain(0)))
    on_floor = seen(housed) & (housed.position[..., 2] < 1e-3) & (housed.position[..., 0] < 0.28)
    assert np.count_nonzero(on_floor) > 3000
    assert open_floor.direct_mu[on_floor].max() > 0.3
    assert housed.direct_mu[on_floor] == pytest.approx(open_floor.direct_mu[on_floor], rel=0.02, abs=0.003)


def visible_below_an_edge(
    gpu: GpuContext, stage: Stage, light: dict[str, Any], slab: trimesh.Trimesh
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(x, share of the light that is seen) on the floor below the edge x = 0 of a slab."""
    settings = {"volume_edge_m": 2.0, "rsm_size": 512, "shadow_samples": 64}
    document = stage.document([stage.virtual(slab)], [light], floor(), **settings)
    found = solve(gpu, document, frame(plain(0), pose=ABOVE))
    strip = seen(found) & (np.abs(found.position[..., 1]) < 0.1) & (np.abs(found.position[..., 0]) < 0.2)
    x = found.position[..., 0][strip]
    return x, found.direct_rho[..., 0][strip] / found.direct_mu[..., 0][strip]


@pytest.mark.parametrize(
    ("axis_u", "axis_v"),
    [
        ((0.3, 0.0, 0.0), (0.0, -0.1, 0.0)),
        ((0.1, 0.0, 0.0), (0.0, -0.4, 0.0)),
        ((0.3, 0.0, 0.1), (0.0, -0.1, 0.0)),
    ],
    ids=["wide", "long", "tilted"],
)
def test_width_of_a_rectangles_penumbra(
    gpu: GpuContext, stage: Stage, axis_u: Vector, axis_v: Vector
) -> None:
    """Below a straight edge at a sixth of the light's height the penumbra is a fifth of the light wide."""
    slab = shifted(trimesh.creation.box((0.5, 1.0, 0.002)), 0.25, 0, 0.2)
    x, visible = visible_below_an_edge(gpu, stage, panel((0.0, 0.0, 1.2), axis_u, axis_v), slab)

    def profile(x: NDArray[np.float64], half_width: float, middle: float) -> NDArray[np.float64]:
        return np.clip(0.5 + 0.5 * (middle - x) / half_width, 0, 1)

    (half_width, middle), _ = curve_fit(profile, x, visible, p0=(0.02, 0.0))
    share = half_width / (0.1 * axis_u[0])
    print(f"penumbra of {axis_u}: {share:.3f} of its width, {middle * 1e3:.1f} mm off")
    assert share == pytest.approx(1.0, rel=0.1)
    assert abs(middle) < 0.002


def test_width_of_a_spots_penumbra(gpu: GpuContext, stage: Stage) -> None:
    """As of a sphere of the same radius."""
    slab = shifted(trimesh.creation.box((0.5, 1.0, 0.002)), 0.25, 0, 0.2)
    place = {"position_m": (0.0, 0.0, 1.2), "radius_m": 0.1}
    _, of_spot = visible_below_an_edge(
        gpu, stage, spot(**place, direction=(0, 0, -1), angle_deg=40.0, blend=0.0), slab
    )
    _, of_sphere = visible_below_an_edge(gpu, stage, {"type": "sphere", **place, "intensity": 2.0}, slab)
    penumbra = (of_sphere > 0.05) & (of_sphere < 0.95)
    assert np.count_nonzero(penumbra) > 100
    assert np.abs(of_spot - of_sphere)[penumbra].mean() < 0.04
    assert of_spot.mean() == pytest.approx(of_sphere.mean(), rel=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("light", [spot(radius_m=0.03), PANELS["tilted"]], ids=["spot", "rectangle"])
@pytest.mark.parametrize("operator", ["exact", "paper"])
def test_fields_are_linear_in_the_light(
    gpu: GpuContext, stage: Stage, light: dict[str, Any], operator: str
) -> None:
    strength = "intensity" if light["type"] == "spot" else "radiance"
    fields = []
    for factor in (1.0, 2.0):
        lights = [{**light, strength: factor * light[strength]}]
        document = stage.document([stage.virtual(cube())], lights, floor(), operator=operator)
        fields.append(solve(gpu, document, frame(plain(0))))
    once, twice = fields
    assert (once.direct_mu - once.direct_rho).max() > 0.1
    for name in ("direct_mu", "direct_rho", "virtual_radiance"):
        a, b = 2 * getattr(once, name), getattr(twice, name)
        assert b == pytest.approx(a, rel=0.01, abs=0.005 * max(1.0, a.max()))


def test_an_object_outside_the_cone_casts_no_shadow(gpu: GpuContext, stage: Stage) -> None:
    changes = []
    for x in (0.0, 0.45):
        objects = [stage.virtual(cube(0.1, (x, 0.0, 0.0)))]
        light = spot(position_m=(0.0, 0.0, 0.8), direction=(0, 0, -1), angle_deg=40.0, radius_m=0.02)
        found = solve(gpu, stage.document(objects, [light], floor(), volume_edge_m=4.0), frame(plain(0)))
        changes.append((found.direct_mu - found.direct_rho)[seen(found)].max())
    assert changes[0] > 0.5
    assert changes[1] == 0


def test_a_large_real_triangle_in_a_narrow_cone_blocks(gpu: GpuContext, stage: Stage) -> None:
    """None of the screen's corners lies in the cone."""
    screen = shifted(trimesh.creation.box((1.0, 1.0, 0.002)), 0, 0, 0.4)
    light = spot(position_m=(0.0, 0.0, 0.8), direction=(0, 0, -1), angle_deg=20.0)
    under = frame(plain(0), pose=look_at((0.6, -0.2, 0.2), (0.0, 0.0, 0.0)))
    found = solve(gpu, bare(stage, light, floor() + screen), under)
    on_floor = seen(found) & (np.abs(found.position[..., 2]) < 1e-3)
    lit = np.linalg.norm(found.position[..., :2], axis=-1) < 0.1
    assert np.count_nonzero(on_floor & lit) > 300
    assert found.direct_mu[on_floor].max() == 0


def test_receivers_that_are_the_occluders_count_once() -> None:
    """They have the view that receivers have whose occluders are others at the same places."""
    points = np.random.default_rng(1).uniform(-1, 1, (50, 3)) * 0.3 - (0, 0, 3)
    zero, one = np.zeros(3, np.float32), np.ones(3, np.float32)
    light = SpotLight(zero, np.array((0, 0, -1), np.float32), one, 0.0, np.radians(80), 0.2)
    (view,), (other,) = light_views(light, points, points), light_views(light, points, points.copy())
    assert pack_view(view, 0, 1, 64) == pack_view(other, 0, 1, 64)


def test_views_fit_the_cone_and_the_rectangles_side() -> None:
    points = np.random.default_rng(0).uniform(-1, 1, (500, 3))
    zero, one = np.zeros(3, np.float32), np.ones(3, np.float32)
    down = np.array((0, 0, -1), np.float32)
    narrow = SpotLight(zero, down, one, 0.0, np.radians(20), 0.2)
    (view,) = light_views(narrow, points, points)
    assert view.half_extent == pytest.approx(np.tan(np.radians(20)), rel=0.02)
    assert view.view_from_world[2, :3] == pytest.approx(down)
    assert light_views(narrow, points + np.array((0, 0, 2)), points) == []
    far_points = points * 0.1 - (0, 0, 3)
    (tight,) = light_views(narrow, far_points, far_points)
    assert tight.half_extent < 0.1
    wide = SpotLight(zero, down, one, 0.0, np.radians(80), 0.2)
    assert len(light_views(wide, points, points)) == 6
    axes = np.eye(3, dtype=np.float32)
    upward = RectangleLight(zero, axes[0], axes[1], one)
    assert upward.normal == pytest.approx([0, 0, 1])
    views = light_views(upward, points, points)
    assert len(views) == 5
    assert all(view.front is not None and view.front[2] == 1 for view in views)
    assert light_views(upward, far_points, far_points) == []


def test_rows_of_lights_come_and_go_and_are_never_a_power_of_two(gpu: GpuContext) -> None:
    """Else llvmpipe would compile all kernels that read lights anew with a lamp more. Rows beyond them are 0."""
    points = np.random.default_rng(0).uniform(-1, 1, (50, 3))
    place, down = np.array((0, 0, 3), np.float32), np.array((0, 0, -1), np.float32)
    lamp = SpotLight(place, down, np.ones(3, np.float32), 0.0, 1.0, 0.2)
    buffers = LightBuffers(gpu, 8, 1)
    for count in (0, 1, 2, 3, 4, 9, 8, 1, 0):
        buffers.place([lamp] * count, points, points, points)
        for name, records in (("light_rows", count), ("light_view_rows", 2 * count)):
            texture: Any = buffers.bindings[name]
            assert texture.height & (texture.height - 1), (name, count)
            rows = np.frombuffer(texture.read(), np.uint32).reshape(texture.height, -1)
            assert rows.any(axis=1).tolist() == [True] * records + [False] * (len(rows) - records)
    buffers.release()


NO_SWITCH: Bindings = dict.fromkeys(("has_rectangles", "has_mirror_images", "has_object_lamps"), False)
COMPARED = """
#include "common/soft_shadows.glsl"
uniform float tile, edge;
"""
NEXT_TO_CENTRES = """
LightView view = LightView(mat4(1.0), vec4(tile, 0.0, edge, 1.0), vec4(0.0, 2.0, 1.0, 0.0), vec4(0.0));
for (int x = 0; x < int(edge); ++x) {
    float s = 2.0 * (float(x) + 0.5) / edge - 1.0;
    float error = 0.0;
    for (float side = -1.0; side <= 1.0; ++side) {
        float lit = lit_fraction(real_rsm_depth, view, vec2(s + side * 1e-5, 0.0), 1.0);
        error = max(error, abs(lit - texelFetch(real_rsm_depth, ivec2(int(tile) + x, 0), 0).r));
    }
    values[0] = max(values[0], error);
}
"""


@pytest.mark.parametrize("edge", [64, 260])
def test_shadow_maps_compare_the_texels_whose_weights_they_use(
    gpu: GpuContext, make: MakeKernel, out: moderngl.Buffer, edge: int
) -> None:
    """Next to a texel's centre that texel counts, in whatever tile; at 1300 texels, rounding found its neighbour."""
    stripes = np.tile(np.arange(5 * edge, dtype=np.float32) % 2, (edge, 1))
    depth = texture_2d(gpu, (5 * edge, edge), 1, "f4", data=stripes.tobytes())
    kernel = make(COMPARED, NEXT_TO_CENTRES)
    for tile in range(5):
        out.write(bytes(4))
        own: Bindings = {"real_rsm_depth": depth, "tile": float(tile * edge), "edge": float(edge)}
        kernel.run((1,), NO_SWITCH, own, Out=out)
        assert floats(out, 1)[0] < 0.02, tile
    depth.release()


def test_documents_lights_keep_their_numbers() -> None:
    document = parse_scene(
        {
            "lights": {
                "manual": [
                    spot(color_linear=(1, 0.5, 0)),
                    panel((0, 0, 1), (0.4, 0, 0), (0, -0.2, 0), 5.0),
                ],
                "registration": [2, 1, 1],
            }
        }
    )
    lamp, area = build_lights(document.lights).registered().lights
    assert isinstance(lamp, SpotLight)
    assert isinstance(area, RectangleLight)
    assert lamp.intensity.tolist() == [4, 1, 0]
    assert np.linalg.norm(lamp.direction) == pytest.approx(1)
    assert np.degrees(lamp.full_angle_rad) == pytest.approx(12)
    assert lamp.describe()["angle_deg"] == pytest.approx(40)
    assert area.radiance.tolist() == [10, 5, 5]
    assert area.normal.tolist() == [0, 0, -1]
    assert area.describe()["axis_v_m"] == pytest.approx([0, -0.2, 0])
