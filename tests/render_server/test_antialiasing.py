"""Coverage of pixels by objects: right for known shapes, nothing lost, nothing else changed."""

from dataclasses import replace
from pathlib import Path

import cv2
import moderngl
import numpy as np
import pytest
import trimesh

from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.frames import DepthImage, ViewFrame, decode_lut
from deltalight.protocol.scene import SceneDocument
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.list_groups import LIST_HEADER_BYTES
from deltalight.render_server.passes import coverage
from deltalight.render_server.passes.coverage import PATTERN, STEPS, EdgeTriangles
from deltalight.render_server.renderer import SceneRenderer
from tests.render_server.scenes import (
    FOCAL,
    HEIGHT,
    WIDTH,
    ObjectsRenderer,
    Stage,
    ambient,
    array_of,
    ball,
    camera,
    composite,
    cube,
    depth_image,
    directional,
    everyday,
    frame,
    look_at,
    noisy,
    shifted,
    unlit,
)

pytestmark = pytest.mark.usefixtures("clean_gl")
PIXEL = 1.0 / FOCAL  # m that a pixel spans at 1 m
ABOVE = look_at((0.0, 0.0, 1.0), (0.0, 0.0, 0.0))
GLOW, DIM = 0.9, 0.1  # linear radiance


@pytest.fixture
def stage(tmp_path: Path) -> Stage:
    return Stage(tmp_path)


def antialiased(document: SceneDocument, wanted: bool = True) -> SceneDocument:
    return document.replaced(output=document.output.model_copy(update={"antialiasing": wanted}))


def glowing(stage: Stage, mesh: trimesh.Trimesh) -> SceneDocument:
    """An object of one radiance; nothing else about the picture changes."""
    material = {"base_color": (0, 0, 0), "specular": 0, "emission": (GLOW, GLOW, GLOW)}
    return unlit(stage.document([{"asset": stage.asset(mesh), "material": material}], [ambient(0.2)]))


def seen_from_above(depth_m: float = 3.0, model: CameraModel | None = None) -> ViewFrame:
    """A camera 1 m above the origin that looks down on a plane."""
    depth = depth_image(np.full((HEIGHT, WIDTH), depth_m, np.float32))
    return frame(noisy(), pose=ABOVE, depth=depth, **({} if model is None else {"camera": model}))


def sheet(
    width: float, height: float, x: float = 0.0, y: float = 0.0, turn_deg: float = 0.0
) -> trimesh.Trimesh:
    """A rectangle at 1 m below that camera; all in pixels from the optical centre."""
    mesh = trimesh.creation.box((width * PIXEL, height * PIXEL, 1e-4))
    mesh.apply_translation((x * PIXEL, y * PIXEL, -0.5e-4))
    mesh.apply_transform(trimesh.transformations.rotation_matrix(np.radians(turn_deg), (0, 0, 1)))
    return mesh


def area_shares(normal: np.ndarray, shift: float, steps: int = 32) -> np.ndarray:
    """Share of each pixel on the near side of a line: normal . x < shift, in pixels from the optical centre."""
    across, down = np.arange(WIDTH) + 0.5 - WIDTH / 2, np.arange(HEIGHT) + 0.5 - HEIGHT / 2
    x, y = np.meshgrid(across, -down)
    inside = shift - normal[0] * x - normal[1] * y
    shares = (inside > 0).astype(float)
    cut = np.abs(inside) < 1
    u, v = np.meshgrid(*[(np.arange(steps) + 0.5) / steps - 0.5] * 2)
    shares[cut] = (normal[0] * u + normal[1] * v < inside[cut, None, None]).mean(axis=(1, 2))
    return shares


def test_the_pattern_holds_the_centre_and_one_sample_in_each_row_and_column() -> None:
    """The centre, on a border of eighths, stands for one of those beside it."""
    pattern = np.array(PATTERN)
    assert tuple(pattern[0]) == (0, 0)
    places = np.arange(1 - len(PATTERN), len(PATTERN), STEPS // len(PATTERN))
    for axis in (0, 1):
        assert np.abs(np.sort(pattern[:, axis]) - places).max() <= 1
        assert len(np.unique(pattern[:, axis])) == len(pattern)
    assert np.all(np.diff((pattern**2).sum(axis=1)) >= 0)


@pytest.mark.slow
@pytest.mark.parametrize("turn_deg", [0.0, 90.0, 180.0, 17.0, 45.0])
@pytest.mark.parametrize("shift", [0.1, 0.37, 0.8])
def test_share_of_a_half_plane(objects: ObjectsRenderer, stage: Stage, turn_deg: float, shift: float) -> None:
    half_plane = sheet(400, 800, shift - 200, 0, turn_deg)
    found = objects.coverage(antialiased(glowing(stage, half_plane)), seen_from_above())
    angle = np.radians(turn_deg)
    expected = area_shares(np.array([np.cos(angle), np.sin(angle)]), shift)
    assert 0.1 < expected.mean() < 0.9
    upright = turn_deg % 90 == 0
    assert np.abs(found - expected).max() <= (1 / 16 + 1e-3 if upright else 1 / 8)


def area_through(lens: CameraModel, radius_m: float, x: float, y: float, corners: int = 256) -> float:
    """Pixels that the picture of a disc covers; it lies 1 m before the camera, its centre at (x, y) m."""
    turn = np.linspace(0, 2 * np.pi, corners, endpoint=False)
    rim = np.stack([x + radius_m * np.cos(turn), y + radius_m * np.sin(turn), np.ones(corners)], axis=1)
    u, v = lens.project(rim).T
    return float(abs(u @ np.roll(v, -1) - v @ np.roll(u, -1))) / 2


def disc_in_the_middle(radius_px: float) -> trimesh.Trimesh:
    disc = trimesh.creation.cylinder(radius_px * PIXEL, 1e-4, sections=256)
    return shifted(disc, 0.3 * PIXEL, -0.1 * PIXEL, -0.5e-4)


@pytest.mark.parametrize("distortion", [0.0, -0.3])
def test_area_of_a_small_disc(objects: ObjectsRenderer, stage: Stage, distortion: float) -> None:
    lens = camera(distortion=(distortion, 0.0, 0.0, 0.0, 0.0))
    document = antialiased(glowing(stage, disc_in_the_middle(9.3)))
    found = objects.coverage(document, seen_from_above(model=lens))
    expected = area_through(lens, 9.3 * PIXEL, 0.3 * PIXEL, 0.1 * PIXEL)
    assert found.sum() == pytest.approx(expected, rel=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("distortion", [0.0, -0.3, 0.2])
@pytest.mark.parametrize("middle", [(0.0, 0.0), (0.5, 0.5), (0.3, -0.2)])
def test_area_of_a_disc_is_that_of_its_picture(
    objects: ObjectsRenderer, stage: Stage, distortion: float, middle: tuple[float, float]
) -> None:
    """Wherever between pixels the optical axis passes, with antialiasing or without: no row is skipped or doubled."""
    matrix = camera().matrix.copy()
    matrix[:2, 2] += middle
    lens = replace(camera(distortion=(distortion, 0.0, 0.0, 0.0, 0.0)), matrix=matrix)
    for radius_px in (8.14, 50.0):
        document = glowing(stage, disc_in_the_middle(radius_px))
        areas = [
            objects.coverage(antialiased(document, wanted), seen_from_above(model=lens)).sum()
            for wanted in (False, True)
        ]
        expected = area_through(lens, radius_px * PIXEL, 0.3 * PIXEL, 0.1 * PIXEL)
        assert areas == pytest.approx([expected, expected], rel=0.01)
        assert areas[0] == pytest.approx(areas[1], rel=0.01)


@pytest.mark.parametrize("x", [0.03, 0.28, 0.405, 0.655, 0.905])
def test_thin_bar_is_neither_lost_nor_doubled(objects: ObjectsRenderer, stage: Stage, x: float) -> None:
    """Half a pixel wide: on each row its shares add up to its width, and the light it brings to its radiance."""
    document = antialiased(glowing(stage, sheet(0.5, 40, x, 0.0)))
    view = seen_from_above()
    linear, matte = objects.linear(document, view), objects.newest_coverage()
    before = decode_lut(None)[view.color, np.arange(3)]
    rows = slice(HEIGHT // 2 - 15, HEIGHT // 2 + 15)
    shares = matte[rows]
    assert shares.sum(axis=1) == pytest.approx(0.5, abs=1 / 8)
    mixed = (1 - shares[..., None]) * before[rows] + shares[..., None] * GLOW
    assert linear[rows] == pytest.approx(mixed, abs=2e-3)


def test_an_inclined_thin_bar_has_no_gap(objects: ObjectsRenderer, stage: Stage) -> None:
    found = objects.coverage(antialiased(glowing(stage, sheet(0.5, 80, 0.2, 0.0, 13.0))), seen_from_above())
    rows = found[HEIGHT // 2 - 30 : HEIGHT // 2 + 30]
    assert (rows.sum(axis=1) > 0.2).all()
    assert rows.sum() == pytest.approx(60 * 0.5 / np.cos(np.radians(13)), rel=0.05)


def test_a_long_thin_bar_is_whole(gpu: GpuContext, stage: Stage) -> None:
    """Its bounds hold more pixels than a thread of a software renderer may look at."""
    width, height, length = 480, 360, 420
    lens = camera(width, height)
    view = frame(
        np.full((height, width, 3), 100, np.uint8),
        pose=ABOVE,
        camera=lens,
        depth=DepthImage(np.full((height, width), 3.0), np.ones((height, width), bool), lens, 0.001),
    )
    renderer = SceneRenderer(gpu, antialiased(glowing(stage, sheet(0.5, length, 0.2, 0.0, 50.0))))
    renderer.render(view)
    graph = renderer.graph
    assert graph is not None
    found = array_of(graph["object surface"].coverage.texture)[..., 0]
    renderer.release()
    assert found.sum() == pytest.approx(0.5 * length, rel=0.05)
    columns = found.sum(axis=0)[width // 2 - 150 : width // 2 + 150]
    assert (columns > 0.2).all()


def knotted(detail: int) -> trimesh.Trimesh:
    """A ball, a ring and needles thinner than a pixel, some through each other, some far away."""
    needles = [
        sheet(0.4, 60, 10.0 * k - 30, 2.0 * k, 23.0 * k).apply_translation((0, 0, 0.06 - 0.03 * k))
        for k in range(7)
    ]
    ring = trimesh.creation.torus(24 * PIXEL, 5 * PIXEL, 8 * detail, 4 * detail)
    ring.apply_transform(trimesh.transformations.rotation_matrix(1.1, (1.0, 0.4, 0.2)))
    specks = [ball(0.3 * PIXEL, (x * 7.3 * PIXEL, -50 * PIXEL, -0.2), 1) for x in range(-4, 5)]
    return trimesh.util.concatenate(
        [ball(18 * PIXEL, (0.02, 0.01, 0.0), detail // 2), ring, *needles, *specks]
    )


def everywhere(triangles: EdgeTriangles, pixels: moderngl.Buffer) -> None:
    """Marks all tiles, so that every sample of every pixel is found."""
    pixels.write(bytes(LIST_HEADER_BYTES), offset=0)
    triangles.tiles.write(b"\3\0\0\0\0\0\0\0" * (triangles.tiles.size // 8))
    triangles.nodes.write(b"\0" * 8)


@pytest.mark.parametrize("distortion", [0.0, -0.3])
@pytest.mark.parametrize("detail", [4, 10])
def test_samples_at_edges_alone_make_the_same_picture(
    objects: ObjectsRenderer, stage: Stage, monkeypatch: pytest.MonkeyPatch, distortion: float, detail: int
) -> None:
    """Also where a real surface cuts through the objects."""
    document = stage.document([stage.virtual(knotted(detail))], [directional((1.0, 0.3, -1.0)), ambient(0.3)])
    lens = camera(distortion=(distortion, 0.0, 0.0, 0.0, 0.0))
    view = seen_from_above(1.01, lens)
    some, matte = objects.linear(antialiased(unlit(document)), view), objects.newest_coverage()
    monkeypatch.setattr(EdgeTriangles, "clear", everywhere)
    assert np.array_equal(some, objects.linear(antialiased(unlit(document)), view))
    assert np.array_equal(matte, objects.newest_coverage())
    assert ((matte > 0) & (matte < 1)).sum() > 200


def test_inside_an_object_a_pixel_has_one_sample(objects: ObjectsRenderer, stage: Stage) -> None:
    """Of a sheet, the pixels along its outline have all of them, and few triangles are listed there."""
    grid = sheet(60, 60, 0.3, 0.3).subdivide_to_size(4 * PIXEL)
    objects.draw(antialiased(glowing(stage, grid)), seen_from_above())
    graph = objects.renderer.graph
    assert graph is not None
    samples = graph["object surface"].samples
    listed = int(np.frombuffer(samples.pixels.read(4), np.uint32)[0])
    assert 4 * 60 <= listed <= 4 * 60 * 4
    nodes, _ = np.frombuffer(samples.triangles.nodes.read(8), np.uint32)
    triangles = np.frombuffer(samples.triangles.nodes.read(8 * nodes, offset=8), np.uint32)[::2]
    assert 0 < len(np.unique(triangles)) < 0.5 * len(grid.faces)


def test_where_lists_lack_room_edges_are_those_of_the_first_sample(
    gpu: GpuContext, stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    for room in ("NODES_PER_TRIANGLE", "NODES_PER_TILE"):
        monkeypatch.setattr(coverage, room, 0)
    objects = ObjectsRenderer(gpu, stage)
    found = objects.coverage(antialiased(glowing(stage, disc_in_the_middle(9.3))), seen_from_above())
    objects.renderer.release()
    assert set(np.unique(found)) == {0.0, 1.0}
    assert found.sum() == pytest.approx(np.pi * 9.3**2, rel=0.05)


def test_the_edge_of_a_floor_that_begins_behind_the_camera(objects: ObjectsRenderer, stage: Stage) -> None:
    """Its triangles cross the near plane, and may show anywhere."""
    floor = trimesh.creation.box((20.0, 0.2, 3.0))
    floor.apply_translation((0.0, -0.2 - 0.4 * PIXEL, 0.5))  # from 1 m behind the camera to 2 m before it
    found = objects.coverage(antialiased(glowing(stage, floor)), seen_from_above())
    expected = area_shares(np.array([0.0, 1.0]), -(0.1 / PIXEL + 0.4) / 2)
    assert 0.1 < expected.mean() < 0.9
    assert np.abs(found - expected).max() <= 1 / 16 + 1e-3


def test_without_the_wish_pixels_are_covered_or_not(objects: ObjectsRenderer, stage: Stage) -> None:
    document = glowing(stage, ball(8.4 * PIXEL, (0, 0, 0)))
    assert set(np.unique(objects.coverage(document, seen_from_above()))) == {0.0, 1.0}


def test_real_pixels_beside_the_object_are_the_cameras(objects: ObjectsRenderer, stage: Stage) -> None:
    document = antialiased(glowing(stage, ball(8.4 * PIXEL, (0, 0, 0))))
    picture, matte = objects.draw(document, seen_from_above()).color, objects.newest_coverage()
    assert not any("antialiasing" in line for line in objects.renderer.notices)
    assert np.array_equal(picture[matte == 0], noisy()[matte == 0])
    partly = (matte > 0) & (matte < 1)
    assert np.count_nonzero(partly) > 30


def test_asking_for_it_and_taking_it_back_leaves_no_trace(gpu: GpuContext, stage: Stage) -> None:
    plain = everyday(stage)
    smooth = antialiased(plain)
    renderer = SceneRenderer(gpu, plain)
    pictures = []
    for document in (plain, smooth, smooth, plain):
        renderer.set_scene(document)
        pictures.append(renderer.render(frame(noisy())).color)
    renderer.release()
    assert not np.array_equal(pictures[0], pictures[1])
    assert np.array_equal(pictures[1], pictures[2])
    assert np.array_equal(pictures[0], pictures[3])
    assert np.array_equal(pictures[1], composite(gpu, smooth, frame(noisy())))


def test_real_surface_still_hides_the_object_and_softens_its_edge(
    objects: ObjectsRenderer, stage: Stage
) -> None:
    """Where an object fills its pixels, the share is what it is without antialiasing."""
    document = glowing(stage, cube(60 * PIXEL, (0, 0, -60 * PIXEL)))
    depth = np.full((HEIGHT, WIDTH), 3.0, np.float32)
    depth[:, : WIDTH // 2] = 0.5
    view = frame(noisy(), pose=ABOVE, depth=depth_image(depth))
    hard, smooth = (objects.coverage(antialiased(document, wanted), view) for wanted in (False, True))
    assert smooth[:, : WIDTH // 2 - 3].max() == 0
    filled = np.s_[HEIGHT // 2 - 28 : HEIGHT // 2 + 28, : WIDTH // 2 + 28]
    assert np.array_equal(hard[filled], smooth[filled])
    assert ((hard[filled] > 0) & (hard[filled] < 1)).any()


def two_sheets(stage: Stage, near: trimesh.Trimesh) -> SceneDocument:
    """A small sheet, and a large dimmer one 1 m below it."""
    far = shifted(sheet(400, 400), 0, 0, -1.0)
    sheets = [
        {
            "asset": stage.asset(mesh),
            "material": {"base_color": (0, 0, 0), "specular": 0, "emission": (glow,) * 3},
        }
        for mesh, glow in ((near, GLOW), (far, DIM))
    ]
    return unlit(stage.document(sheets, [ambient(0.2)]))


def test_what_is_hidden_lends_nothing_to_the_outline_before_it(
    objects: ObjectsRenderer, stage: Stage
) -> None:
    document = antialiased(two_sheets(stage, sheet(20, 20, 0.3, 0.3)))
    assert objects.coverage(document, seen_from_above(1.5)).sum() == pytest.approx(400, rel=0.02)


@pytest.mark.parametrize("turn_deg", [0.0, 45.0])
def test_edges_of_objects_before_each_other_are_mixed(
    objects: ObjectsRenderer, stage: Stage, turn_deg: float
) -> None:
    document = antialiased(two_sheets(stage, sheet(400, 800, 0.37 - 200, 0, turn_deg)))
    linear, matte = objects.linear(document, seen_from_above()), objects.newest_coverage()
    angle = np.radians(turn_deg)
    shares = area_shares(np.array([np.cos(angle), np.sin(angle)]), 0.37)[..., None]
    assert matte.min() == 1
    assert np.abs(linear - (shares * GLOW + (1 - shares) * DIM)).max() <= (GLOW - DIM) / 8


def test_creases_of_an_object_are_mixed(objects: ObjectsRenderer, stage: Stage) -> None:
    """Faces of unlike light meet along a roof's ridge: on each row the bright part adds up to its width."""
    roof = trimesh.creation.box((40 * PIXEL, 40 * PIXEL, 40 * PIXEL))
    roof.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 4, (0, 1, 0)))
    ridge = 0.3
    roof.apply_translation((ridge * PIXEL, 0, -20 * PIXEL * np.sqrt(2)))
    document = stage.document([stage.virtual(roof)], [directional((1.0, 0.0, -1.0), 2.0)])
    linear = objects.linear(antialiased(unlit(document)), seen_from_above())
    row = linear[HEIGHT // 2, :, 0]
    left, right = WIDTH // 2 - 10, WIDTH // 2 + 10
    bright, dark = row[left], row[right]
    assert bright > 10 * dark
    width = ((row[left:right] - dark) / (bright - dark)).sum()
    assert width == pytest.approx(10 + ridge, abs=1 / 8)


def test_objects_are_shaded_at_the_pixels_centres(objects: ObjectsRenderer, stage: Stage) -> None:
    """Antialiasing changes what edges show, and nothing about pixels that a surface fills."""
    document = stage.document([stage.virtual(knotted(10))], [directional((1.0, 0.3, -1.0)), ambient(0.3)])
    view, pictures = seen_from_above(), []
    for wanted in (True, False):
        pictures.append(objects.linear(antialiased(unlit(document), wanted), view))
        matte = objects.newest_coverage()
        if wanted:
            inside = cv2.erode((matte == 1).astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    assert inside.sum() > 500
    smooth, plain = (picture[inside] for picture in pictures)
    assert np.mean(np.all(smooth == plain, axis=-1)) > 0.9  # the others lie at edges between objects


def highlight(objects: ObjectsRenderer, stage: Stage, shift: tuple[float, float], fineness: int) -> float:
    """Light of a lamp's highlight on a ball of radius 6 px, summed over the pixels (in those of fineness 1)."""
    shiny = {"base_color": (0, 0, 0), "specular": 1.0, "roughness": 0.2}
    mesh = ball(6 * PIXEL, (shift[0] * PIXEL, shift[1] * PIXEL, 0.0), 4)
    lens = camera(fineness * WIDTH, fineness * HEIGHT, fineness * FOCAL)
    depth = DepthImage(
        np.full((lens.height, lens.width), 3.0), np.ones((lens.height, lens.width), bool), lens, 0.001
    )
    view = frame(np.full((lens.height, lens.width, 3), 100, np.uint8), pose=ABOVE, camera=lens, depth=depth)
    lit, dark = (
        objects.linear(
            antialiased(
                unlit(stage.document([stage.virtual(mesh, material=shiny)], [directional((1, 0.5, -1.5), e)]))
            ),
            view,
        )
        for e in (0.2, 1e-6)  # nowhere above white
    )
    return float((lit - dark).sum(dtype=np.float64)) / fineness**2


def test_highlights_smaller_than_a_pixel_keep_their_light_wherever_they_fall(
    objects: ObjectsRenderer, stage: Stage
) -> None:
    expected = highlight(objects, stage, (0.0, 0.0), 6)
    shifts = [(x / 3, y / 3) for x in range(3) for y in range(3)]
    found = np.array([highlight(objects, stage, shift, 1) for shift in shifts]) / expected
    print(f"mean {found.mean():.3f}, {found.min():.3f} .. {found.max():.3f}")
    assert found.mean() == pytest.approx(1.0, abs=0.2)
    assert found == pytest.approx(found.mean(), rel=0.25)
