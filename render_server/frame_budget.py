"""What a moving frame gives up so that it is finished in the time that the scene document grants."""

import hashlib
import json
import os
import statistics
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import get_args

from deltalight.protocol.cached_files import cache_folder, mark_used, prune, read_cached, write_cached
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.methods import Method
from deltalight.protocol.quality import Quality
from deltalight.protocol.scene_output import Output

WARM_UP = 2  # frames after a change of level: they compile, allocate and build
WINDOW = 5  # frames: the median tells
URGENT, URGENTLY = 2, 2.0  # frames in a row, each so many times as long as the budget: these tell at once
TOLERANCE = 1.1  # of the budget: what a level may take before a lower one is chosen
ROOM = 0.8  # of the budget: what the level above must be expected to take before it is chosen
PATIENCE = 30  # frames with that much room; twice as many after each try that failed
HELD_BYTES = 4096  # of levels that are kept for the next start: a hundred


@dataclass(frozen=True)
class Level:
    """A quality, and the scale of the picture's width and height that is rendered and then enlarged."""

    quality: Quality
    scale: float = 1.0


# From the most costly to the cheapest, each with what a frame took relative to the first (`bench speed`, llvmpipe).
LEVELS = {
    Level("best"): 1.0,
    Level("balanced"): 0.4,
    Level("live"): 0.2,
    Level("live", 0.75): 0.13,
    Level("live", 0.5): 0.07,
}


class HeldLevels:
    """The levels that held budgets when this machine last rendered the same, in the user's cache.

    A start that begins there need not be too slow first, and then build everything for smaller pictures. `of`: what
    they depend on besides the scene document, such as the number of cameras.
    """

    def __init__(self, of: str) -> None:
        self._of = f"{os.cpu_count()} cores; {of}"
        try:
            self._folder = cache_folder("levels")
        except RuntimeError:  # a user without a home
            self._folder = Path(os.devnull)  # finds and keeps nothing

    def budget(self, method: Method, output: Output, renderer_name: str) -> "FrameBudget":
        """Returns the budget of a scene document, which begins at the level that held it before."""
        if output.frame_budget_ms is None:
            return FrameBudget(None, method.quality)
        asked = f"{output.width} x {output.height} in {output.frame_budget_ms} ms"
        rendered = f"{renderer_name}; {method.model_dump_json()}; {asked}"
        return FrameBudget(
            output.frame_budget_ms, method.quality, self.find(rendered), partial(self.keep, rendered)
        )

    def find(self, rendered: str) -> Level | None:
        """Returns the level that held before; None if it is not known."""
        file = self._file(rendered)
        content = read_cached(file)
        mark_used(file)
        try:
            return None if content is None else Level(**json.loads(content))
        except (TypeError, ValueError):  # another version's
            return None

    def keep(self, rendered: str, level: Level) -> None:
        """Keeps a level, and forgets those that were not used for longest; does without where the disk refuses."""
        file = self._file(rendered)
        with suppress(DeltalightError):
            write_cached(file, json.dumps(asdict(level)).encode())
            prune(self._folder, HELD_BYTES, keep=file)

    def _file(self, rendered: str) -> Path:
        name = hashlib.sha256(f"{self._of}; {rendered}".encode()).hexdigest()
        return self._folder / f"{name}.json"


class FrameBudget:
    """Chooses the level of frames in which something moves, from how long earlier ones took.

    `best` is the highest quality that it may choose; without a budget (ms), it chooses that and nothing else. It
    begins at the level `begins`, if it may choose that, and tells `note` each level that it changes to.
    """

    def __init__(
        self,
        budget_ms: float | None,
        best: Quality,
        begins: Level | None = None,
        note: Callable[[Level], None] = lambda _level: None,
    ) -> None:
        allowed = get_args(Quality)[: get_args(Quality).index(best) + 1]
        self._budget_ms, self._note = budget_ms, note
        self._levels = [level for level in LEVELS if level.quality in allowed]
        self._at = next((at for at, level in enumerate(self._levels) if level == begins), 0)
        self._times_ms: deque[float] = deque(maxlen=WINDOW)
        self._ignored = WARM_UP
        self._frames_with_room = 0
        self._patience = PATIENCE
        self._is_trying = False  # the level was chosen because there was room
        self.remark: str | None = None

    @property
    def level(self) -> Level:
        """What the next frame is to be rendered at."""
        return self._levels[self._at]

    def add(self, frame_ms: float) -> None:
        """Takes the time of a frame at the current level in which something moved."""
        if self._budget_ms is None:
            return
        if self._ignored:
            self._ignored -= 1
            return
        self._times_ms.append(frame_ms)
        newest = list(self._times_ms)[-URGENT:]
        if len(newest) == URGENT and min(newest) > URGENTLY * self._budget_ms:
            self._judge(min(newest), self._budget_ms)
        elif len(self._times_ms) == WINDOW:
            self._judge(statistics.median(self._times_ms), self._budget_ms)

    def _judge(self, typical_ms: float, budget_ms: float) -> None:
        """Goes down to the first level that should hold the budget, or up by one when that has long had room."""
        cost = LEVELS[self.level]
        expected = [typical_ms * LEVELS[level] / cost for level in self._levels]
        last = len(self._levels) - 1
        if typical_ms > TOLERANCE * budget_ms:
            lower = [at for at in range(self._at + 1, len(self._levels)) if expected[at] <= budget_ms]
            if self._at == last and self.remark is None:
                self.remark = (
                    f"A frame takes {typical_ms:.0f} ms at the lowest quality, so output.frame_budget_ms "
                    f"({budget_ms:g}) cannot be held here: expect {1000 / typical_ms:.1f} frames/s, or lower "
                    "output.width."
                )
            self._patience *= 2 if self._is_trying else 1
            self._change_to(lower[0] if lower else last, is_trying=False)
            return
        has_room = self._at > 0 and expected[self._at - 1] <= ROOM * budget_ms
        self._frames_with_room = self._frames_with_room + 1 if has_room else 0
        if self._frames_with_room >= self._patience:
            self._change_to(self._at - 1, is_trying=True)

    def _change_to(self, at: int, *, is_trying: bool) -> None:
        if at != self._at:
            self._at, self._ignored, self._is_trying = at, WARM_UP, is_trying
            self._note(self.level)
        self._times_ms.clear()
        self._frames_with_room = 0
