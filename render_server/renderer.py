"""SceneRenderer: (frame, scene) -> composite. GPU only.

No sockets, no files except the scene's assets.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32, Float64, UInt8

from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import ViewFrame
from deltalight.protocol.scene import SceneDocument
from deltalight.render_server.frame_budget import Level
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.textures import AsyncReadback, read_texture
from deltalight.render_server.graph import Graph
from deltalight.render_server.live_scene import LiveScene, RelitFrame
from deltalight.render_server.passes.composite import Composite
from deltalight.render_server.picking import SHOWN_FRACTION, Pick, ShownFrame, raster_texels
from deltalight.render_server.view import CameraView, output_size, resized_frame


@dataclass(frozen=True, eq=False)
class CompositeFrame:
    """The finished picture of one frame.

    `color` is camera-coded, `linear` the same in camera units (before the response). `lights` are plain
    values. `camera` and `world_from_camera` are those that the picture was rendered with: while nothing
    moves, the pose stays that of the frame that the real scene was built from. It is None if the frame has
    none, or if the picture is not the camera's.
    """

    frame_id: int
    timestamp_ns: int
    color: UInt8[np.ndarray, "h w 3"]
    linear: Float32[np.ndarray, "h w 3"] | None
    status: str
    camera: CameraModel
    world_from_camera: Float64[np.ndarray, "4 4"] | None
    pass_times_ms: dict[str, float] = field(default_factory=dict)
    lights: list[dict[str, Any]] = field(default_factory=list)
    level: Level | None = None


@dataclass(frozen=True, eq=False)
class PictureLayers:
    """What a picture is composed of.

    `coverage` (0..1) is the share of a pixel that virtual objects cover, `radiance` theirs (camera units), not yet
    times the coverage. `depth_m` is along the optical axis: of the object where it covers half of the pixel or more,
    else of the real surface; 0 where it is unknown.
    """

    coverage: Float32[np.ndarray, "h w"]
    radiance: Float32[np.ndarray, "h w 3"]
    depth_m: Float32[np.ndarray, "h w"]


@dataclass(frozen=True)
class PendingComposite:
    """A frame in flight on the GPU. Frames finish in the order in which they were started.

    `immediate`: starting another frame first gains nothing (software renders synchronously).
    """

    finish: Callable[[], CompositeFrame]
    immediate: bool


class SceneRenderer:
    """Renders frames of one scene on one GPU context.

    `with_linear`: composites carry the linear picture too (for files). `notices` collects sentences that a user
    should read (registration, memory), each once. `waits`: the first picture waits for what a method precomputes of
    objects; pictures after `set_scene` never do. `checks` is `Graph`'s. `with_linear` leaves the document's budget
    aside.
    """

    def __init__(
        self,
        gpu: GpuContext,
        scene: SceneDocument,
        *,
        with_linear: bool = False,
        waits: bool = True,
        checks: bool = False,
    ) -> None:
        self._gpu = gpu
        self.notices: list[str] = []
        self._live = LiveScene(gpu, scene, self.notices, waits=waits, is_paced=not with_linear, checks=checks)
        self._readback = AsyncReadback(gpu)
        self._with_linear = with_linear
        self._sized: tuple[ViewFrame, ViewFrame] | None = None
        self._shown: ShownFrame | None = None
        self._relit: RelitFrame | None = None
        self.scene = scene

    def set_scene(self, scene: SceneDocument) -> None:
        """Switches to another scene from the next frame on; keeps the old one on error.

        Raises:
            DeltalightError: an asset of the scene cannot be read, or the scene exceeds its memory budget.
        """
        self._live.set_scene(scene)
        self.scene = scene

    def forget_frames(self) -> None:
        """Forgets everything seen in earlier frames, because the next ones come from another source."""
        self._shown = self._sized = None
        self._live.forget_frames()

    def render(self, frame: ViewFrame, *, with_linear: bool = False) -> CompositeFrame:
        """Renders one frame; without a pose or visible object, returns the camera's picture byte for byte."""
        return self.submit(frame, with_linear=with_linear).finish()

    def submit(self, frame: ViewFrame, *, with_linear: bool = False, whole: bool = False) -> PendingComposite:
        """Starts a frame on the GPU; reading its picture back does not stall later frames.

        `whole`: at full size whatever the budget, as `with_linear` always is.
        """
        started_s = time.perf_counter()
        frame, self._shown, self._relit = self.sized(frame), None, None
        if frame.pose is None:
            self._shown = ShownFrame(frame, None, None)
            return _at_once(self._shown, frame.color)
        view = CameraView(frame.camera, frame.pose.world_from_camera)
        relit = self._relit = self._live.relight(frame, view, whole=whole or with_linear)
        lights = self._live.describe_lights()
        name = self.scene.output.view
        shows_lights = name == "lights" and bool(lights)
        is_cameras = frame.radiance_map is None if shows_lights else relit is None or name != "rsm"
        buffers = None if relit is None else relit.shown()
        seen = view if buffers is None else buffers.view
        shown = ShownFrame(frame, seen if is_cameras else None, buffers, self._live.model)
        self._shown = shown
        if shows_lights:
            times = {} if relit is None else dict(self._live.timers.end_frame())
            return _at_once(shown, self._live.lighting.picture(frame), times, lights)
        if relit is None:
            return _at_once(shown, frame.color)
        return self._composed(
            shown, relit, lights, with_linear=with_linear or self._with_linear, started_s=started_s
        )

    @property
    def graph(self) -> Graph | None:
        """The graph of the newest frame with its results (`graph["cones"].mu`); None before the first."""
        return None if self._live.graph is None else self._live.graph.graph

    def sized(self, frame: ViewFrame) -> ViewFrame:
        """Returns the frame at the composite's size; the same object for the same frame."""
        size = output_size(frame, self.scene.output)
        if size == (frame.camera.width, frame.camera.height):
            return frame
        if self._sized is not None and self._sized[0] is frame:
            camera = self._sized[1].camera
            if (camera.width, camera.height) == size:
                return self._sized[1]
        self._sized = frame, resized_frame(frame, *size)
        return self._sized[1]

    def pick(self, x: float, y: float, ignore: str | None = None) -> Pick:
        """Picks what the newest picture shows at a pixel, looking through the object `ignore`.

        Raises:
            DeltalightError: there is no picture yet, it has no pose, or the pixel lies outside.
        """
        if self._shown is None:
            raise DeltalightError("Nothing was rendered yet; ask again when there is a picture.")
        return self._shown.pick(x, y, ignore)

    def layers(self) -> PictureLayers:
        """Reads back the layers of the newest picture, which is the camera's and at full size.

        Raises:
            DeltalightError: nothing was rendered yet.
        """
        if self._shown is None:
            raise DeltalightError("Nothing was rendered yet; render a frame first.")
        frame = self._shown.frame
        if self._relit is None:
            nothing = np.zeros(frame.color.shape, np.float32)
            depth_m = nothing[..., 0] if frame.depth is None else frame.depth.depth_m * frame.depth.valid
            return PictureLayers(nothing[..., 0], nothing, depth_m.astype(np.float32))
        shown = self._relit.shown()
        coverage = read_texture(shown.object_coverage)[..., 0]
        radiance = np.where(coverage[..., None] > 0, self._relit.radiance(), 0)
        column, row = raster_texels(shown.view)
        of_objects = read_texture(shown.object_buffer.position)[row, column, 3]
        real = read_texture(shown.real_surface.position)[..., 3]
        depth_m = np.where(coverage >= SHOWN_FRACTION, of_objects, np.maximum(real, 0))
        return PictureLayers(*(values.astype(np.float32) for values in (coverage, radiance, depth_m)))

    def _composed(
        self,
        shown: ShownFrame,
        relit: RelitFrame,
        lights: list[dict[str, Any]],
        *,
        with_linear: bool,
        started_s: float,
    ) -> PendingComposite:
        composite, timers = relit.compose(with_linear=with_linear), self._live.timers
        with timers.measure("readback"):
            self._readback.push(composite.code, "u1")
            if isinstance(composite, Composite) and with_linear:
                self._readback.push(composite.linear, "f2")
        times, frame, pose = dict(timers.end_frame()), shown.frame, shown.world_from_camera
        submitted_ms = 1e3 * (time.perf_counter() - started_s)

        def finish() -> CompositeFrame:
            color = cv2.cvtColor(self._readback.pop(), cv2.COLOR_RGBA2RGB)
            linear = self._readback.pop()[..., :3].astype(np.float32) if with_linear else None
            self._live.account(relit, max(submitted_ms, sum(times.values())))
            return CompositeFrame(
                frame.frame_id,
                frame.timestamp_ns,
                color,
                linear,
                "ok",
                frame.camera,
                pose,
                times,
                lights,
                relit.level,
            )

        return PendingComposite(finish, self._gpu.is_software)

    def release(self) -> None:
        """Frees all GL objects."""
        self._live.release()
        self._readback.release()


def _at_once(
    shown: ShownFrame,
    color: UInt8[np.ndarray, "h w 3"],
    times: dict[str, float] | None = None,
    lights: list[dict[str, Any]] | None = None,
) -> PendingComposite:
    """Wraps a picture made without the GPU: the camera's own, or the view of the lights."""
    frame = shown.frame
    status = "no_pose" if frame.pose is None else "ok"
    pose = shown.world_from_camera
    composite = CompositeFrame(
        frame.frame_id, frame.timestamp_ns, color, None, status, frame.camera, pose, times or {}, lights or []
    )
    return PendingComposite(lambda: composite, immediate=True)
