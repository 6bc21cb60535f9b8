"""Lights of modes `fisheye` and `tracked`: from maps and markers of frames to light sets and pictures."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from deltalight.protocol import scene_lights as documents
from deltalight.protocol.board import BoardSpec
from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.envelope import decode
from deltalight.protocol.equidistant_lens import EquidistantLens
from deltalight.protocol.fisheye_lens import FisheyeCalibration
from deltalight.protocol.frames import DepthImage, LampPose, RadianceMap, ViewFrame, decode_lut
from deltalight.protocol.hemisphere import texel_directions
from deltalight.protocol.light_codecs import sky_lights
from deltalight.protocol.light_cutter import LightCutter
from deltalight.protocol.messages import LightsMessage
from deltalight.protocol.occlusion import is_occluded
from deltalight.protocol.octahedral import octahedral_grid, sample_octahedral
from deltalight.protocol.scene import SceneDocument
from deltalight.protocol.sky_lights import SkyLights
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.lights.light_models import DirectionalLight, SphereLight
from deltalight.render_server.lights.lights import LightSet
from deltalight.render_server.lights.sources import FisheyeSource, TrackedSource
from deltalight.render_server.renderer import SceneRenderer
from deltalight.sensor_node.frame_messages import Stamps, lights_multipart
from tests.render_server.scenes import (
    COARSE,
    Stage,
    camera,
    cube,
    depth_image,
    floor,
    floor_depth,
    frame,
    look_at,
    plain,
)

SIZE = 64
SECOND = 1_000_000_000
LAMP = np.array([0.6, -0.2, 0.7]) / np.linalg.norm([0.6, -0.2, 0.7])
EDGE = 120
FOCAL = EDGE / np.radians(190)
CALIBRATION = FisheyeCalibration(
    EquidistantLens(
        CameraModel(
            EDGE,
            EDGE,
            np.array([[FOCAL, 0, (EDGE - 1) / 2], [0, FOCAL, (EDGE - 1) / 2], [0, 0, 1]]),
            "equidistant",
            np.zeros(4),
        )
    )
)
BOARD = BoardSpec(
    type="aruco_grid",
    dictionary="DICT_4X4_50",
    marker_length_m=0.12,
    separation_m=0.15,
    rows=2,
    columns=3,
    first_id=0,
    white_albedo=0.7,
)


def seen(
    lamp: np.ndarray = LAMP,
    value: float = 100.0,
    radius_deg: float = 4.0,
    *,
    place: tuple[float, float, float] = (0, 0, 0.05),
) -> RadianceMap:
    """What an up-looking camera sees of a grey sky with one lamp."""
    radiance = np.full((SIZE, SIZE, 3), 0.3, np.float32)
    radiance[texel_directions(SIZE) @ lamp > np.cos(np.radians(radius_deg))] = value
    pose = np.eye(4)
    pose[:3, 3] = place
    picture = np.full((EDGE, EDGE, 3), 90, np.uint8)
    return RadianceMap(0, radiance, np.ones((SIZE, SIZE), bool), pose, 0.0, picture, CALIBRATION)


def source(**settings: object) -> FisheyeSource:
    lights = documents.FisheyeLights().replaced(**settings)
    return FisheyeSource(documents.Lights(mode="fisheye", fisheye=lights))


def followed(one: FisheyeSource | TrackedSource, view: ViewFrame) -> LightSet:
    lights = one.update(view)
    assert lights is not None
    return lights


def test_a_map_becomes_a_directional_light_and_an_environment() -> None:
    lights = followed(source(), frame(radiance_map=seen()))
    (lamp,) = lights.lights
    assert isinstance(lamp, DirectionalLight)
    assert -lamp.direction @ LAMP > np.cos(np.radians(1.0))  # the disc covers few texels
    assert lights.registration.tolist() == [1, 1, 1]
    up = sample_octahedral(lights.environment, np.array([[[0.0, 0, 1]]]))[0, 0]
    assert up == pytest.approx([0.3] * 3, rel=1e-3)
    below = octahedral_grid(len(lights.environment))[..., 2] < -0.1
    assert lights.ground_fraction[below].min() == 1
    assert lights.ground_fraction[octahedral_grid(len(lights.environment))[..., 2] > 0.1].max() == 0
    grounded = lights.with_ground(np.array([0.9, 0.5, 0.1], np.float32))
    assert grounded.environment[below] == pytest.approx(np.tile([0.9, 0.5, 0.1], (below.sum(), 1)), rel=1e-4)


def test_a_turned_camera_gives_the_same_light_in_the_world() -> None:
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    turned = seen(turn.T @ LAMP)
    turned.world_from_fisheye[:3, :3] = turn
    (lamp,) = followed(source(), frame(radiance_map=turned)).lights
    assert isinstance(lamp, DirectionalLight)
    assert -lamp.direction @ LAMP > np.cos(np.radians(1.0))  # the disc covers few texels


def test_nothing_new_costs_nothing() -> None:
    one, picture = source(), seen()
    assert one.update(frame()) is None
    assert "No fish-eye picture has come yet" in one.remarks[0]
    assert one.update(frame(radiance_map=picture)) is not None
    assert one.remarks == ()
    for step in range(5):
        assert one.update(frame(radiance_map=picture, timestamp_ns=step * SECOND)) is None
    assert one.update(frame(radiance_map=seen(), timestamp_ns=6 * SECOND)) is not None


def test_lights_keep_their_number_and_settle_after_a_jump() -> None:
    one = source(smoothing_s=0.5)
    first = followed(one, frame(radiance_map=seen()))
    brighter = seen(value=200.0)
    lights = followed(one, frame(radiance_map=brighter, timestamp_ns=SECOND))
    for step in range(1, 16):
        new = one.update(frame(radiance_map=brighter, timestamp_ns=SECOND + step * SECOND // 10))
        lights = new or lights
    assert lights.identities == first.identities == (1,)
    before, after = first.lights[0], lights.lights[0]
    assert isinstance(before, DirectionalLight)
    assert isinstance(after, DirectionalLight)
    assert after.irradiance[0] == pytest.approx(2 * before.irradiance[0], rel=0.06)
    assert lights.describe()[0]["id"] == 1


def from_node(sky: SkyLights) -> SkyLights:
    """The lights as they come from a sensor node, through bytes."""
    stamps = Stamps(node="desk", frame_id=0, capture_ns=0, clock_offset_ns=0, clock_bound_ns=None)
    message, parts = decode(lights_multipart(sky, stamps, stamps))
    assert isinstance(message, LightsMessage)
    return sky_lights(message, parts)


def assert_same_light(ours: LightSet, theirs: LightSet) -> None:
    """All that the renderer takes is the same to the bit."""
    assert ours.describe() == theirs.describe()
    assert ours.identities == theirs.identities
    for name in ("environment", "ground_fraction", "registration"):
        assert np.array_equal(getattr(ours, name), getattr(theirs, name))


def changing_light() -> list[ViewFrame]:
    """A lamp that moves and gets brighter while the lights still follow, in 12 frames."""
    maps = [seen(), seen(np.array([0.5, -0.4, 0.7]) / np.linalg.norm([0.5, -0.4, 0.7]), 170.0)]
    return [frame(radiance_map=maps[step // 3 % 2], timestamp_ns=step * SECOND // 10) for step in range(12)]


def test_lights_of_the_node_are_those_of_a_cut_here_for_all_servers(monkeypatch: pytest.MonkeyPatch) -> None:
    views, cutter = changing_light(), LightCutter(documents.LightCut())
    own, newest = source(), None
    sent: list[SkyLights] = []
    expected = [own.update(view) for view in views]
    for view in views:
        newest = cutter.update(view)
        sent.append(from_node(newest) if newest is not None else sent[-1])
    monkeypatch.delattr("deltalight.protocol.light_cutter.split_map")  # no server cuts any more
    servers = [source(), source()]
    for view, sky, alone in zip(views, sent, expected, strict=True):
        for server in servers:
            taken = server.update(replace(view, sky_lights=sky))
            assert (taken is None) == (alone is None)
            if taken is not None and alone is not None:
                assert_same_light(taken, alone)
    assert len({id(sky) for sky in sent}) > 4
    late = followed(source(), replace(views[-1], sky_lights=sent[-1]))
    assert_same_light(late, next(one for one in reversed(expected) if one is not None))
    assert servers[0].regions == servers[1].regions == own.regions != ()


def test_lights_cut_in_another_way_are_cut_here_and_it_is_said() -> None:
    sky = LightCutter(documents.LightCut(count=2, smoothing_s=1.0)).update(frame(radiance_map=seen()))
    view = frame(radiance_map=seen(), sky_lights=sky)
    one = source(count=7, threshold=2.5, smoothing_s=1.0)
    assert_same_light(followed(one, view), followed(source(count=7, threshold=2.5, smoothing_s=1.0), view))
    assert "set count = 7, threshold = 2.5 in [node.lights]" in one.remarks[0]
    assert source(count=2, smoothing_s=1.0).update(replace(view, radiance_map=None)) is not None


def test_a_given_distance_makes_lamps_of_lights() -> None:
    lights = followed(source(distance_m=2.0), frame(radiance_map=seen(place=(0.1, 0.2, 0.3))))
    far = followed(source(distance_m="far"), frame(radiance_map=seen())).lights[0]
    (lamp,) = lights.lights
    assert isinstance(lamp, SphereLight)
    assert isinstance(far, DirectionalLight)
    assert lamp.position == pytest.approx(np.array([0.1, 0.2, 0.3]) + 2 * LAMP, abs=0.02)
    assert lamp.intensity == pytest.approx(4 * far.irradiance, rel=1e-4)
    assert lamp.radius_m == pytest.approx(2 * np.sin(far.angular_radius_rad), rel=1e-4)


def paper_under_a_lamp(distance_m: float | None) -> ViewFrame:
    """The camera looks at paper that a lamp in the direction of LAMP lights, and an even sky."""
    view = frame(board=BOARD, radiance_map=seen())
    assert view.pose is not None
    matrix = view.pose.world_from_camera
    rays = np.dstack([view.camera.rays(), np.ones(view.color.shape[:2])]) @ matrix[:3, :3].T
    points = matrix[:3, 3] - rays * (matrix[2, 3] / rays[..., 2:])
    inverse = 0.0 if distance_m is None else 1 / distance_m
    way = LAMP - inverse * (points - (0, 0, 0.05))
    solid_angle = 2 * np.pi * (1 - np.cos(np.radians(4.0)))
    light = 100 * solid_angle * way[..., 2] / np.linalg.norm(way, axis=-1) ** 3 + np.pi * 0.3
    radiance = 0.7 / np.pi * light * 0.5
    codes = np.searchsorted(decode_lut(None)[:, 0], np.clip(radiance, 0, 1)).clip(0, 255)
    return replace(view, color=np.repeat(codes[..., None], 3, axis=2).astype(np.uint8))


@pytest.mark.parametrize("distance_m", [0.7, 1.5])
def test_paper_tells_how_far_a_lamp_is(distance_m: float) -> None:
    one = source()
    (lamp,) = followed(one, paper_under_a_lamp(distance_m)).lights
    assert isinstance(lamp, SphereLight)
    assert np.linalg.norm(lamp.position) == pytest.approx(distance_m, rel=0.1)
    assert "as the board's paper tells" in one.remarks[0]


def test_light_from_far_away_stays_far() -> None:
    (lamp,) = followed(source(), paper_under_a_lamp(None)).lights
    assert isinstance(lamp, DirectionalLight)


def test_paper_that_comes_into_view_later_still_tells() -> None:
    one, view = source(), paper_under_a_lamp(1.0)
    assert isinstance(followed(one, replace(view, board=None)).lights[0], DirectionalLight)
    assert isinstance(followed(one, view).lights[0], SphereLight)
    assert one.update(view) is None


def wall(distance: float = 1.0) -> tuple[DepthImage, np.ndarray]:
    """A camera at the origin that looks along +y at a wall whose right half is a metre farther away."""
    pose = look_at((0, 0, 0), (0, 1, 0))
    depth = np.full((camera().height, camera().width), distance, np.float32)
    depth[:, camera().width // 2 :] += 1
    return depth_image(depth), pose.world_from_camera


def test_walls_hide_what_is_behind_them() -> None:
    depth, pose = wall()
    place = np.array([-0.1, 0.5, 0])
    assert is_occluded(depth, pose, place, np.array([0.0, 1, 0]))  # straight through the wall
    assert not is_occluded(depth, pose, place, np.array([0.0, 0.2, 0.98]))  # out of the picture before
    assert not is_occluded(depth, pose, place, np.array([0.0, -1, 0]))  # behind the camera
    assert is_occluded(depth, pose, np.array([0.3, 1.5, 0]), np.array([0.0, 1, 0]))
    behind = np.array([0.2, 1.3, 0])  # passes behind the near half's edge, through free space
    assert not is_occluded(depth, pose, behind, np.array([-1.0, 0.3, 0]) / np.hypot(1, 0.3))


def test_without_depth_nothing_hides() -> None:
    depth, pose = wall()
    unknown = replace(depth, valid=np.zeros_like(depth.valid))
    assert not is_occluded(unknown, pose, np.array([-0.1, 0.5, 0]), np.array([0.0, 1, 0]))


def test_a_bright_wall_is_no_light() -> None:
    """The camera sees the floor; a lamp below the horizon of a tilted fish-eye is a bright spot on that floor."""
    pose = look_at()
    down = np.diag([1.0, -1.0, -1.0])
    spot = seen(np.array([0.0, 0.2, 0.98]) / np.hypot(0.2, 0.98), place=(0, 0, 0.3))
    spot.world_from_fisheye[:3, :3] = down
    view = frame(pose=pose, depth=depth_image(floor_depth(pose)), radiance_map=spot)
    assert followed(source(), view).lights == ()
    assert len(followed(source(), replace(view, depth=None)).lights) == 1


def lamp_pose(x: float, marker: int = 7) -> LampPose:
    pose = np.eye(4)
    pose[:3, :3] = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    pose[:3, 3] = (x, 0.1, 0.8)
    return LampPose(marker, pose)


def tracked(**settings: object) -> documents.Lights:
    lamp = documents.TrackedLamp(
        marker=7, offset_m=(0.1, 0, -0.05), intensity=3.0, color_linear=(1, 0.9, 0.8)
    )
    return documents.Lights(mode="tracked", tracked=(lamp,)).replaced(**settings)


def test_a_lamp_stands_where_its_marker_says() -> None:
    one = TrackedSource(tracked())
    lights = followed(one, frame(lamps=(lamp_pose(0.5),)))
    (lamp,) = lights.lights
    assert isinstance(lamp, SphereLight)
    assert lamp.position == pytest.approx([0.5, 0.2, 0.75])
    assert lamp.intensity == pytest.approx([3.0, 2.7, 2.4])
    assert lights.registration.tolist() == [1, 1, 1]
    assert lights.describe()[0]["id"] == 7
    assert one.remarks == ()


def test_a_lamp_that_moves_is_followed_and_one_that_trembles_is_not() -> None:
    one = TrackedSource(tracked())
    followed(one, frame(lamps=(lamp_pose(0.5),)))
    assert one.update(frame(lamps=(lamp_pose(0.504),))) is None
    moved = followed(one, frame(lamps=(lamp_pose(0.52),)))
    assert moved.lights[0].describe()["position_m"][0] == pytest.approx(0.52)


def test_a_lamp_out_of_sight_stays_and_one_never_seen_is_said() -> None:
    one = TrackedSource(tracked())
    assert followed(one, frame()).lights == ()
    assert "No picture has shown the marker of lamp 7 yet" in one.remarks[0]
    followed(one, frame(lamps=(lamp_pose(0.5), lamp_pose(1.0, marker=3))))
    assert list(one.remarks) == []
    assert one.update(frame()) is None
    assert "lamp 7 is out of sight" in one.remarks[0]


def test_tracked_needs_lamps_with_markers_of_their_own() -> None:
    lamp = documents.TrackedLamp(marker=7)
    for lamps, sentence in ((), "mode tracked needs"), ((lamp, lamp), "names a marker twice"):
        with pytest.raises(ValueError, match=sentence):
            documents.Lights(mode="tracked", tracked=lamps)


def document(stage: Stage, lights: documents.Lights, view: str = "composite") -> SceneDocument:
    made = stage.document([stage.virtual(cube(0.05, (-0.2, 0.15, 0)))], [], floor())
    return made.replaced(lights=lights, output=made.output.replaced(view=view))


@pytest.mark.usefixtures("clean_gl")
def test_fisheye_light_is_registered_on_paper_and_moves_without_registering_again(
    gpu: GpuContext, tmp_path: Path
) -> None:
    """The picture was taken with half the light that the fish-eye camera's units say: factor 0.5."""
    view = paper_under_a_lamp(1.5)
    renderer = SceneRenderer(gpu, document(Stage(tmp_path, COARSE), documents.Lights(mode="fisheye")))
    untouched = renderer.render(replace(view, radiance_map=None))
    assert np.array_equal(untouched.color, view.color)
    first = renderer.render(view)
    again = renderer.render(view)
    assert np.array_equal(first.color, again.color)
    sky = LightCutter(documents.LightCut()).update(view)
    assert sky is not None
    taken = renderer.render(replace(view, sky_lights=from_node(sky)))
    assert np.array_equal(first.color, taken.color)
    assert not np.array_equal(first.color, view.color)
    (factor,) = [sentence for sentence in renderer.notices if "lights registered by patch" in sentence]
    lamp = first.lights[0]
    solid_angle = 2 * np.pi * (1 - np.cos(np.radians(4.0)))
    distance = np.linalg.norm(np.array(lamp["position_m"]) - (0, 0, 0.05))
    assert lamp["intensity"][0] / distance**2 == pytest.approx(0.5 * 100 * solid_angle, rel=0.1)
    brighter = replace(view, radiance_map=seen(value=150.0), timestamp_ns=SECOND)
    renderer.render(brighter)
    last = renderer.render(replace(brighter, timestamp_ns=10 * SECOND))
    assert last.lights[0]["id"] == lamp["id"]
    assert last.lights[0]["intensity"][0] == pytest.approx(1.5 * lamp["intensity"][0], rel=0.05)
    assert [sentence for sentence in renderer.notices if "registered" in sentence] == [factor]
    renderer.release()


@pytest.mark.usefixtures("clean_gl")
def test_the_parallax_follows_a_fisheye_that_moves(gpu: GpuContext, tmp_path: Path) -> None:
    view = paper_under_a_lamp(1.5)
    renderer = SceneRenderer(gpu, document(Stage(tmp_path, COARSE), documents.Lights(mode="fisheye")))
    for second, place in enumerate(((0.0, 0.0, 0.05), (0.2, 0.0, 0.05))):
        renderer.render(replace(view, radiance_map=seen(place=place), timestamp_ns=second * SECOND))
        parallax = renderer._live.lighting._parallax
        assert parallax is not None
        assert parallax.fisheye.tolist() == [*place]
    renderer.release()


DARK, BRIGHT, EVEN_SKY = 60, 140, 0.3


def sheet_on_a_dark_table() -> ViewFrame:
    """A dark table with a bright sheet below the object, under an even sky, which is all that the fish-eye sees."""
    view = frame(radiance_map=seen(value=EVEN_SKY))
    assert view.pose is not None
    matrix = view.pose.world_from_camera
    rays = np.dstack([view.camera.rays(), np.ones(view.color.shape[:2])]) @ matrix[:3, :3].T
    points = matrix[:3, 3] - rays * (matrix[2, 3] / rays[..., 2:])
    is_sheet = np.linalg.norm(points - (-0.2, 0.15, 0), axis=-1) < 0.12
    color = np.repeat(np.where(is_sheet, BRIGHT, DARK)[..., None], 3, axis=-1).astype(np.uint8)
    return replace(view, color=color)


@pytest.mark.usefixtures("clean_gl")
def test_below_the_horizon_the_table_goes_on_and_not_the_paper_beside_the_objects(
    gpu: GpuContext, tmp_path: Path
) -> None:
    """A server's second picture shows it: the first does not wait for the search."""
    view = sheet_on_a_dark_table()
    lights = documents.Lights(mode="fisheye", registration=(1.0, 1.0, 1.0))
    scene = document(Stage(tmp_path, COARSE), lights)
    waiting, server = SceneRenderer(gpu, scene), SceneRenderer(gpu, scene, waits=False)
    later = replace(view, frame_id=1, timestamp_ns=SECOND)
    pictures = waiting.render(view), server.render(view), server.render(later)
    below = [2 * np.array(each.lights[-1]["mean_radiance"]) - EVEN_SKY for each in pictures]
    table = decode_lut(None)[DARK, 0]
    assert below[0] == pytest.approx([table] * 3, rel=0.2)
    assert below[1].min() > 2 * table
    assert pictures[2].lights == pictures[0].lights
    assert np.array_equal(pictures[2].color, pictures[0].color)
    waiting.release()
    server.release()


@pytest.mark.usefixtures("clean_gl")
def test_lamp_that_appears_lights_the_scene_from_then_on(gpu: GpuContext, tmp_path: Path) -> None:
    renderer = SceneRenderer(gpu, document(Stage(tmp_path, COARSE), tracked(surroundings="none")))
    dark = renderer.render(frame())
    lit = renderer.render(frame(lamps=(lamp_pose(0.5),)))
    kept = renderer.render(frame())
    renderer.release()
    assert [one["type"] for one in dark.lights] == ["environment"]
    assert [one["type"] for one in lit.lights] == ["sphere", "environment"]
    assert not np.array_equal(dark.color, lit.color)
    assert np.array_equal(kept.color, lit.color)
    assert any("never" in one or "No picture has shown" in one for one in renderer.notices)


@pytest.mark.usefixtures("clean_gl")
def test_view_of_the_lights_shows_where_they_are(gpu: GpuContext, tmp_path: Path) -> None:
    view = paper_under_a_lamp(None)
    renderer = SceneRenderer(
        gpu, document(Stage(tmp_path, COARSE), documents.Lights(mode="fisheye"), "lights")
    )
    shown = renderer.render(view)
    assert shown.color.shape == view.color.shape
    assert shown.lights[0]["type"] == "directional"
    scale = view.camera.height / EDGE
    pixel = (CALIBRATION.lens.project(LAMP[None])[0] + 0.5) * scale + (
        (view.camera.width - EDGE * scale) / 2,
        0,
    )
    column, row = np.rint(pixel).astype(int)
    assert not np.array_equal(shown.color[row - 3 : row + 4, column - 3 : column + 4], np.full((7, 7, 3), 90))
    assert shown.color[60, 5].tolist() == [0, 0, 0]  # beside the letterboxed picture
    elsewhere = np.array([[90, 90, 90]])
    assert (shown.color[90:110, 60:90] == elsewhere).all()
    renderer.release()


@pytest.mark.usefixtures("clean_gl")
def test_view_of_the_lights_without_fisheye_is_drawn_on_the_cameras_picture(
    gpu: GpuContext, tmp_path: Path
) -> None:
    lamp = documents.SphereLight(position_m=(0.0, 0.0, 0.1), intensity=1.0, radius_m=0.02)
    renderer = SceneRenderer(
        gpu, document(Stage(tmp_path, COARSE), documents.Lights(manual=(lamp,)), "lights")
    )
    shown = renderer.render(frame(plain())).color
    renderer.release()
    changed = (shown != plain()).any(axis=-1)
    assert 0 < changed.mean() < 0.2
    assert changed[50:70, 70:90].any()
