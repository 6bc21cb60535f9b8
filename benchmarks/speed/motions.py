"""What moves while frames are timed: made from the demo's recording and scene, the same every time."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import count, cycle, islice

import numpy as np
from jaxtyping import Float64
from rich.progress import Progress

from deltalight.protocol.documents import nearest
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import ViewFrame
from deltalight.protocol.scene import SceneDocument
from deltalight.protocol.scene_lights import ManualLight
from deltalight.protocol.scene_objects import SceneObject
from deltalight.protocol.source import open_source
from deltalight.render_server.view import resized_frame
from deltalight.sensor_node.view_frames import ViewFrameBuilder
from deltalight.services.demo import RECORDING

STANDING = range(20)
"""Frames of the demo's recording in which nothing moves but noise."""
SWING = range(20, 25)
"""Frames in which its camera swings out; on the way back it passes the same poses."""
FRAME_NS = 10**9 // 15

DRAG_STEPS = 24
DRAG_RADIUS_M = 0.03
LAMP_FACTORS = (1.0, 0.7, 0.4, 0.1, 0.0, 0.3, 0.6, 0.9)
"""Of a light's strength, frame by frame."""

ARM_STEPS = 24
ARM_REACH = (0.1, 0.6)
"""Least and greatest reach, as a fraction of the picture's width."""
ARM_RADIUS = 0.06
"""Fraction of the picture's height."""
ARM_DEPTH_M = (0.34, 0.42)
"""Where it enters and at its tip: nearer than everything in the demo's room."""
ARM_RADIUS_M = 0.04
SKIN = (205, 150, 120)
"""R G B, camera-coded, where it faces the camera."""


@dataclass(frozen=True, eq=False)
class Step:
    """One frame, and the scene that it is rendered with."""

    frame: ViewFrame
    scene: SceneDocument


@dataclass(frozen=True, eq=False)
class Take:
    """Frames ready to be rendered: `standing` ones differ by noise, of the `swing` each has a pose of its own."""

    standing: Sequence[ViewFrame]
    swing: Sequence[ViewFrame]

    def at(self, size: tuple[int, int] | None) -> "Take":
        """Returns the frames as a camera of that size (width, height) takes them; None: as they are.

        So no frame is resized while it is timed.
        """
        if size is None or size == self.standing[0].color.shape[1::-1]:
            return self
        standing, swing = (
            [resized_frame(each, *size) for each in part] for part in (self.standing, self.swing)
        )
        return Take(standing, swing)


def prepare_take(progress: Progress) -> Take:
    """Reads the demo's recording and cleans its depth; the poses are those of the marker board.

    Raises:
        DeltalightError: the recording is missing.
    """
    source = open_source(RECORDING)
    builder = ViewFrameBuilder(source)
    numbers = progress.track([*STANDING, *SWING], description="preparing frames")
    views = [builder(source[number]) for number in numbers]
    return Take(views[: len(STANDING)], views[len(STANDING) :])


def parse_motions(text: str) -> list[str]:
    """Parses names of MOTIONS, separated by commas.

    Raises:
        DeltalightError: an unknown name, or one that is written twice.
    """
    names = [name.strip() for name in text.split(",")]
    for name in names:
        if name not in MOTIONS:
            close = nearest(name, MOTIONS)
            hint = "" if close is None else f"; the nearest is {close}"
            raise DeltalightError(f"'{name}' is not a motion{hint}; use {', '.join(MOTIONS)}.")
    if len(set(names)) < len(names):
        raise DeltalightError(f"--motions '{text}' names one thing twice; write each once.")
    return names


def steps_of(motion: str, take: Take, scene: SceneDocument, frames: int | None = None) -> Iterator[Step]:
    """Yields that many frames of a motion, None: without end; each is a new object with a capture time of its own."""
    for number, step in enumerate(islice(MOTIONS[motion](take, scene), frames)):
        frame = replace(step.frame, frame_id=number, timestamp_ns=(number + 1) * FRAME_NS)
        yield Step(frame, step.scene)


def camera_swings(take: Take, scene: SceneDocument) -> Iterator[Step]:
    """The camera goes to and fro; no two frames after another have the same pose."""
    there_and_back = [*take.swing, *take.swing[-2:0:-1]]
    return (Step(frame, scene) for frame in cycle(there_and_back))


def object_is_dragged(take: Take, scene: SceneDocument) -> Iterator[Step]:
    """The first object goes round a small circle."""
    first, *others = scene.objects
    for number, frame in zip(count(), cycle(take.standing)):
        moved = _dragged(first, 2 * math.pi * (number % DRAG_STEPS) / DRAG_STEPS)
        yield Step(frame, scene.model_copy(update={"objects": (moved, *others)}))


def _dragged(item: SceneObject, angle: float) -> SceneObject:
    x, y, z = item.pose.translation_m
    place = (x + DRAG_RADIUS_M * math.cos(angle), y + DRAG_RADIUS_M * math.sin(angle), z)
    return item.replaced(pose=item.pose.replaced(translation_m=place))


def arm_reaches(take: Take, scene: SceneDocument) -> Iterator[Step]:
    """An arm comes in from the right and goes back, in colour and depth."""
    standing = [take.standing[step % len(take.standing)] for step in range(ARM_STEPS)]
    painted = [with_arm(frame, _reach(step)) for step, frame in enumerate(standing)]
    return (Step(frame, scene) for frame in cycle(painted))


def _reach(step: int) -> float:
    """Returns how far the arm reaches, as a fraction of the width: evenly out and back."""
    out = 1 - abs(2 * step / ARM_STEPS - 1)
    least, greatest = ARM_REACH
    return least + (greatest - least) * out


def with_arm(frame: ViewFrame, reach: float) -> ViewFrame:
    """Paints a slanted capsule into a frame's colour and depth; `reach` is a fraction of the picture's width."""
    assert frame.depth is not None
    height, width = frame.color.shape[:2]
    entry = np.array([width, 0.9 * height])
    tip = entry - reach * width * np.array([1.0, 0.4])
    along, beside = _on_capsule(entry, tip, ARM_RADIUS * height, (height, width))
    bulge = np.sqrt(np.maximum(1 - beside**2, 0))
    depth_m = np.interp(along, (0, 1), ARM_DEPTH_M) - ARM_RADIUS_M * bulge
    inside = beside < 1
    color, seen = frame.color.copy(), frame.depth
    color[inside] = (np.array(SKIN) * (0.4 + 0.6 * bulge[inside, None])).astype(np.uint8)
    measured = np.where(inside, depth_m, seen.depth_m).astype(np.float32)
    return replace(frame, color=color, depth=replace(seen, depth_m=measured, valid=seen.valid | inside))


def _on_capsule(
    entry: Float64[np.ndarray, "2"], tip: Float64[np.ndarray, "2"], radius_px: float, shape: tuple[int, int]
) -> tuple[Float64[np.ndarray, "h w"], Float64[np.ndarray, "h w"]]:
    """Returns for each pixel its place along the axis (0 entry, 1 tip), and its distance from it in radii."""
    y, x = np.mgrid[: shape[0], : shape[1]].astype(np.float64)
    axis = tip - entry
    along = ((x - entry[0]) * axis[0] + (y - entry[1]) * axis[1]) / (axis @ axis)
    along = np.clip(along, 0, 1)
    return along, np.hypot(x - entry[0] - along * axis[0], y - entry[1] - along * axis[1]) / radius_px


def lamp_is_dimmed(take: Take, scene: SceneDocument) -> Iterator[Step]:
    """The first light that the scene declares is dimmed, off and on again."""
    first, *others = scene.lights.manual
    for frame, factor in zip(cycle(take.standing), cycle(LAMP_FACTORS)):
        lights = scene.lights.replaced(manual=[_dimmed(first, factor), *others])
        yield Step(frame, scene.model_copy(update={"lights": lights}))


def _dimmed(light: ManualLight, factor: float) -> ManualLight:
    fields = type(light).model_fields
    strength = next(name for name in ("intensity", "irradiance", "radiance") if name in fields)
    return light.replaced(**{strength: factor * getattr(light, strength)})


def nothing_moves(take: Take, scene: SceneDocument) -> Iterator[Step]:
    """Frames that differ by noise alone."""
    return (Step(frame, scene) for frame in cycle(take.standing))


MOTIONS: Mapping[str, Callable[[Take, SceneDocument], Iterator[Step]]] = {
    "camera": camera_swings,
    "object": object_is_dragged,
    "arm": arm_reaches,
    "lamps": lamp_is_dimmed,
    "still": nothing_moves,
}
