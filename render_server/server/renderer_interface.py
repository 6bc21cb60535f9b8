"""The interface between session and renderer: `SceneRenderer` implements it, and so do fakes in tests."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.frames import ViewFrame
from deltalight.protocol.scene import SceneDocument
from deltalight.protocol.scene_fields import ShownView
from deltalight.render_server.camera_frames import CameraFrame
from deltalight.render_server.frame_budget import Level


class FinishedView(Protocol):
    """A frame in another view (`renderer.OtherView`)."""

    @property
    def view(self) -> ShownView:
        """What it shows."""

    @property
    def color(self) -> UInt8[np.ndarray, "h w 3"]:
        """The picture, of the composite's size."""

    @property
    def world_from_camera(self) -> Float64[np.ndarray, "4 4"] | None:
        """The camera's pose; None if the picture is not the camera's."""


class FinishedPicture(Protocol):
    """The result of a renderer (`renderer.CompositeFrame`)."""

    @property
    def color(self) -> UInt8[np.ndarray, "h w 3"]:
        """The finished picture, camera-coded RGB."""

    @property
    def status(self) -> str:
        """`ok` or `no_pose`."""

    @property
    def camera(self) -> CameraModel:
        """The camera at the picture's size."""

    @property
    def world_from_camera(self) -> Float64[np.ndarray, "4 4"] | None:
        """The camera's pose; None if there is none."""

    @property
    def pass_times_ms(self) -> dict[str, float]:
        """Milliseconds of each pass."""

    @property
    def reused_pass_times_ms(self) -> dict[str, float]:
        """Milliseconds that passes whose results it uses again took when they last ran."""

    @property
    def lights(self) -> Sequence[dict[str, Any]]:
        """The lights that the picture was rendered with."""

    @property
    def level(self) -> Level | None:
        """The quality and scale that it was rendered at; None if nothing was."""

    @property
    def linear(self) -> Float32[np.ndarray, "h w 3"] | None:
        """The picture before the camera's response, if requested."""

    @property
    def others(self) -> Sequence[FinishedView]:
        """The same frame in the other views that were requested."""


class Pick(Protocol):
    """What a pixel shows (`picking.Pick`)."""

    def as_dict(self) -> dict[str, object]:
        """Returns the pick as plain data."""


class Room(Protocol):
    """The real scene as a mesh (`room_mesh.RoomMesh`)."""

    def write(self, path: Path) -> None:
        """Writes it as a GLB file."""


class Pending(Protocol):
    """A started frame (`renderer.PendingComposite`)."""

    @property
    def immediate(self) -> bool:
        """Whether starting another frame first gains nothing."""

    @property
    def finish(self) -> Callable[[], FinishedPicture]:
        """Returns the composite; waits for the GPU if it must."""


class Renderer(Protocol):
    """The part of `renderer.SceneRenderer` that a session uses."""

    @property
    def notices(self) -> Sequence[str]:
        """Sentences for the user; the list only grows."""

    def submit_cameras(
        self,
        taken: Sequence[CameraFrame],
        *,
        with_linear: bool = False,
        full_size: bool = False,
        others: Sequence[ShownView] = (),
    ) -> Sequence[Pending]:
        """Starts the pictures of a room's frames that are to be shown, at full size if `full_size`, also in `others`.

        They finish in the order of their starts.
        """

    def sized(self, frame: ViewFrame) -> ViewFrame:
        """Returns the frame at the composite's size."""

    def pick(self, x: float, y: float, ignore: str | None = None, camera: str | None = None) -> Pick:
        """Picks what a camera's newest picture shows at a pixel, looking through the object `ignore`."""

    def room(self) -> Room:
        """Returns the real scene as the newest picture shows it."""

    def compile_ahead(self) -> None:
        """Compiles a program that the next motion will run, if there is one and everything is at rest."""

    def forget_frames(self) -> None:
        """Forgets what earlier frames showed."""

    def set_scene(self, scene: SceneDocument) -> None:
        """Switches to another scene from the next frame on."""
