"""Reflections in smooth objects while the camera moves: few are traced anew, and the others are near these."""

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import moderngl
import numpy as np
import pytest
import trimesh

from deltalight.protocol.frames import ViewFrame
from deltalight.protocol.quality import TIERS, Quality
from deltalight.protocol.scene import SceneDocument
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Dispatch, watched
from deltalight.render_server.passes.reflections import ReflectionHistory
from deltalight.render_server.renderer import SceneRenderer
from tests.render_server.scenes import (
    EYE,
    Stage,
    array_of,
    ball,
    camera,
    directional,
    floor,
    floor_depth,
    frame,
    look_at,
    shifted,
)

pytestmark = pytest.mark.usefixtures("clean_gl")
TURNS = TIERS["balanced"].reflection_turns
STEP_M = 0.008  # of the camera aside, from frame to frame: half a degree as seen from the objects
SAME_DIRECTION = 0.25  # as in reflection_history.glsl


@dataclass
class Shown:
    """Of a frame: what was reflected (radiance), and its records' points; 0 where none."""

    reflected: np.ndarray
    points: np.ndarray

    def traced(self, before: "Shown") -> float:
        """Fraction of the records whose points are none of those before."""
        known = {point.tobytes() for point in before.points[before.points.any(axis=-1)]}
        points = self.points[self.points.any(axis=-1)]
        return sum(point.tobytes() not in known for point in points) / max(len(points), 1)


def seen(aside_m: float, number: int, *, corner: int = 0) -> ViewFrame:
    """A patterned floor, from a camera that moved aside; `corner`: colour of one of the picture's."""
    x, y, z = EYE
    pose = look_at((x + aside_m, y, z))
    rays = np.dstack([camera().rays(), np.ones(camera().rays().shape[:2])])
    world = (floor_depth(pose)[..., None] * rays) @ pose.world_from_camera[:3, :3].T
    world = world + pose.world_from_camera[:3, 3]
    waves = np.sin(world[..., 0] * 20) * np.cos(world[..., 1] * 16)
    color = (130 + 40 * waves[..., None] * (1, 0.8, 0.5)).astype(np.uint8)
    color[:24, :24] = corner
    return frame(color, pose=pose, frame_id=number, timestamp_ns=50_000_000 * number)


def silver_things(
    stage: Stage, roughness: float = 0.4, irradiance: float = 2.0, *, flat: bool = False
) -> SceneDocument:
    """A ball and a plate on the floor; the plate alone if `flat`."""
    material = {"metallic": 1.0, "roughness": roughness}
    plate = shifted(trimesh.creation.box((0.3, 0.01, 0.2)), -0.1, 0.12, 0.1)
    objects = [
        stage.virtual(each, (1.0, 1.0, 1.0), material)
        for each in ([plate] if flat else [ball(0.08, (0.12, 0.0, 0.08), detail=4), plate])
    ]
    settings = {"name": "dvct", "volume_size": 32, "caustics": False, "cone_scale": 2}
    return stage.document(objects, [directional(irradiance=irradiance)], floor()).replaced(method=settings)


class Player:
    """A renderer of a quality, and the number of its newest frame."""

    def __init__(self, gpu: GpuContext, scene: SceneDocument, quality: Quality) -> None:
        self._gpu, self._renderer = gpu, SceneRenderer(gpu, scene, checks=True)
        self._quality, self._count = quality, 0
        self.change(scene)

    def change(self, scene: SceneDocument) -> None:
        self._renderer.set_scene(scene.replaced(method=scene.method.replaced(quality=self._quality)))

    def show(self, aside_m: float, corner: int = 0) -> Shown:
        self._count += 1
        runs: list[Dispatch] = []
        with watched(self._gpu, runs.append):
            self._renderer.render(seen(aside_m, self._count, corner=corner))
        records = next((run.written["records"] for run in runs if "records" in run.written), None)
        assert self._renderer.graph is not None
        reflected = array_of(self._renderer.graph["screen cones"])[..., :3]
        return Shown(reflected, points_of(records, reflected.shape[:2]))

    def shows(self, path: Sequence[float]) -> list[Shown]:
        return [self.show(aside_m) for aside_m in path]

    def release(self) -> None:
        self._renderer.release()


def points_of(records: object, size: tuple[int, ...]) -> np.ndarray:
    """Bits of the records' points (h, w, 3) without the stamps; 0 where the run wrote none."""
    if not isinstance(records, moderngl.Texture):
        return np.zeros((*size, 3), np.uint32)
    halves = np.frombuffer(records.read(), np.uint32).reshape(2, *size, 6)[..., :3]
    runs = ((halves & 15) << np.array([0, 4, 8], np.uint32)).sum(axis=-1)
    newest = runs == runs.max()
    points = np.where(newest[..., None], halves & ~np.uint32(15), 0)
    return np.asarray(points.max(axis=0))


@pytest.fixture
def scene(tmp_path: Path) -> SceneDocument:
    return silver_things(Stage(tmp_path))


@pytest.fixture
def players(gpu: GpuContext, scene: SceneDocument) -> Iterator[tuple[Player, Player]]:
    """One that reuses reflections, and one that traces all of them."""
    found = Player(gpu, scene, "balanced"), Player(gpu, scene, "balanced")
    yield found
    for player in found:
        player.release()


@contextmanager
def nothing_kept() -> Iterator[None]:
    """Meanwhile every run of the pass counts as the first."""
    with pytest.MonkeyPatch.context() as patched:
        turn = ReflectionHistory.turn

        def forgetting(history: ReflectionHistory, *given: Any) -> Any:  # noqa: ANN401 (as the method's)
            return {**turn(history, *given), "has_history": False}

        patched.setattr(ReflectionHistory, "turn", forgetting)
        yield


def off(one: Shown, other: Shown) -> np.ndarray:
    """Differences of radiance where both have records (n, 3)."""
    both = one.points.any(axis=-1) & other.points.any(axis=-1)
    assert both.sum() > 500
    return np.asarray(one.reflected[both] - other.reflected[both])


PATH = [STEP_M * step for step in range(6)]


def test_a_moving_camera_traces_few_reflections_anew(players: tuple[Player, Player]) -> None:
    """The means of two discs that are a quarter of their radius apart differ by at most 0.16 of the contrast."""
    player, tracing = players
    shown = player.shows(PATH)
    with nothing_kept():
        wanted = tracing.shows(PATH)
    assert np.mean([later.traced(earlier) for earlier, later in pairwise(shown[1:])]) < 0.4
    assert all(later.traced(earlier) > 0.95 for earlier, later in pairwise(wanted))
    for one, other in zip(shown, wanted, strict=True):
        contrast = np.ptp(other.reflected[other.points.any(axis=-1)])
        assert np.quantile(np.abs(off(one, other)), 0.95) < 2 / math.pi * SAME_DIRECTION * contrast
        assert np.sqrt((off(one, other) ** 2).mean()) < 0.05 * contrast
        assert abs(off(one, other).mean()) < 0.005 * contrast


def test_all_reflections_are_traced_again_within_their_turns(players: tuple[Player, Player]) -> None:
    """Once the camera stands nothing of its motion is left, while what it sees may go on changing."""
    player, tracing = players
    player.shows(PATH)
    with nothing_kept():
        tracing.shows(PATH)
    for number in range(TURNS + 1):
        corner = 100 * (number % 2)
        stands = player.show(PATH[-1], corner)
        with nothing_kept():
            wanted = tracing.show(PATH[-1], corner)
    assert np.abs(off(stands, wanted)).max() < 0.01


@pytest.mark.parametrize("change", ["light", "object"])
def test_a_change_of_light_or_objects_ends_the_history(
    tmp_path: Path, players: tuple[Player, Player], change: str
) -> None:
    player, tracing = players
    stage = Stage(tmp_path)
    changed = (
        silver_things(stage, irradiance=1.0) if change == "light" else silver_things(stage, roughness=0.3)
    )
    for one in players:
        one.shows(PATH[:3])
        one.change(changed)
    shown = player.show(PATH[3])
    with nothing_kept():
        wanted = tracing.show(PATH[3])
    assert (shown.points == wanted.points).all()


def test_a_mirror_is_always_traced(gpu: GpuContext, tmp_path: Path) -> None:
    """Its lobe is narrower than the camera's turn from frame to frame; the plate's pixels hardly widen it."""
    player = Player(gpu, silver_things(Stage(tmp_path), roughness=0.0, flat=True), "balanced")
    shown = player.shows(PATH)
    assert all(later.traced(earlier) > 0.9 for earlier, later in pairwise(shown))
    player.release()
