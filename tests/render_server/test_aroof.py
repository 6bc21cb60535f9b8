"""Object occlusion fields in pictures: closed forms, products by integration, and what holds for every picture."""

import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from jaxtyping import Float64

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import BoardPose
from deltalight.protocol.octahedral import octahedral_grid
from deltalight.protocol.scene import SceneDocument, parse_scene
from deltalight.protocol.scene_method import AroofMethod
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.lights.octahedral import even_directions, harmonics
from deltalight.render_server.passes.occlusion_fields import LightProbeCapture
from deltalight.render_server.precomputation.occlusion_fields import compute_field
from deltalight.render_server.renderer import SceneRenderer
from deltalight.render_server.scene.occlusion_field import OcclusionField
from tests.render_server.scenes import (
    Fields,
    Stage,
    ambient,
    array_of,
    ball,
    composite,
    cube,
    directional,
    everyday,
    fields_of,
    floor,
    frame,
    look_at,
    noisy,
    plain,
    solve,
)

pytestmark = pytest.mark.usefixtures("clean_gl")
RADIUS = 0.06
FINE = {"resolution": 16, "rays": 144}  # for closed forms
PATIENCE_S = 120.0  # computing a field takes a second or two on an idle machine
CLOSE = ((0.1, -0.34, 0.27), (0.0, 0.0, 0.05))


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("fields")


@pytest.fixture(autouse=True)
def _own_cache(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DELTALIGHT_CACHE", str(cache))


@pytest.fixture
def stage(tmp_path: Path) -> Stage:
    return Stage(tmp_path)


def aroof(document: SceneDocument, **settings: object) -> SceneDocument:
    """The document with this method, fields that are coarse unless told, read at every pixel."""
    method = {"resolution": 12, "rays": 64, "shading_scale": 1, "rsm_size": 256, **settings}
    return document.replaced(method=AroofMethod.model_validate({"name": "aroof", **method}))


def on_floor(fields: Fields) -> tuple[np.ndarray, Float64[np.ndarray, "h w"]]:
    """Where the floor is seen, and how far from the z axis."""
    place = fields.position
    shown = (place[..., 3] > 0) & (fields.matte == 0) & (np.abs(place[..., 2]) < 1e-3)
    return shown, np.hypot(place[..., 0], place[..., 1])


@pytest.mark.slow
@pytest.mark.parametrize("order", [3, 4, 5])
def test_a_ball_on_the_floor_takes_its_form_factor_of_even_light(
    gpu: GpuContext, stage: Stage, order: int
) -> None:
    """E is less by (R/d)^2 cos of a black ball, and unchanged by a white one: its form factor comes back."""
    for color, expected in ((0.0, 1.0), (1.0, 0.0)):
        document = stage.document([stage.virtual(ball(RADIUS), (color,) * 3)], [ambient(1.0)], floor())
        fields = solve(
            gpu, aroof(document, near_light="none", sh_order=order, **FINE), frame(pose=look_at(*CLOSE))
        )
        shown, away = on_floor(fields)
        shown &= (away > 0.3 * RADIUS) & (away < 6 * RADIUS)
        distance = np.hypot(away, RADIUS)[shown]
        factor = expected * (RADIUS / distance) ** 2 * (RADIUS / distance)
        lost = 1 - fields.cones_rho[shown][:, 0] / fields.cones_mu[shown][:, 0]
        assert np.abs(lost - factor).max() < 0.03
        assert np.abs(lost - factor).mean() < 0.006
        assert fields.cones_mu[shown] == pytest.approx(np.pi, rel=0.01)
        on_ball = fields.on_object[fields.matte > 0.99]
        assert on_ball == pytest.approx(np.pi, rel=0.03)


def test_a_lamp_on_a_white_ball_lights_the_floor_like_the_ball_that_it_sees(
    gpu: GpuContext, stage: Stage
) -> None:
    """Radiance E cos / pi of what a point of the floor sees of the ball, integrated."""
    toward = np.array([0.4, -0.5, 0.77])
    toward /= np.linalg.norm(toward)
    x, y, z = (float(v) for v in -toward)
    document = stage.document(
        [stage.virtual(ball(RADIUS), (1.0,) * 3)], [directional((x, y, z), 2.0)], floor()
    )
    fields = solve(gpu, aroof(document, near_light="none", **FINE), frame(pose=look_at(*CLOSE)))
    shown, away = on_floor(fields)
    rows, columns = np.nonzero(shown & (away > RADIUS) & (away < 3 * RADIUS))
    picked = slice(None, None, max(1, len(rows) // 60))
    points = fields.position[rows[picked], columns[picked], :3]
    got = fields.cones_rho[rows[picked], columns[picked], 0]
    expected = np.array([_reflected(point, toward) for point in points])
    assert len(points) > 40
    assert np.abs(got - expected).max() < 0.02
    assert got.sum() == pytest.approx(expected.sum(), rel=0.08)


def test_what_passes_through_an_object_is_not_reflected_too(gpu: GpuContext, stage: Stage) -> None:
    sent = []
    for transmission in (0.0, 0.75):
        material = {"base_color": (0.8, 0.6, 0.4), "transmission": transmission}
        item = stage.virtual(ball(RADIUS), material=material)
        document = stage.document([item], [directional((0.0, 0.0, -1.0), 2.0)], floor())
        renderer = SceneRenderer(gpu, aroof(document))
        renderer.render(frame())
        assert renderer.graph is not None
        (placed,) = renderer.graph["object bounce light"]
        sent.append(np.frombuffer(placed.bounce_light.read(), np.float16).reshape(-1, 4)[:, :3].astype(float))
        renderer.release()
    assert sent[0].max() > 0.01
    assert sent[1] == pytest.approx(0.25 * sent[0], abs=1e-3)


def _reflected(point: Float64[np.ndarray, "3"], toward: Float64[np.ndarray, "3"]) -> float:
    ways = even_directions(20000)
    ways = ways[ways[:, 2] > 0]
    start = point - (0, 0, RADIUS)
    along = ways @ start
    root = along**2 - (start @ start - RADIUS**2)
    met = (root > 0) & (along < 0)
    normals = (start + ways[met] * (-along[met] - np.sqrt(root[met]))[:, None]) / RADIUS
    radiance = 2.0 / np.pi * np.maximum(normals @ toward, 0)
    return float((radiance * ways[met, 2]).sum() * 4 * np.pi / 20000)


def test_products_are_integrals_of_light_cosine_and_harmonics(gpu: GpuContext, stage: Stage) -> None:
    """P_k(n) of uneven light against sums over all directions; the cosine's five bands leave out 2 % at most."""
    document = aroof(
        stage.document([stage.virtual(ball(RADIUS))], [ambient(0.0)], floor()), near_light="none"
    )
    renderer = SceneRenderer(gpu, document)
    renderer.render(frame())
    assert renderer.graph is not None
    (item,) = renderer.graph["occlusion fields"]
    grid = octahedral_grid(32)
    light = 1.0 + 0.8 * grid[..., 2] + 0.5 * grid[..., 0] * grid[..., 1]
    texels = np.repeat(light[..., None], 4, axis=2).astype(np.float16)
    item.probe.radiance.write(texels.tobytes())
    capture = LightProbeCapture(gpu, length=16)
    capture.multiply(item.probe)
    products = np.frombuffer(item.probe.products.read(), np.float16).reshape(17, 32, 32, 4)[..., 0]
    capture.release()
    renderer.release()
    ways = even_directions(40000)
    radiance = 1.0 + 0.8 * ways[:, 2] + 0.5 * ways[:, 0] * ways[:, 1]
    basis = harmonics(ways, 4) * 4 * np.pi / len(ways)
    for row, column in ((3, 7), (16, 16), (30, 2), (20, 9)):
        cosine = np.maximum(ways @ grid[row, column], 0)
        expected = (radiance * cosine) @ basis
        assert products[:16, row, column].astype(float) == pytest.approx(expected, abs=0.03)
        assert float(products[16, row, column]) == pytest.approx(
            (radiance * cosine).sum() * 4 * np.pi / len(ways), rel=0.02
        )


@pytest.mark.slow
def test_turning_everything_changes_nothing(gpu: GpuContext, stage: Stage) -> None:
    """Object, camera and lamp turned together about the vertical, and the object's file turned against its pose."""
    shape = cube(0.1)
    plain_document = stage.document(
        [stage.virtual(shape)], [directional((0, 0.4, -1.0)), ambient(0.3)], floor()
    )
    turn = trimesh.transformations.rotation_matrix(np.radians(37), (0, 0, 1))
    turned = shape.copy()
    turned.apply_transform(np.linalg.inv(turn))
    half = np.radians(37) / 2
    pose = {"rotation_wxyz": (float(np.cos(half)), 0.0, 0.0, float(np.sin(half)))}
    item = {**stage.virtual(turned), "pose": pose}
    other = parse_scene({**plain_document.model_dump(mode="json"), "objects": [item]})
    a, b = (solve(gpu, aroof(one, resolution=24, rays=144)) for one in (plain_document, other))
    shown, away = on_floor(a)
    shown &= away > 0.08
    assert np.abs(a.cones_rho - b.cones_rho)[shown].max() < 0.03 * a.cones_mu[shown].max()


def test_the_shadow_is_darkest_at_contact(gpu: GpuContext, stage: Stage) -> None:
    document = stage.document([stage.virtual(ball(RADIUS), (0.1,) * 3)], [ambient(1.0)], floor())
    fields = solve(gpu, aroof(document, near_light="none"), frame(pose=look_at(*CLOSE)))
    shown, away = on_floor(fields)
    share = (fields.cones_rho[..., 0] / np.maximum(fields.cones_mu[..., 0], 1e-9))[shown]
    steps = [
        share[np.abs(away[shown] / RADIUS - at) < 0.1].mean() for at in (0.6, 0.8, 1.0, 1.5, 2.0, 3.0, 4.0)
    ]
    assert (np.diff(steps) > 0).all()
    assert steps[0] < 0.55
    assert steps[-1] > 0.97


def test_pictures_are_the_same_each_time_and_the_camera_is_copied_without_objects(
    gpu: GpuContext, stage: Stage
) -> None:
    document = aroof(everyday(stage), shading_scale=4)
    view = frame(noisy())
    renderer = SceneRenderer(gpu, document)
    first = renderer.render(view)
    again = renderer.render(view)
    renderer.set_scene(document.replaced(objects=()))
    empty = renderer.render(view)
    renderer.release()
    assert (first.color == again.color).all()
    assert (composite(gpu, document, view) == first.color).all()
    assert (empty.color == view.color).all()
    assert (first.color != view.color).any()


def test_fields_are_never_negative_and_end_softly(gpu: GpuContext, stage: Stage) -> None:
    fields = solve(gpu, aroof(everyday(stage), reach=2.0))
    for field in (fields.cones_mu, fields.cones_rho, fields.on_object, fields.virtual_radiance):
        assert np.isfinite(field).all()
        assert field.min() >= 0
    shown, away = on_floor(fields)
    far = shown & (away > 0.6)
    assert far.any()
    assert (fields.cones_rho[far] == fields.cones_mu[far]).all()


def test_an_object_behind_a_wall_of_its_own_hides_nothing_from_below(gpu: GpuContext, stage: Stage) -> None:
    """Under the floor, whose surface looks up: nothing of it rises above any horizon there."""
    buried = stage.virtual(ball(RADIUS, (0.0, 0.0, -0.1)), (0.9,) * 3)
    fields = solve(gpu, aroof(stage.document([buried], [ambient(1.0)], floor()), near_light="none"))
    shown, _ = on_floor(fields)
    assert (fields.cones_rho[shown] == fields.cones_mu[shown]).all()


def test_objects_shade_each_other(gpu: GpuContext, stage: Stage) -> None:
    """A floor tile that is virtual itself loses what the ball above it hides."""
    tile = stage.virtual(trimesh.creation.box((0.5, 0.5, 0.01)), (0.5,) * 3, id="tile")
    hovering = stage.virtual(ball(RADIUS, (0.0, 0.0, 0.07)), (0.0,) * 3, id="ball")
    for objects, low in (([tile], 0.97), ([tile, hovering], None)):
        document = stage.document(objects, [ambient(1.0)], floor())
        fields = solve(gpu, aroof(document, near_light="none", indirect=False), frame(pose=look_at(*CLOSE)))
        seen = fields.on_object[fields.matte > 0.99][:, 0] / np.pi
        if low is not None:
            assert seen.min() > low
        else:
            assert np.percentile(seen, 5) < 0.8


def test_what_the_camera_sees_lights_objects_and_ground(gpu: GpuContext, stage: Stage) -> None:
    """A bright floor under a black sky: its light comes from below, and only where it is measured."""
    document = stage.document([stage.virtual(ball(RADIUS))], [ambient(0.0)], floor())
    lit, dark = (
        solve(gpu, aroof(document, near_light=kind), frame(plain(200), pose=look_at(*CLOSE)))
        for kind in ("measured", "none")
    )
    on_ball = lit.matte > 0.99
    assert lit.on_object[on_ball].mean() > 0.2
    assert dark.on_object[on_ball].max() == 0


@pytest.mark.parametrize("change", [{"rigid": False}, {"animation": {}}])
def test_objects_that_change_their_shape_are_refused(
    gpu: GpuContext, stage: Stage, change: dict[str, Any]
) -> None:
    document = aroof(stage.document([stage.virtual(cube(), id="dancer", **change)], [ambient(1.0)], floor()))
    with pytest.raises(DeltalightError, match=r"`dancer`.*use dvct or dlpv"):
        SceneRenderer(gpu, document)


def has_fields(renderer: SceneRenderer) -> bool:
    """Whether every object of the newest frame has its field."""
    assert renderer.graph is not None
    return all(item.textures is not None for item in renderer.graph["occlusion fields"])


def test_a_scene_that_comes_later_is_shown_at_once_and_shaded_when_its_field_is_there(
    gpu: GpuContext, stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    was_shown = threading.Event()

    def compute_later(*given: Any) -> OcclusionField:  # noqa: ANN401
        was_shown.wait(PATIENCE_S)
        return compute_field(*given)

    monkeypatch.setattr(
        "deltalight.render_server.precomputation.occlusion_fields.compute_field", compute_later
    )
    document = stage.document([stage.virtual(ball(RADIUS), (0.0,) * 3)], [ambient(1.0)], floor())
    renderer = SceneRenderer(gpu, document)
    view = frame(plain(), pose=look_at(*CLOSE))
    renderer.render(view)
    renderer.set_scene(aroof(document, near_light="none", rays=100))
    renderer.render(view)
    early = fields_of(renderer)
    assert any("being computed" in notice for notice in renderer.notices)
    was_shown.set()
    deadline = time.monotonic() + PATIENCE_S
    while not has_fields(renderer):
        assert time.monotonic() < deadline
        renderer.render(view)
    late = fields_of(renderer)
    renderer.release()
    shown, away = on_floor(early)
    near = shown & (away < 2 * RADIUS)
    assert (early.cones_rho[near] == early.cones_mu[near]).all()
    assert (late.cones_rho[near] < late.cones_mu[near]).all()


def test_view_volume_shows_cells_in_red(gpu: GpuContext, stage: Stage) -> None:
    document = aroof(stage.document([stage.virtual(ball(RADIUS))], [ambient(1.0)], floor()))
    shown = composite(gpu, document.replaced(output=document.output.replaced(view="volume"))).astype(int)
    assert (shown[..., 0] > shown[..., 1] + 40).sum() > 20


def test_the_picture_tilts_with_the_board_and_light_stays(gpu: GpuContext, stage: Stage) -> None:
    """The object's frame leans 30 degrees with a floor of its own: the shadow on that floor is the same."""
    lean = trimesh.transformations.rotation_matrix(np.radians(30), (1, 0, 0))
    shares = []
    for matrix in (np.eye(4), lean):
        ground = floor()
        ground.apply_transform(matrix)
        half = np.arccos(matrix[1, 1]) / 2
        pose = {"rotation_wxyz": (float(np.cos(half)), float(np.sin(half)), 0.0, 0.0)}
        item = {**stage.virtual(ball(RADIUS), (0.0,) * 3), "pose": pose}
        document = aroof(stage.document([item], [ambient(1.0)], ground), near_light="none")
        fields = solve(gpu, document, frame(pose=BoardPose(matrix @ look_at(*CLOSE).world_from_camera)))
        known = (fields.position[..., 3] > 0) & (fields.matte == 0)
        shares.append(
            np.where(known, fields.cones_rho[..., 0] / np.maximum(fields.cones_mu[..., 0], 1e-9), 1.0)
        )
    assert np.abs(shares[0] - shares[1]).max() < 0.03


def test_without_near_light_the_environment_alone_surrounds_an_object(gpu: GpuContext, stage: Stage) -> None:
    """Even radiance from all directions, none of them measured by the camera."""
    document = aroof(
        stage.document([stage.virtual(ball(RADIUS))], [ambient(0.25)], floor()), near_light="none"
    )
    renderer = SceneRenderer(gpu, document)
    renderer.render(frame())
    assert renderer.graph is not None
    (item,) = renderer.graph["occlusion fields"]
    radiance = array_of(item.probe.radiance)
    renderer.release()
    assert radiance[..., :3] == pytest.approx(0.25, abs=1e-3)
    assert (radiance[..., 3] == 0).all()
