"""SceneRenderer: (frame, scene) -> composite. GPU only: no sockets, no files but the scene's assets, no clock."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from protocol.frames import DepthImage, ViewFrame
from protocol.scene import SceneDocument
from protocol.scene_method import Output
from render_server.compose import Composer
from render_server.gpu.context import GpuContext
from render_server.relighting import Relighting
from render_server.view import CameraView


@dataclass(frozen=True, eq=False)
class CompositeFrame:
    """The finished picture of one frame.

    `color` is camera-coded, `linear` the same in camera units (before the response). `lights` are plain values.
    """

    frame_id: int
    timestamp_ns: int
    color: UInt8[np.ndarray, "h w 3"]
    linear: Float32[np.ndarray, "h w 3"] | None
    status: str
    pass_times_ms: dict[str, float] = field(default_factory=dict)
    lights: list[dict[str, Any]] = field(default_factory=list)


@dataclass(frozen=True)
class PendingComposite:
    """A frame that was handed to the GPU. Frames are finished in the order in which they were started.

    `immediate`: nothing is gained by starting another frame first (software renders at once).
    """

    finish: Callable[[], CompositeFrame]
    immediate: bool


class SceneRenderer:
    """Renders frames of one scene on one GPU context.

    `with_linear`: composites carry the linear picture too (for files). `notices` collects sentences that a user
    should read (registration, memory), each once.
    """

    def __init__(self, gpu: GpuContext, scene: SceneDocument, *, with_linear: bool = False) -> None:
        self._gpu = gpu
        self.notices: list[str] = []
        self._relighting = Relighting(gpu, scene, self.notices)
        self._composer = Composer(gpu, with_linear=with_linear)
        self.scene = scene

    def set_scene(self, scene: SceneDocument) -> None:
        """Use another scene from the next frame on; on an error the old one stays.

        Raises:
            DeltalightError: the scene needs an asset that cannot be read, or more memory than its budget.
        """
        self._relighting.set_scene(scene)
        self.scene = scene

    def render(self, frame: ViewFrame) -> CompositeFrame:
        """The composite of one frame; without pose or visible object it is the camera's picture, byte for byte."""
        return self.start(frame).finish()

    def start(self, frame: ViewFrame) -> PendingComposite:
        """Hand a frame to the GPU; reading its picture back does not stall the frames after it."""
        output = self.scene.output
        size = output_size(frame, output)
        if size != (frame.camera.width, frame.camera.height):
            frame = resized_frame(frame, *size)
        if frame.pose is None:
            return _untouched(frame, "no_pose")
        view = CameraView(frame.camera, frame.pose.world_from_camera)
        relit = self._relighting.relight(frame, view)
        lights = self._relighting.describe_lights()
        if output.view == "lights" and lights:
            times = {} if relit is None else dict(relit.timers.end_frame())
            return _at_once(frame, self._relighting.lighting.picture(frame), lights, times)
        if relit is None:
            return _untouched(frame, "ok")
        self._composer.start(relit, output)
        times = dict(relit.timers.end_frame())

        def finish() -> CompositeFrame:
            color, linear = self._composer.finish()
            return CompositeFrame(frame.frame_id, frame.timestamp_ns, color, linear, "ok", times, lights)

        return PendingComposite(finish, self._gpu.is_software)

    def release(self) -> None:
        """Free all GL objects."""
        self._relighting.release()
        self._composer.release()


def _at_once(
    frame: ViewFrame,
    color: UInt8[np.ndarray, "h w 3"],
    lights: list[dict[str, Any]],
    times: dict[str, float],
) -> PendingComposite:
    """A picture that the GPU had no part in."""
    composite = CompositeFrame(frame.frame_id, frame.timestamp_ns, color, None, "ok", times, lights)
    return PendingComposite(lambda: composite, immediate=True)


def _untouched(frame: ViewFrame, status: str) -> PendingComposite:
    """The camera's picture itself."""
    composite = CompositeFrame(frame.frame_id, frame.timestamp_ns, frame.color, None, status)
    return PendingComposite(lambda: composite, immediate=True)


def output_size(frame: ViewFrame, output: Output) -> tuple[int, int]:
    """Width and height of the composite; where the document gives one of them, the camera's proportions hold."""
    camera = frame.camera
    if output.width is None and output.height is None:
        return camera.width, camera.height
    width = output.width or round(camera.width * (output.height or 0) / camera.height)
    return width, output.height or round(camera.height * width / camera.width)


def resized_frame(frame: ViewFrame, width: int, height: int) -> ViewFrame:
    """The frame at another picture size: colour averaged over areas, depth taken from the nearest pixel."""
    size = (width, height)
    camera = frame.camera.resized(width, height)
    depth = frame.depth
    if depth is not None:
        depth = DepthImage(
            cv2.resize(depth.depth_m, size, interpolation=cv2.INTER_NEAREST),
            cv2.resize(depth.valid.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST).astype(bool),
            camera,
            depth.noise_sigma_m,
        )
    color = cv2.resize(frame.color, size, interpolation=cv2.INTER_AREA)
    return replace(frame, color=color, camera=camera, depth=depth)
