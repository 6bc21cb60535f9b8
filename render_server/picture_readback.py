"""Pictures of relit frames: started on the GPU, and read back in the order in which they were started."""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, Float64, UInt8

from deltalight.protocol.frames import ViewFrame
from deltalight.protocol.scene_fields import ShownView
from deltalight.protocol.scene_output import Output
from deltalight.render_server.camera_frames import FrameSource
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.textures import AsyncReadback
from deltalight.render_server.live_scene import LiveScene
from deltalight.render_server.passes.composite import Composite, Picture
from deltalight.render_server.picking import raster_texels
from deltalight.render_server.post_effects.bloom import with_bloom
from deltalight.render_server.post_effects.camera_artifacts import FrameArtifacts
from deltalight.render_server.relit_frame import RelitFrame
from deltalight.render_server.view import CameraView


@dataclass(frozen=True, eq=False)
class StartedView:
    """A picture of one view that was started on the GPU, or is the camera's own.

    `take` returns the picture, and `take_linear`, which follows it, its linear radiance (None if nobody asked for
    it). Both wait for the GPU if the picture was `composed` there. `camera_view` is as
    `FrameSource.camera_view_in` returns it.
    """

    view: ShownView
    camera_view: CameraView | None
    take: Callable[[], UInt8[np.ndarray, "h w 3"]]
    composed: RelitFrame | None
    take_linear: Callable[[], Float32[np.ndarray, "h w 3"]] | None = None

    @property
    def world_from_camera(self) -> Float64[np.ndarray, "4 4"] | None:
        """The pose that the picture was made with; None if there is none, or it is not the camera's."""
        return None if self.camera_view is None else self.camera_view.world_from_camera


class PictureReadback:
    """A queue of pictures on their way from the GPU: take them in the order in which they were started."""

    def __init__(self, gpu: GpuContext) -> None:
        self._queue = AsyncReadback(gpu)

    def start(
        self, source: FrameSource, output: Output, live: LiveScene, *, with_linear: bool
    ) -> StartedView:
        """Starts the picture of the document's own view, and its linear radiance if `with_linear`."""
        relit, view = source.relit, output.view
        if relit is None or (view == "lights" and source.is_lit):
            return self.start_other(source, view, output, live)
        composite = relit.compose(with_linear=with_linear or output.has_bloom)
        take_linear = None
        with live.timers.measure("readback"):
            take = self._begin(source, relit, view, output, composite)
            if isinstance(composite, Composite) and with_linear:
                self._queue.push(composite.linear, "f2")
                take_linear = self._take_linear
        return StartedView(view, source.camera_view_in(view), take, relit, take_linear)

    def start_other(
        self, source: FrameSource, view: ShownView, output: Output, live: LiveScene
    ) -> StartedView:
        """Starts the frame in a view that was requested beside the document's own."""
        frame, relit, camera_view = source.frame, source.relit, source.camera_view_in(view)
        if view == "lights" and source.is_lit:
            lights = live.lighting.picture(frame)
            return StartedView(view, camera_view, lambda: lights, None)
        if view == "camera" or relit is None:
            return StartedView(view, camera_view, lambda: frame.color, None)
        composite = relit.compose_view(view)
        with live.timers.measure("readback"):
            take = self._begin(source, relit, view, output, composite)
        return StartedView(view, camera_view, take, relit)

    def _begin(
        self, source: FrameSource, relit: RelitFrame, view: ShownView, output: Output, composite: Picture
    ) -> Callable[[], UInt8[np.ndarray, "h w 3"]]:
        """Begins to read a picture, and what bloom and camera artifacts need; returns what takes it with both."""
        frame = source.frame
        artifacts = _artifacts_of(source, relit, view, output)
        self._queue.push(composite.code, "u1")
        blooms = output.has_bloom and view == "composite" and isinstance(composite, Composite)
        if isinstance(composite, Composite) and blooms:
            self._queue.push(composite.linear, "f2")
        if artifacts is None and not blooms:
            return lambda: self._take_color(frame)
        shown, texels = relit.shown(), None
        self._queue.push(shown.object_coverage, shown.object_coverage.dtype)
        if artifacts is not None and artifacts.distance_blur is not None:
            self._queue.push(shown.object_buffer.position, "f4")
            texels = raster_texels(shown.view)[::-1]

        def take() -> UInt8[np.ndarray, "h w 3"]:
            color = self._take_color(frame)
            radiance = self._take_linear() if blooms else None
            coverage = self._queue.pop()[..., 0].astype(np.float32)
            depth_m = None if texels is None else self._queue.pop()[..., 3][texels]
            if radiance is not None:
                color = with_bloom(color, radiance, coverage, frame, output.bloom, tone=output.tone)
            return color if artifacts is None else artifacts.applied(color, coverage, depth_m)

        return take

    def _take_color(self, frame: ViewFrame) -> UInt8[np.ndarray, "h w 3"]:
        """Returns the oldest picture in the queue, at the frame's size."""
        color = cv2.cvtColor(self._queue.pop(), cv2.COLOR_RGBA2RGB)
        size = frame.camera.width, frame.camera.height
        return np.asarray(color if color.shape[1::-1] == size else cv2.resize(color, size))

    def _take_linear(self) -> Float32[np.ndarray, "h w 3"]:
        """Returns the oldest picture in the queue, which is in camera units."""
        linear: Float32[np.ndarray, "h w 3"] = self._queue.pop()[..., :3].astype(np.float32)
        return linear

    def release(self) -> None:
        """Frees the GL objects."""
        self._queue.release()


def _artifacts_of(
    source: FrameSource, relit: RelitFrame, view: ShownView, output: Output
) -> FrameArtifacts | None:
    """Updates the estimate of the camera's artifacts; returns those that the scene asks to put on objects."""
    frame = source.frame
    if not output.camera_artifacts or view != "composite":
        return None
    shown = relit.shown()
    if shown.object_coverage.size != frame.color.shape[1::-1]:
        return None
    low, high = shown.objects.bounds
    found = source.camera.artifacts.observe(frame, shown.view.world_from_camera, (low + high) / 2)
    return found.under(output.tone)
