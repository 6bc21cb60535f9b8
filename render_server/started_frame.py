"""What a renderer keeps of each camera, and its frames whose pictures are on their way from the GPU."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64, UInt8

from deltalight.protocol.frames import ViewFrame
from deltalight.protocol.scene_fields import ShownView
from deltalight.render_server.frame_graph import ShownBuffers
from deltalight.render_server.live_scene import RelitFrame
from deltalight.render_server.picking import ShownFrame
from deltalight.render_server.post_effects.camera_artifacts import CameraArtifacts
from deltalight.render_server.scene.triangle_mesh import TriangleMesh
from deltalight.render_server.view import CameraView, PosedFrame


class PassTimes(NamedTuple):
    """Milliseconds by pass: of those that the frame ran, and of the others when they last ran."""

    ran: dict[str, float]
    reused: dict[str, float]


@dataclass(frozen=True, eq=False)
class CameraFrame:
    """A frame of one of a room's cameras; without `is_shown` it lights the room, and no picture of it is made."""

    camera: str
    frame: ViewFrame
    is_shown: bool = True

    @classmethod
    def numbered(cls, frames: Sequence[ViewFrame]) -> "list[CameraFrame]":
        """Returns frames of cameras that have no names."""
        return [cls(str(number), frame) for number, frame in enumerate(frames)]


@dataclass(eq=False)
class CameraState:
    """What is kept of one camera: its artifacts, its last frame with a pose, at the composite's size, and its newest.

    `sized`: the newest frame as it came, and at the composite's size. `shown` and `relit` are of the newest picture.
    """

    artifacts: CameraArtifacts = field(default_factory=CameraArtifacts)
    posed: PosedFrame | None = None
    sized: tuple[ViewFrame, ViewFrame] | None = None
    shown: ShownFrame | None = None
    relit: RelitFrame | None = None

    def forget_picture(self) -> None:
        """Forgets the newest picture, whose buffers another one takes."""
        self.shown = self.relit = None

    def holds(self, frame: ViewFrame) -> bool:
        """Whether the newest frame that came is this one."""
        return self.sized is not None and self.sized[0] is frame


@dataclass(frozen=True, eq=False)
class FrameSource:
    """What all views of a frame are made from; `lights` are plain values."""

    camera: CameraState
    frame: ViewFrame
    relit: RelitFrame | None
    buffers: ShownBuffers | None
    seen: CameraView | None
    lights: list[dict[str, Any]]

    @property
    def is_lit(self) -> bool:
        """Whether there are lights to show."""
        return bool(self.lights)

    def note_shown(self, views: Sequence[ShownView], model: Sequence[TriangleMesh]) -> None:
        """Notes what the camera's newest pictures show; `model`: the real scene's meshes, if given."""
        seen = next((seen for seen in map(self.seen_in, views) if seen is not None), None)
        self.camera.shown = ShownFrame(self.frame, seen, self.buffers, model)

    def seen_in(self, view: ShownView) -> CameraView | None:
        """Returns the camera's view; None if the picture is not the camera's, or there is no pose."""
        if view == "lights" and self.is_lit:
            return self.seen if self.frame.radiance_map is None else None
        return None if view == "rsm" and self.relit is not None else self.seen


@dataclass(frozen=True, eq=False)
class StartedView:
    """A picture of one view; `take` returns it, and waits for the GPU if it was `composed` there."""

    view: ShownView
    seen: CameraView | None
    take: Callable[[], UInt8[np.ndarray, "h w 3"]]
    composed: RelitFrame | None

    @property
    def world_from_camera(self) -> Float64[np.ndarray, "4 4"] | None:
        """The pose that the picture was made with; None if there is none, or it is not the camera's."""
        return None if self.seen is None else self.seen.world_from_camera
