"""Qualities `live` and `balanced`: what a moving picture keeps of the frames before, and that nothing of it stays."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from deltalight.protocol.frames import ViewFrame
from deltalight.protocol.quality import TIERS
from deltalight.protocol.scene import SceneDocument
from deltalight.protocol.scene_method import DvctMethod
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import watched
from deltalight.render_server.renderer import SceneRenderer
from tests.render_server.protected_scenes import EYE, METHODS, Case, scene_of
from tests.render_server.scenes import Stage, camera, depth_image, floor_depth, frame, look_at, psnr_db

pytestmark = pytest.mark.usefixtures("clean_gl")
FRAME_NS = 50_000_000
ARM_COLOR = (90, 160, 200)


def seen(aside: float, number: int, *, arm: bool = False, brightness: float = 1.0) -> ViewFrame:
    """A patterned floor from a camera that looks `aside` (m) of the objects; an arm may hang in the picture."""
    pose = look_at(EYE, (aside, 0.0, 0.06))
    depth = floor_depth(pose)
    rays = np.dstack([camera().rays(), np.ones(depth.shape)])
    world = (depth[..., None] * rays) @ pose.world_from_camera[:3, :3].T + pose.world_from_camera[:3, 3]
    waves = np.sin(world[..., 0] * 20) * np.cos(world[..., 1] * 16)
    color = np.where(depth[..., None] > 0, 130 + 40 * waves[..., None] * (1, 0.8, 0.5), 60) * brightness
    if arm:
        depth[50:70, 110:] = 0.45
        color[50:70, 110:] = ARM_COLOR
    more: dict[str, Any] = {"frame_id": number, "timestamp_ns": number * FRAME_NS}
    return frame(color.astype(np.uint8), pose=pose, depth=depth_image(depth.astype(np.float32)), **more)


@dataclass
class Player:
    """A renderer of a quality, and the number of its next frame."""

    gpu: GpuContext
    scene: SceneDocument
    quality: str
    renderer: SceneRenderer = field(init=False)
    count: int = 0

    def __post_init__(self) -> None:
        self.renderer = SceneRenderer(self.gpu, self.scene, checks=True)
        self.change(self.scene)

    def change(self, scene: SceneDocument) -> None:
        self.renderer.set_scene(scene.replaced(method=scene.method.replaced(quality=self.quality)))

    def show(self, aside: float = 0.0, **changes: Any) -> np.ndarray:  # noqa: ANN401
        self.count += 1
        return self.renderer.render(seen(aside, self.count, **changes)).color.astype(float)

    def ran(self, clock: str) -> set[str]:
        """Stages of the newest frame that follow a clock."""
        assert self.renderer.graph is not None
        return {stage.name for stage in self.renderer.graph.report() if stage.ran and clock in stage.clocks}


@pytest.fixture
def scene(tmp_path: Path) -> SceneDocument:
    return scene_of(Case("exact", "depth", "plain"), Stage(tmp_path))


@pytest.fixture
def players(gpu: GpuContext, scene: SceneDocument) -> Iterator[dict[str, Player]]:
    found: dict[str, Player] = {quality: Player(gpu, scene, quality) for quality in TIERS}
    yield found
    for player in found.values():
        player.renderer.release()


ASIDE = [0.004 * step for step in range(1, 8)]


def test_a_moving_picture_is_close_to_the_best(players: dict[str, Player]) -> None:
    """On the pixels that objects change."""
    for aside in [0.0, *ASIDE]:
        shown = {quality: player.show(aside) for quality, player in players.items()}
    plain = cv2.resize(seen(aside, 0).color, (96, 72), interpolation=cv2.INTER_AREA).astype(float)
    changed = np.abs(shown["best"] - plain).max(axis=-1) > 0
    assert 0.1 < changed.mean() < 0.9
    assert psnr_db(shown["balanced"][changed], shown["best"][changed]) > 48
    assert psnr_db(shown["live"][changed], shown["best"][changed]) > 36


@pytest.mark.parametrize("method", [name for name in METHODS if name != "aroof"])
def test_a_camera_over_a_still_room_lights_no_voxel(gpu: GpuContext, tmp_path: Path, method: str) -> None:
    scene = scene_of(Case(method, "depth", "plain"), Stage(tmp_path))
    live, best = (Player(gpu, scene, quality) for quality in ("live", "best"))
    for aside in (0.0, *ASIDE[:2]):
        live.show(aside)
        best.show(aside)
    kept = {
        name for name in best.ran("world") if "voxel" in name or "inject" in name or "shadow maps" in name
    }
    assert kept
    assert live.ran("world").isdisjoint(kept)
    assert live.ran("view")
    live.renderer.release()
    best.renderer.release()


def dragged(scene: SceneDocument, along_m: float) -> SceneDocument:
    first, *others = scene.objects
    pose = first.pose.model_copy(update={"translation_m": (along_m, 0.0, 0.0)})
    return scene.replaced(objects=(first.model_copy(update={"pose": pose}), *others))


BOUNCES = {
    "exact": {"voxelize objects", "light joint voxels", "bounces joint"},
    "paper": {"voxelize objects", "split inject"},
    "dlpv": {"voxelize objects", "inject change", "bounces"},
}
FOLLOWS = {"object surface", "shadow maps objects", "direct light", "object radiance"}


@pytest.mark.parametrize("method", BOUNCES)
def test_light_bounces_later_off_objects_that_move(gpu: GpuContext, tmp_path: Path, method: str) -> None:
    """In every third frame, and in the first at rest; what is seen of them and their shadows are in each."""
    scene = scene_of(Case(method, "depth", "plain"), Stage(tmp_path))
    player = Player(gpu, scene, "live")
    player.show()
    ran = []
    for along_m in (0.004, 0.008, 0.012, 0.016, 0.02, 0.02):
        player.change(dragged(scene, along_m))
        player.show()
        ran.append(player.ran("objects"))
    assert all(ran[frame] >= FOLLOWS for frame in range(5))
    assert [bool(BOUNCES[method] & stages) for stages in ran] == [True, False, False, True, False, True]
    assert all(BOUNCES[method] <= ran[frame] for frame in (0, 3, 5))
    player.renderer.release()


def test_a_dragged_object_is_close_to_the_best_and_as_if_put_there_once_it_stands(
    gpu: GpuContext, scene: SceneDocument, players: dict[str, Player]
) -> None:
    live, best = players["live"], players["best"]
    live.show()
    for along_m in (0.004, 0.008, 0.012, 0.016):
        shown = {}
        for quality, player in (("live", live), ("best", best)):
            player.change(dragged(scene, along_m))
            shown[quality] = player.show()
        assert psnr_db(shown["live"], shown["best"]) > 36
    stands = live.show()
    put = Player(gpu, scene, "live")
    put.show()
    put.change(dragged(scene, 0.016))
    put.count = live.count - 1
    assert np.abs(stands - put.show()).max() <= 1
    put.renderer.release()


def test_at_rest_it_becomes_the_best_picture(players: dict[str, Player]) -> None:
    live, best = players["live"], players["best"]
    for aside in ASIDE:
        live.show(aside)
    wanted = best.show(ASIDE[-1])
    for _ in range(200):
        shown = live.show(ASIDE[-1])
        if psnr_db(shown, wanted) > 60:
            break
    assert psnr_db(shown, wanted) > 60
    assert live.count < 200
    assert psnr_db(live.show(ASIDE[-1]), wanted) > 60  # and stays


def test_the_best_picture_comes_without_a_jump(gpu: GpuContext, players: dict[str, Player]) -> None:
    """It fades in within 0.4 s: eight frames here."""
    live, kernels = players["live"], set[str]()
    fading: list[np.ndarray] = []
    for aside in ASIDE:
        before = live.show(aside)
    with watched(gpu, lambda run: kernels.add(run.kernel)):
        while live.count < 200 and (not fading or "crossfade" in kernels):
            kernels.clear()
            shown = live.show(ASIDE[-1])
            if "crossfade" in kernels:
                fading.append(shown)
            elif not fading:
                before = shown
    greatest = np.abs(shown - before).max()
    assert greatest > 8
    assert len(fading) == 8
    for earlier, later in pairwise([before, *fading, shown]):
        assert np.abs(later - earlier).max() <= greatest / 8 + 1
    unchanged = (before == shown).all(axis=-1)
    assert all((each[unchanged] == shown[unchanged]).all() for each in fading)


def test_what_reaches_in_hides_at_once_and_is_relit_half_a_second_later(players: dict[str, Player]) -> None:
    live = players["live"]
    live.show()
    live.show(ASIDE[0])
    at_once = live.show(ASIDE[1], arm=True)
    assert "voxelize real" not in live.ran("world")
    assert np.abs(at_once[33:39, 70:] - ARM_COLOR).max() < 30  # of 96 x 72 pixels
    rebuilt = []
    for number in range(10):
        live.show(ASIDE[2 + number % 2], arm=True)
        rebuilt.append("voxelize real" in live.ran("world"))
    assert any(rebuilt)
    assert sum(rebuilt) <= 2


@pytest.mark.parametrize("change", ["object", "light"])
def test_light_of_before_a_change_is_not_reused(
    players: dict[str, Player], scene: SceneDocument, gpu: GpuContext, change: str
) -> None:
    """The first picture after it is that of a renderer which never knew anything else."""
    player, (ball, box) = players["balanced"], scene.objects
    for aside in (0.0, *ASIDE[:3]):
        player.show(aside)
    if change == "object":
        moved = box.replaced(pose=box.pose.replaced(translation_m=(-0.1, 0.1, 0.0)))
        scene = scene.replaced(objects=[ball, moved])
    else:
        sun, sky = scene.lights.manual
        scene = scene.replaced(lights=scene.lights.replaced(manual=[sun.replaced(irradiance=0.5), sky]))
    player.change(scene)
    shown = player.show(ASIDE[2])
    fresh = Player(gpu, scene, "balanced")
    for aside in (0.0, *ASIDE[:3], ASIDE[2]):
        expected = fresh.show(aside)
    assert psnr_db(shown, expected) > 45  # the volume stays where it is
    fresh.renderer.release()


def test_every_tile_gets_new_light_in_turn(players: dict[str, Player]) -> None:
    """However long the camera moves, the picture does not drift away."""
    balanced, best = players["balanced"], players["best"]
    for step in range(24):
        shown, wanted = balanced.show(ASIDE[step % 7]), best.show(ASIDE[step % 7])
    assert psnr_db(shown, wanted) > 50


def test_settings_keep_within_the_limits_of_their_quality() -> None:
    given = DvctMethod(cone_count=32, shadow_samples=4, quality="live")
    assert (given.limited().cone_count, given.limited().shadow_samples) == (8, 4)
    best = given.replaced(quality="best")
    assert best.limited() == best
