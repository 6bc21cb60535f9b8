"""Frames of the cameras in a room, and what a renderer keeps of each camera."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from deltalight.protocol.frames import ViewFrame
from deltalight.protocol.scene_fields import ShownView
from deltalight.render_server.frame_graph import ShownBuffers
from deltalight.render_server.picking import ShownFrame
from deltalight.render_server.post_effects.camera_artifacts import CameraArtifacts
from deltalight.render_server.relit_frame import RelitFrame
from deltalight.render_server.scene.triangle_mesh import TriangleMesh
from deltalight.render_server.view import CameraView, PosedFrame


class PassTimes(NamedTuple):
    """Milliseconds by pass: of passes that the frame `ran`, and of `reused` results, when their passes last ran."""

    ran: dict[str, float]
    reused: dict[str, float]


@dataclass(frozen=True, eq=False)
class CameraFrame:
    """A frame of the camera with that name. Without `is_shown` it only lights the room: nobody wants its picture."""

    camera: str
    frame: ViewFrame
    is_shown: bool = True

    @classmethod
    def numbered(cls, frames: Sequence[ViewFrame]) -> "list[CameraFrame]":
        """Returns frames of cameras that are named by their numbers."""
        return [cls(str(number), frame) for number, frame in enumerate(frames)]


@dataclass(eq=False)
class CameraState:
    """What a renderer keeps of one camera.

    Attributes:
        artifacts: estimate of the camera's noise, blur and the like.
        posed: the last frame that had a pose, at the composite's size.
        sized: the newest frame as it arrived, and the same at the composite's size.
        shown: what the newest picture shows, for picking.
        relit: the newest picture's frame, ready to compose again.
    """

    artifacts: CameraArtifacts = field(default_factory=CameraArtifacts)
    posed: PosedFrame | None = None
    sized: tuple[ViewFrame, ViewFrame] | None = None
    shown: ShownFrame | None = None
    relit: RelitFrame | None = None

    def forget_picture(self) -> None:
        """Forgets the newest picture, because the next one reuses its buffers."""
        self.shown = self.relit = None

    def holds(self, frame: ViewFrame) -> bool:
        """Whether this is the newest frame that arrived."""
        return self.sized is not None and self.sized[0] is frame


@dataclass(frozen=True, eq=False)
class FrameSource:
    """What all views of one frame are made from.

    `relit`, `buffers` (of `relit`) and `camera_view` are None without a pose, the first two also without
    anything to relight. `lights` are plain values.
    """

    camera: CameraState
    frame: ViewFrame
    relit: RelitFrame | None
    buffers: ShownBuffers | None
    camera_view: CameraView | None
    lights: list[dict[str, Any]]

    @property
    def is_lit(self) -> bool:
        """Whether there are lights to show."""
        return bool(self.lights)

    def note_shown(self, views: Sequence[ShownView], model: Sequence[TriangleMesh]) -> None:
        """Notes what the camera's newest pictures show; `model`: the real scene's meshes, if given."""
        shown = (each for each in map(self.camera_view_in, views) if each is not None)
        self.camera.shown = ShownFrame(self.frame, next(shown, None), self.buffers, model)

    def camera_view_in(self, view: ShownView) -> CameraView | None:
        """Returns the camera's view; None if the picture is not the camera's, or there is no pose."""
        if view == "lights" and self.is_lit:
            return self.camera_view if self.frame.radiance_map is None else None
        return None if view == "rsm" and self.relit is not None else self.camera_view
