"""What lies or stands on a declared smooth surface is no part of it: paper, cards, flat things, the foot of a box."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh

from deltalight.protocol.board import BoardSpec, GreyCard
from deltalight.protocol.frames import ViewFrame
from deltalight.protocol.scene import SceneDocument
from deltalight.protocol.scene_objects import PlaneRegion, Region, Surface
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.shader_source import SHADERS
from deltalight.render_server.renderer import SceneRenderer
from deltalight.render_server.scene.declared_surfaces import UNBOUNDED_M, build_surface_table, plane_fits
from deltalight.render_server.scene.depth_surface import depth_surface
from tests.render_server.scenes import (
    COARSE,
    HEIGHT,
    WIDTH,
    Stage,
    ambient,
    array_of,
    ball,
    camera,
    composite,
    cube,
    depth_image,
    fields_of,
    floor,
    floor_depth,
    frame,
    look_at,
    noisy,
)

pytestmark = pytest.mark.usefixtures("clean_gl")
RADIUS, BALL_AT = 0.06, (0.0, 0.0, 0.14)
CARD = GreyCard(center_m=(-0.1, -0.16), size_m=(0.06, 0.04), rotation_deg=30, albedo=0.18)
BOARD = BoardSpec(
    type="aruco_grid",
    dictionary="DICT_4X4_50",
    marker_length_m=0.06,
    separation_m=0.02,
    rows=2,
    columns=2,
    margins_m=(0.09, 0.01, 0.02, 0.03),
    grey_cards=(CARD,),
)
TOLERANCE_M = 0.02
HALF_FLOAT_STEP = 2**-10  # relative; drivers round the last bit either way


@pytest.fixture
def stage(tmp_path: Path) -> Stage:
    return Stage(tmp_path, COARSE)


def silver(document: SceneDocument, height_m: float = 0.0, **more: Any) -> SceneDocument:  # noqa: ANN401
    """The document with a floor of polished silver, declared at a height."""
    plane = {"point_m": [0, 0, height_m], "normal": [0, 0, 1], "tolerance_m": TOLERANCE_M}
    surface = {"region": {"plane": plane}, "metallic": 1.0, "albedo": [0.9] * 3, "roughness": 0.02, **more}
    return document.replaced(real=document.real.replaced(surfaces=(Surface.model_validate(surface),)))


def glowing_ball(stage: Stage) -> SceneDocument:
    objects = [stage.virtual(ball(RADIUS, BALL_AT), (0, 0, 0), {"emission": [0.6] * 3})]
    return stage.document(objects, [ambient(0.2)])


def on_floor() -> np.ndarray:
    """Places (x, y) on the floor that pixels see, (h, w, 2)."""
    pose = look_at().world_from_camera
    rays = np.dstack([camera().rays(), np.ones((HEIGHT, WIDTH))]) @ pose[:3, :3].T
    return np.asarray(pose[:2, 3] - rays[..., :2] * (pose[2, 3] / rays[..., 2:]))


def inside(quad: np.ndarray) -> np.ndarray:
    """Pixels whose place on the floor lies in a rectangle."""
    from_corner, edges = on_floor() - quad[0, :2], np.array([quad[1] - quad[0], quad[3] - quad[0]])[:, :2]
    share = from_corner @ edges.T / (edges**2).sum(axis=1)
    return np.asarray(((share >= 0) & (share <= 1)).all(axis=2))


def thing(height_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Depth of a floor with a flat thing where the mirror shows the ball, and the pixels well on its top."""
    x, y = np.moveaxis(on_floor(), 2, 0)
    covered = (np.abs(x - 0.05) < 0.05) & (np.abs(y + 0.2) < 0.05)
    depth = np.where(covered, floor_depth(look_at(), height_m), floor_depth(look_at()))
    return depth, cv2.erode(covered.astype(np.uint8), np.ones((5, 5))) > 0


def measured(depth: np.ndarray, noise_m: float, **changes: Any) -> ViewFrame:  # noqa: ANN401
    """A frame whose depth has noise, which its description says too."""
    noise = np.random.default_rng(3).normal(size=depth.shape) * noise_m * depth**2
    image = depth_image((depth + noise).astype(np.float32))
    return frame(noisy(), depth=type(image)(image.depth_m, image.valid, image.camera, noise_m), **changes)


def mirrored(gpu: GpuContext, document: SceneDocument, view: ViewFrame) -> np.ndarray:
    """Share of each pixel's lobe that objects fill, (h, w)."""
    renderer = SceneRenderer(gpu, document)
    renderer.render(view)
    assert renderer.graph is not None
    found = array_of(renderer.graph["reflections"])[..., 3]
    renderer.release()
    return found


def real_surface(gpu: GpuContext, document: SceneDocument, view: ViewFrame) -> np.ndarray:
    """World position, depth and surface entry of each pixel, (h, w, 5)."""
    renderer = SceneRenderer(gpu, document)
    renderer.render(view)
    found = fields_of(renderer).position
    assert renderer.graph is not None
    entry = array_of(renderer.graph["real surface"].surface.normal)[..., 3:]
    renderer.release()
    return np.concatenate([found, entry], axis=2)


@pytest.mark.parametrize("noise_m", [0.0005, 0.004])
def test_the_boards_paper_and_its_cards_are_as_without_the_declared_table(
    gpu: GpuContext, stage: Stage, noise_m: float
) -> None:
    """Margin and card included, by the ray and not by the noisy point; beside them the table mirrors."""
    plain = glowing_ball(stage)
    depth = floor_depth(look_at())
    bare, with_board = (measured(depth, noise_m, board=board) for board in (None, BOARD))
    paper = inside(BOARD.paper_outline()) | inside(CARD.outline())
    bare_table, table = (mirrored(gpu, silver(plain), view) for view in (bare, with_board))
    assert (bare_table[paper] > 0.5).sum() > 50
    assert not table[paper].any()
    np.testing.assert_allclose(table[~paper], bare_table[~paper], rtol=HALF_FLOAT_STEP)
    declared, undeclared = (composite(gpu, document, with_board) for document in (silver(plain), plain))
    np.testing.assert_array_equal(declared[paper], undeclared[paper])
    assert (declared[~paper] != undeclared[~paper]).any()


@pytest.mark.parametrize("noise_m", [0.0005, 0.004])
def test_a_declared_sheet_is_no_mirror(gpu: GpuContext, stage: Stage, noise_m: float) -> None:
    """Thinner than depth shows and turned on the table: by its outline alone; beside it the table mirrors."""
    bare = silver(glowing_ball(stage))
    sheet = {"middle_m": [0.05, -0.2], "size_m": [0.12, 0.07], "turn_deg": 30.0}
    declared = Surface.model_validate({"region": {"sheet": sheet}})
    document = bare.replaced(real=bare.real.replaced(surfaces=(*bare.real.surfaces, declared)))
    turn = np.radians(30)
    edge, other = np.array([np.cos(turn), np.sin(turn), 0]), np.array([-np.sin(turn), np.cos(turn), 0])
    corners = [
        np.array([0.05, -0.2, 0]) + a * 0.06 * edge + b * 0.035 * other
        for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))
    ]
    covered = inside(np.array(corners))
    view = measured(floor_depth(look_at()), noise_m)
    without, with_sheet = (mirrored(gpu, each, view) for each in (bare, document))
    assert (without[covered] > 0.5).sum() > 50
    assert not with_sheet[covered].any()
    np.testing.assert_allclose(with_sheet[~covered], without[~covered], rtol=HALF_FLOAT_STEP)


def test_a_flat_thing_on_the_table_is_no_mirror(gpu: GpuContext, stage: Stage) -> None:
    """12 mm high within a tolerance of 20 mm, which noise of 1 mm does not explain; the table around it mirrors."""
    document = silver(glowing_ball(stage))
    depth, top = thing(0.012)
    seen = mirrored(gpu, document, measured(depth, 0.001))
    everywhere = mirrored(gpu, document, measured(floor_depth(look_at()), 0.001))
    assert (everywhere[top] > 0.5).sum() > 50
    assert not seen[top].any()
    far = cv2.dilate(top.astype(np.uint8), np.ones((11, 11))) == 0
    assert np.mean((seen > 0.5)[far] == (everywhere > 0.5)[far]) > 0.99


@pytest.mark.parametrize("geometry", ["model", "depth"])
def test_the_foot_of_a_standing_box_is_no_mirror(gpu: GpuContext, stage: Stage, geometry: str) -> None:
    """Its sides within 20 mm of the table, told by their normals; the floor beside is the declared plane."""
    real = trimesh.util.concatenate([floor(), cube(0.1, (0.0, -0.3, 0.0))])
    seen = real_surface(gpu, silver(stage.document([stage.virtual(cube())], [ambient(0.2)], real)), frame())
    if geometry == "depth":
        view = frame(depth=depth_image(seen[..., 3].astype(np.float32)))
        seen = real_surface(gpu, silver(glowing_ball(stage)), view)
    x, y, z = np.moveaxis(seen[..., :3], 2, 0)
    on_box = (np.abs(x) < 0.045) & (np.abs(y + 0.35) < 0.002) & (z > 0.003) & (z < 0.017)
    beside = (np.abs(z) < 1e-3) & ((np.abs(x) > 0.07) | (y < -0.37)) & (np.abs(x) < 0.2)
    assert on_box.sum() > 20
    assert (seen[on_box, 4] == -1).all()
    assert beside.sum() > 500
    assert (seen[beside, 4] == 0).all()


def test_a_table_that_is_declared_too_low_still_mirrors(gpu: GpuContext, stage: Stage) -> None:
    plain = glowing_ball(stage)
    view = measured(floor_depth(look_at()), 0.001)
    right, low = (mirrored(gpu, silver(plain, height), view) for height in (0.0, -0.008))
    assert low.sum() > 0.8 * right.sum()


def test_how_depth_saw_a_plane() -> None:
    """Height 8 mm over the declared plane, and the noise, which is twice what the stream says."""
    view = measured(floor_depth(look_at()), 0.002)
    assert view.depth is not None
    regions = [
        Region(plane=PlaneRegion(point_m=(0, 0, -0.008), tolerance_m=TOLERANCE_M)),
        Region(plane=PlaneRegion(point_m=(0, 0, 5.0))),
    ]
    table = build_surface_table([Surface(region=region) for region in regions])
    place = look_at().world_from_camera
    surface = depth_surface(view.depth, camera())
    fits = plane_fits(table, view.depth, lambda: surface, place, 0.001)
    assert f"plane_fits[{len(fits)}]" in (SHADERS / "common/measured_surfaces.glsl").read_text()
    assert fits[0] == pytest.approx([0.008, 0.002], rel=0.1)
    assert fits[1].tolist() == [0.0, UNBOUNDED_M]
    assert (plane_fits(table, None, lambda: surface, place, 0.001)[:, 1] == UNBOUNDED_M).all()
