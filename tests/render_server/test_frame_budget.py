"""A budget for frames in which something moves: what gives way, what comes back, and what smaller pictures show."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest

from deltalight.protocol.cached_files import write_cached
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.scene import SceneDocument, parse_scene
from deltalight.render_server.camera_frames import CameraFrame
from deltalight.render_server.frame_budget import (
    HELD_BYTES,
    PATIENCE,
    WARM_UP,
    WINDOW,
    FrameBudget,
    HeldLevels,
    Level,
)
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import watched
from deltalight.render_server.renderer import CompositeFrame, SceneRenderer
from deltalight.render_server.server.snapshot import SnapshotPicture, SnapshotRequest, take_snapshot
from tests.render_server.protected_scenes import Case, scene_of
from tests.render_server.scenes import Stage, psnr_db
from tests.render_server.test_quality_tiers import seen

pytestmark = pytest.mark.usefixtures("clean_gl")
LIVE, HALF = Level("live"), Level("live", 0.5)


def spend(budget: FrameBudget, frame_ms: float, frames: int = WARM_UP + WINDOW) -> Level:
    for _ in range(frames):
        budget.add(frame_ms)
    return budget.level


def test_without_a_budget_nothing_gives_way() -> None:
    assert spend(FrameBudget(None, "balanced"), 1e6) == Level("balanced")


def test_a_budget_that_is_held_changes_nothing() -> None:
    assert spend(FrameBudget(100, "best"), 104, 100) == Level("best")


def test_the_level_follows_from_how_much_too_long_a_frame_takes() -> None:
    assert spend(FrameBudget(100, "best"), 200) == Level("balanced")
    assert spend(FrameBudget(100, "best"), 490) == LIVE
    assert spend(FrameBudget(100, "best"), 5000) == HALF


def test_quality_never_exceeds_that_of_the_document() -> None:
    budget = FrameBudget(100, "live")
    assert budget.level == LIVE
    assert spend(budget, 1, 10 * PATIENCE) == LIVE


def test_single_long_frames_do_not_count() -> None:
    """A new graph compiles and builds; the real scene is built anew now and then."""
    budget = FrameBudget(100, "live")
    spend(budget, 5000, WARM_UP)
    for _ in range(10):
        spend(budget, 400, 1)
        assert spend(budget, 90, 4) == LIVE


def test_frames_far_too_long_are_not_waited_for() -> None:
    budget = FrameBudget(100, "live")
    assert spend(budget, 600, WARM_UP + 1) == LIVE
    assert spend(budget, 600, 1) == HALF


def test_what_gave_way_comes_back_when_there_has_long_been_room() -> None:
    budget = FrameBudget(100, "live")
    assert spend(budget, 150) == Level("live", 0.75)
    assert spend(budget, 40, WARM_UP + WINDOW - 1 + PATIENCE - 1) == Level("live", 0.75)
    assert spend(budget, 40, 1) == LIVE


def test_levels_that_were_too_slow_are_not_tried_again_and_again() -> None:
    """A frame takes 150 ms at full size and 50 at three quarters: by how much less it shows, there would be room."""
    budget, changes = FrameBudget(100, "live"), 0
    for _ in range(100 * PATIENCE):
        before = budget.level
        budget.add(150 if before == LIVE else 50)
        changes += budget.level != before
    assert budget.level == Level("live", 0.75)
    assert changes < 15


def test_a_budget_that_cannot_be_held_is_said_once() -> None:
    budget = FrameBudget(20, "live")
    spend(budget, 300)
    assert budget.remark is None
    spend(budget, 80)
    said = budget.remark
    assert said is not None
    assert "12.5 frames/s" in said
    spend(budget, 95, 100)
    assert budget.remark == said


def test_a_budget_begins_where_it_was_held_and_tells_each_change() -> None:
    changes: list[Level] = []
    budget = FrameBudget(100, "live", HALF, changes.append)
    assert budget.level == HALF
    spend(budget, 20, 4 * PATIENCE)
    assert changes == [Level("live", 0.75), LIVE]
    assert FrameBudget(100, "live", Level("balanced")).level == LIVE  # above what the document allows now


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("DELTALIGHT_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.mark.usefixtures("cache")
def test_levels_are_held_for_the_next_start() -> None:
    HeldLevels("1 camera").keep("room", HALF)
    assert HeldLevels("1 camera").find("room") == HALF
    assert HeldLevels("2 cameras").find("room") is None
    assert HeldLevels("1 camera").find("another room") is None
    HeldLevels("1 camera").keep("room", LIVE)
    assert HeldLevels("1 camera").find("room") == LIVE


def test_levels_that_were_not_used_for_long_are_forgotten(cache: Path) -> None:
    held = HeldLevels("1 camera")
    for number in range(HELD_BYTES // 30):  # a level takes more
        held.keep(str(number), HALF)
        for file in cache.rglob("*.json"):  # some file systems' times are too coarse to tell the order
            os.utime(file, ns=(0, file.stat().st_mtime_ns - 10**9))
        assert held.find("0") == HALF
    assert held.find("1") is None
    assert held.find(str(number)) == HALF


def test_damaged_and_unwritable_levels_are_as_good_as_none(cache: Path) -> None:
    held = HeldLevels("1 camera")
    held.keep("room", HALF)
    (file,) = cache.rglob("*.json")
    file.write_bytes(b"[")
    assert held.find("room") is None
    held.keep("room", HALF)
    assert held.find("room") == HALF
    write_cached(file, b'{"tier": 1}')  # by another version
    assert held.find("room") is None
    cache.rename(cache.with_name("away"))
    cache.write_text("no folder")
    held.keep("room", LIVE)
    assert held.find("room") is None


def test_a_user_without_a_home_keeps_no_levels(monkeypatch: pytest.MonkeyPatch) -> None:
    def homeless() -> Path:
        raise RuntimeError

    for name in ("DELTALIGHT_CACHE", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(Path, "home", homeless)
    held = HeldLevels("1 camera")
    held.keep("room", HALF)
    assert held.find("room") is None


@pytest.mark.usefixtures("cache")
def test_a_start_begins_at_the_level_that_was_held(gpu: GpuContext, scene: SceneDocument) -> None:
    paced = scene.replaced(output=scene.output.replaced(frame_budget_ms=50))
    levels = []
    for document in (paced, paced, scene):
        walker = Walker(gpu, document, HeldLevels("1 camera"))
        levels.append(walker.show().level)
        if len(levels) == 1:
            hurry(walker)
        walker.renderer.release()
    assert levels == [LIVE, HALF, LIVE]


@pytest.mark.parametrize("budget_ms", [0, 4, 5001, "fast"])
def test_impossible_budgets_are_refused(tmp_path: Path, budget_ms: object) -> None:
    document = scene_of(Case("exact", "depth", "plain"), Stage(tmp_path)).model_dump(mode="json")
    document["output"]["frame_budget_ms"] = budget_ms
    with pytest.raises(DeltalightError, match="frame_budget_ms"):
        parse_scene(document)


@pytest.fixture
def scene(tmp_path: Path) -> SceneDocument:
    plain = scene_of(Case("exact", "depth", "plain"), Stage(tmp_path))
    return plain.replaced(method=plain.method.replaced(quality="live"))


class Walker:
    """Shows frames by a camera that moves to and fro, or stands."""

    def __init__(self, gpu: GpuContext, scene: SceneDocument, held: HeldLevels | None = None) -> None:
        self.renderer = SceneRenderer(gpu, scene, held=held)
        self.count = 0

    def show(self, aside: float | None = None) -> CompositeFrame:
        self.count += 1
        moving = 0.004 * (self.count % 8)
        return self.renderer.render(seen(moving if aside is None else aside, self.count))


@contextmanager
def too_slow() -> Iterator[None]:
    add = FrameBudget.add
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(FrameBudget, "add", lambda self, _ms: add(self, 1e4))
        yield


def hurry(walker: Walker) -> None:
    """Shows frames that take too long, until pictures are at their smallest."""
    with too_slow():
        levels = [walker.show().level for _ in range(2 * (WARM_UP + WINDOW))]
    assert levels[-1] == HALF


@pytest.fixture
def hurried(gpu: GpuContext, scene: SceneDocument) -> Iterator[Walker]:
    """A renderer that was always too slow: at its smallest pictures."""
    walker = Walker(gpu, scene.replaced(output=scene.output.replaced(frame_budget_ms=50)))
    with too_slow():
        assert walker.show().level == LIVE
        hurry(walker)
        yield walker
    walker.renderer.release()


@pytest.fixture
def whole(gpu: GpuContext, scene: SceneDocument, hurried: Walker) -> Iterator[Walker]:
    """The same without a budget."""
    walker = Walker(gpu, scene)
    while walker.count < hurried.count:
        walker.show()
    yield walker
    walker.renderer.release()


def camera_picture(walker: Walker) -> np.ndarray:
    return cv2.resize(seen(0.004 * (walker.count % 8), 0).color, (96, 72), interpolation=cv2.INTER_AREA)


def test_smaller_pictures_are_enlarged_with_the_cameras_detail(hurried: Walker, whole: Walker) -> None:
    small, full = hurried.show(), whole.show()
    plain = camera_picture(whole)
    assert (small.level, full.level) == (HALF, LIVE)
    assert small.color.shape == full.color.shape == plain.shape
    assert small.camera == full.camera
    assert psnr_db(small.color, full.color) > 30
    assert psnr_db(small.color, full.color) > psnr_db(plain, full.color) + 6
    untouched = cv2.erode((small.color == plain).all(axis=-1).astype(np.uint8), np.ones((3, 3))) > 0
    assert untouched.mean() > 0.1  # the camera's own bytes
    assert (full.color[untouched] == plain[untouched]).mean() > 0.9


def test_picking_finds_the_same_things_in_smaller_pictures(hurried: Walker, whole: Walker) -> None:
    """A pixel at half size has the depth of one of the four that it covers: a row is 15 cm of the farthest floor."""
    hurried.show()
    whole.show()
    owners = []
    for y in range(4, 72, 8):
        for x in range(4, 96, 8):
            small = hurried.renderer.pick(x, y)
            covered = [whole.renderer.pick(x + i, y + j) for j in (0, 1) for i in (0, 1)]
            owners.append((small.object_id, covered[0].object_id))
            same = [each for each in covered if each.object_id == small.object_id]
            points = [each.point_m for each in same if each.point_m is not None]
            if small.point_m is not None and points:
                assert np.linalg.norm(np.array(points) - small.point_m, axis=1).min() < 0.03
    assert {full for _, full in owners} >= {None, "ball"}
    assert np.mean([small == full for small, full in owners]) > 0.95


def test_views_of_the_inside_are_not_enlarged(hurried: Walker, whole: Walker) -> None:
    for walker in (hurried, whole):
        scene = walker.renderer.scene
        walker.renderer.set_scene(scene.replaced(output=scene.output.replaced(view="effects")))
    assert hurried.show().level == LIVE
    whole.show()
    assert psnr_db(hurried.show().color, whole.show().color) > 40


def test_at_rest_a_smaller_picture_becomes_the_best(
    gpu: GpuContext, scene: SceneDocument, hurried: Walker
) -> None:
    best = Walker(gpu, scene.replaced(method=scene.method.replaced(quality="best")))
    while best.count < hurried.count:
        wanted = best.show().color
    best.renderer.release()
    aside = 0.004 * (hurried.count % 8)
    shown = hurried.show(aside)
    while shown.level != Level("best") and hurried.count < 200:
        shown = hurried.show(aside)
    assert shown.level == Level("best")
    assert psnr_db(shown.color, wanted) > 55
    assert hurried.show(aside + 0.02).level == HALF


def test_a_size_that_was_shown_before_is_not_built_again(gpu: GpuContext, hurried: Walker) -> None:
    """A look inside at full size between two smaller pictures."""
    if not gpu.is_software:
        pytest.skip("a GPU keeps one size alone, as its memory is scarcer")
    scene = hurried.renderer.scene
    inside = scene.replaced(output=scene.output.replaced(view="effects"))
    hurried.show()
    for shown in (inside, scene, inside):
        hurried.renderer.set_scene(shown)
        hurried.show()
    kernels: set[str] = set()
    hurried.renderer.set_scene(scene)
    with watched(gpu, lambda run: kernels.add(run.kernel.split(" ")[0])):
        assert hurried.show().level == HALF
    assert "composite" in kernels
    assert not kernels & {"voxelize", "reflective_shadow_map"}


def test_snapshots_are_full_size(hurried: Walker, whole: Walker, tmp_path: Path) -> None:
    aside = 0.004 * (hurried.count % 8)
    order = SnapshotRequest(folder=tmp_path, pictures=(SnapshotPicture(name="now"),))
    taken = take_snapshot(
        hurried.renderer,
        hurried.renderer.scene,
        CameraFrame.numbered([seen(aside, hurried.count)]),
        order,
    )
    assert taken.files == ["now.png"]
    shown = cv2.cvtColor(cv2.imread(str(tmp_path / "now.png")), cv2.COLOR_BGR2RGB)
    assert psnr_db(shown, whole.show(aside).color) > 36
    assert hurried.show().level == HALF


def test_files_leave_the_budget_aside(gpu: GpuContext, hurried: Walker) -> None:
    frame = seen(0.0, 1000)
    assert hurried.renderer.render(frame, with_linear=True).level == LIVE
    renderer = SceneRenderer(gpu, hurried.renderer.scene, with_linear=True)
    levels = {renderer.render(seen(0.004 * (number % 8), number)).level for number in range(9)}
    renderer.release()
    assert levels == {LIVE}
