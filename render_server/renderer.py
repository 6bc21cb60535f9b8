"""SceneRenderer: (frame, scene) -> composite. GPU only.

No sockets, no files except the scene's assets.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32, Float64, UInt8

from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import ViewFrame
from deltalight.protocol.scene import SceneDocument
from deltalight.protocol.scene_fields import ShownView, View
from deltalight.render_server.frame_budget import HeldLevels, Level
from deltalight.render_server.gpu.context import GpuContext, GpuMemoryError
from deltalight.render_server.gpu.textures import AsyncReadback, read_texture
from deltalight.render_server.graph import Graph
from deltalight.render_server.live_scene import LiveScene, RelitFrame
from deltalight.render_server.passes.composite import Composite, Picture
from deltalight.render_server.picking import SHOWN_FRACTION, Pick, raster_texels
from deltalight.render_server.post_effects.bloom import bloomed
from deltalight.render_server.post_effects.camera_artifacts import FrameArtifacts
from deltalight.render_server.room_mesh import RoomMesh, room_mesh
from deltalight.render_server.scene.depth_mesh import depth_mesh
from deltalight.render_server.started_frame import (
    CameraFrame,
    CameraState,
    FrameSource,
    PassTimes,
    StartedView,
)
from deltalight.render_server.view import CameraView, PosedFrame, output_size, resized_frame

MEMORY_RETRY_S = 10.0  # after which a scene is built anew that the GPU had no memory for


@dataclass(frozen=True, eq=False)
class OtherView:
    """A frame in another view, at the composite's size; a pose of None: it is not the camera's picture."""

    view: ShownView
    color: UInt8[np.ndarray, "h w 3"]
    world_from_camera: Float64[np.ndarray, "4 4"] | None


@dataclass(frozen=True, eq=False)
class CompositeFrame:
    """The finished picture of one frame.

    `color` is camera-coded, `linear` the same in camera units (before the response). `lights` are plain
    values. `camera` and `world_from_camera` are those that the picture was rendered with: while nothing
    moves, the pose stays that of the frame that the real scene was built from. It is None if the frame has
    none, or if the picture is not the camera's. `reused_pass_times_ms` are those of passes whose results it uses
    again, when they last ran. `others` is the frame in the other views that were requested.
    """

    frame_id: int
    timestamp_ns: int
    color: UInt8[np.ndarray, "h w 3"]
    linear: Float32[np.ndarray, "h w 3"] | None
    status: str
    camera: CameraModel
    world_from_camera: Float64[np.ndarray, "4 4"] | None
    pass_times_ms: dict[str, float] = field(default_factory=dict)
    reused_pass_times_ms: dict[str, float] = field(default_factory=dict)
    lights: list[dict[str, Any]] = field(default_factory=list)
    level: Level | None = None
    others: tuple[OtherView, ...] = ()


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
    should read (registration, memory, errors of OpenGL), each once. `waits`: the first picture waits for what a
    method precomputes of objects (pictures after `set_scene` never do), and for the search for light out of
    sight. `checks` is `Graph`'s. `with_linear` leaves the document's budget aside; others begin at the `held`
    level. Where the GPU's memory is full, frames are refused; what the scene holds is made anew from time to
    time, and with the next scene.
    """

    def __init__(
        self,
        gpu: GpuContext,
        scene: SceneDocument,
        *,
        with_linear: bool = False,
        waits: bool = True,
        checks: bool = False,
        held: HeldLevels | None = None,
    ) -> None:
        self._gpu = gpu
        self.notices: list[str] = []
        self._with_linear = with_linear
        self._build = partial(
            LiveScene, gpu, notices=self.notices, is_paced=not with_linear, checks=checks, held=held
        )
        self._live = self._build(scene, waits=waits)
        self._full: tuple[GpuMemoryError, float] | None = None  # and when to try again
        self._readback = AsyncReadback(gpu)
        self._cameras: dict[str, CameraState] = {}
        self._newest: tuple[CameraState, ...] = ()  # the cameras of the newest pictures, in their order
        self.scene = scene

    def set_scene(self, scene: SceneDocument) -> None:
        """Switches to another scene from the next frame on; keeps the old one on error.

        Raises:
            DeltalightError: an asset of the scene cannot be read, or the scene exceeds its memory budget.
        """
        self._live.set_scene(scene)
        self.scene = scene
        if self._full is not None:
            self._full = self._full[0], 0.0

    def forget_frames(self) -> None:
        """Forgets everything seen in earlier frames, because the next ones come from another source."""
        self._cameras, self._newest = {}, ()
        self._live.forget_frames()

    def render(self, frame: ViewFrame, *, with_linear: bool = False) -> CompositeFrame:
        """Renders one frame; without a pose or visible object, returns the camera's picture byte for byte."""
        return self.submit(frame, with_linear=with_linear).finish()

    def render_views(self, frames: Sequence[ViewFrame], *, with_linear: bool = False) -> list[CompositeFrame]:
        """Renders a frame of each of several cameras in one room, taken at one moment (`submit_views`)."""
        return [each.finish() for each in self.submit_views(frames, with_linear=with_linear)]

    def submit(
        self,
        frame: ViewFrame,
        *,
        with_linear: bool = False,
        whole: bool = False,
        others: Sequence[ShownView] = (),
    ) -> PendingComposite:
        """Starts a frame on the GPU; reading its picture back does not stall later frames.

        `whole`: at full size whatever the budget, as `with_linear` always is. `others`: views in which the frame is
        rendered beside the document's own.

        Raises:
            DeltalightError: the frame or the scene cannot be rendered, or the GPU's memory is full.
            GpuResetError: the GPU was reset; this process renders nothing any more. `finish` raises the same.
        """
        return self.submit_views([frame], with_linear=with_linear, whole=whole, others=others)[0]

    def submit_views(
        self,
        frames: Sequence[ViewFrame],
        *,
        with_linear: bool = False,
        whole: bool = False,
        others: Sequence[ShownView] = (),
    ) -> list[PendingComposite]:
        """Starts a frame of each camera in one room, taken at one moment (`submit_cameras`).

        Give them in the same order each time: each is compared with its own earlier frames.
        """
        if not frames:
            raise DeltalightError("No frames were given; give one of each camera.")
        if len(frames) != len(self._cameras):
            self._cameras = {}
        return self.submit_cameras(
            CameraFrame.numbered(frames), with_linear=with_linear, whole=whole, others=others
        )

    def submit_cameras(
        self,
        taken: Sequence[CameraFrame],
        *,
        with_linear: bool = False,
        whole: bool = False,
        others: Sequence[ShownView] = (),
    ) -> list[PendingComposite]:
        """Starts the pictures of frames that cameras in one room took at one moment; otherwise as `submit`.

        The cameras share one real scene and its light, so what one of them sees lights what the others show. Where a
        camera has lost its pose, its picture stays as it is, and the room holds what it saw before; of one that is
        left out, it holds nothing. The first camera counts for animations, boards on objects, and estimates of light.
        Times are those of all pictures together.
        """
        self._find_faults()
        started_s = time.perf_counter()
        with_linear = with_linear or self._with_linear
        self._begin(taken)
        sized = [self._resized(camera, each.frame) for camera, each in zip(self._newest, taken, strict=True)]
        all_sources = self._sources(sized, whole=whole or with_linear or self.scene.output.has_bloom)
        sources = [source for source, each in zip(all_sources, taken, strict=True) if each.is_shown]
        started = [self._start_all(source, others, with_linear=with_linear) for source in sources]
        for source in all_sources:
            source.note_shown((self.scene.output.view, *others), self._live.model)
        times = self._end_frame(sources)
        submitted_ms = 1e3 * (time.perf_counter() - started_s)

        def finish(source: FrameSource, views: Sequence[StartedView], *, accounts: bool) -> CompositeFrame:
            main, *rest = views
            if accounts and main.composed is not None:
                self._live.account(main.composed, max(submitted_ms, sum(times.ran.values())))
            done = self._finished(source, main, rest, times, with_linear=with_linear)
            self._find_faults()
            return done

        is_immediate = all(each.composed is None for views in started for each in views)
        return [
            PendingComposite(
                partial(finish, source, views, accounts=source is sources[0]),
                is_immediate or self._gpu.is_software,
            )
            for source, views in zip(sources, started, strict=True)
        ]

    def _begin(self, taken: Sequence[CameraFrame]) -> None:
        """Provides for these cameras; the others keep their places, and nothing that they saw."""
        self._newest = tuple(self._cameras.setdefault(each.camera, CameraState()) for each in taken)
        for camera in self._cameras.values():
            if camera not in self._newest:
                camera.posed = camera.sized = None

    def _start_all(
        self, source: FrameSource, others: Sequence[ShownView], *, with_linear: bool
    ) -> list[StartedView]:
        """Starts a frame in the document's view and the others."""
        main = self._start(source, self.scene.output.view, with_linear=with_linear)
        return [main, *(self._start_other(source, view) for view in others)]

    def _end_frame(self, sources: Sequence[FrameSource]) -> PassTimes:
        if self.graph is None or all(source.relit is None for source in sources):
            return PassTimes({}, {})
        ran = dict(self._live.timers.end_frame())
        return PassTimes(ran, self.graph.reused_times_ms(ran))

    def _find_faults(self) -> None:
        """Finds faults of the device since the last call; builds the scene anew where its memory was full.

        Raises:
            GpuResetError: the context is lost.
            GpuMemoryError: the memory is full, or was less than MEMORY_RETRY_S ago.
        """
        known = sum(self._gpu.errors.values())
        try:
            self._gpu.check()
        except GpuMemoryError as fault:
            self._full = fault, time.monotonic() + MEMORY_RETRY_S
            for camera in self._cameras.values():
                camera.forget_picture()
        if self._full is not None:
            self._rebuild(*self._full)
        if sum(self._gpu.errors.values()) > known:
            sentence = (
                f"OpenGL reports {', '.join(self._gpu.errors)}, so pictures may be wrong: please report it."
            )
            if sentence not in self.notices:
                self.notices.append(sentence)

    def _rebuild(self, fault: GpuMemoryError, retry_s: float) -> None:
        if time.monotonic() < retry_s:
            raise fault
        self._live.release()
        self._live = self._build(self.scene, waits=False)
        self._full = None

    def _sources(self, frames: Sequence[ViewFrame], *, whole: bool) -> list[FrameSource]:
        """Relights the frames together; without a pose there is nothing but a camera's picture."""
        for camera in self._cameras.values():
            camera.forget_picture()
        for camera, frame in zip(self._newest, frames, strict=True):
            if frame.pose is not None:
                camera.posed = PosedFrame(frame, CameraView(frame.camera, frame.pose.world_from_camera))
        known = [camera for camera in self._newest if camera.posed is not None]
        if any(frame.pose is not None for frame in frames):
            relit = self._live.relight([each.posed for each in known if each.posed is not None], whole=whole)
            for camera, found in zip(known, relit, strict=False):
                camera.relit = found
        return [self._source(camera, frame) for camera, frame in zip(self._newest, frames, strict=True)]

    def _source(self, camera: CameraState, frame: ViewFrame) -> FrameSource:
        if frame.pose is None or camera.posed is None:
            camera.relit = None
            return FrameSource(camera, frame, None, None, None, [])
        buffers = None if camera.relit is None else camera.relit.shown()
        seen = camera.posed.view if buffers is None else buffers.view
        return FrameSource(camera, frame, camera.relit, buffers, seen, self._live.describe_lights())

    @property
    def graph(self) -> Graph | None:
        """The graph of the newest frame with its results (`graph["cones"].mu`); None before the first."""
        return None if self._live.graph is None else self._live.graph.graph

    def sized(self, frame: ViewFrame) -> ViewFrame:
        """Returns the frame at the composite's size; the same object for the same frame."""
        holders = (each for each in self._newest if each.holds(frame))
        return self._resized(next(holders, self._newest[0] if self._newest else CameraState()), frame)

    def _resized(self, camera: CameraState, frame: ViewFrame) -> ViewFrame:
        """Returns a camera's frame at the composite's size; the same object for the same frame."""
        size = output_size(frame, self.scene.output)
        if size == (frame.camera.width, frame.camera.height):
            return frame
        if camera.sized is not None and camera.holds(frame):
            known = camera.sized[1].camera
            if (known.width, known.height) == size:
                return camera.sized[1]
        camera.sized = frame, resized_frame(frame, *size)
        return camera.sized[1]

    def pick(self, x: float, y: float, ignore: str | None = None, camera: str | None = None) -> Pick:
        """Picks what a camera's newest picture shows at a pixel, looking through the object `ignore`.

        `camera`: None = the first one.

        Raises:
            DeltalightError: there is no picture of it, it has no pose, or the pixel lies outside.
        """
        first = self._newest[0] if self._newest else None
        state = first if camera is None else self._cameras.get(camera)
        if state is None or state.shown is None:
            raise DeltalightError("Nothing has been rendered yet; ask again when there is a picture.")
        return state.shown.pick(x, y, ignore)

    def room(self) -> RoomMesh:
        """Returns the real scene as last built, else of the newest frame's depth, with the newest picture on it.

        Raises:
            DeltalightError: there is no picture of a known pose, or no surface in it.
        """
        shown = self._newest[0].shown if self._newest else None
        if shown is None or shown.frame.pose is None:
            raise DeltalightError(
                "The camera's position is not known yet; ask again when the board is in view."
            )
        view = CameraView(shown.frame.camera, shown.frame.pose.world_from_camera)
        corners = self._live.room_corners
        if corners is None and shown.frame.depth is not None:
            mesh = depth_mesh(shown.frame.depth, view.camera, view.world_from_camera)
            corners = mesh.positions[mesh.triangles]
        if corners is None or not len(corners):
            raise DeltalightError("No surface of the room is known yet; ask again when depth shows some.")
        return room_mesh(corners, shown.frame, view)

    def layers(self, number: int = 0) -> PictureLayers:
        """Reads back the layers of a camera's newest picture, which is the camera's and at full size.

        Raises:
            DeltalightError: nothing was rendered yet.
        """
        camera = self._newest[number] if number < len(self._newest) else CameraState()
        if camera.shown is None:
            raise DeltalightError("Nothing has been rendered yet; render a frame first.")
        frame = camera.shown.frame
        if camera.relit is None:
            nothing = np.zeros(frame.color.shape, np.float32)
            depth_m = nothing[..., 0] if frame.depth is None else frame.depth.depth_m * frame.depth.valid
            return PictureLayers(nothing[..., 0], nothing, depth_m.astype(np.float32))
        shown = camera.relit.shown()
        coverage = read_texture(shown.object_coverage)[..., 0]
        radiance = np.where(coverage[..., None] > 0, camera.relit.radiance(), 0)
        column, row = raster_texels(shown.view)
        of_objects = read_texture(shown.object_buffer.position)[row, column, 3]
        real = read_texture(shown.real_surface.position)[..., 3]
        depth_m = np.where(coverage >= SHOWN_FRACTION, of_objects, np.maximum(real, 0))
        return PictureLayers(*(values.astype(np.float32) for values in (coverage, radiance, depth_m)))

    def _start(self, source: FrameSource, view: View, *, with_linear: bool) -> StartedView:
        """Starts the picture of the document's own view, and its linear radiance if `with_linear`."""
        relit = source.relit
        if relit is None or (view == "lights" and source.is_lit):
            return self._start_other(source, view)
        composite = relit.compose(with_linear=with_linear or self.scene.output.has_bloom)
        with self._live.timers.measure("readback"):
            take = self._begin_reading(source, relit, view, composite)
            if isinstance(composite, Composite) and with_linear:
                self._readback.push(composite.linear, "f2")
        return StartedView(view, source.seen_in(view), take, relit)

    def _start_other(self, source: FrameSource, view: ShownView) -> StartedView:
        """Starts the frame in a view that was asked for beside the document's own."""
        frame, relit, seen = source.frame, source.relit, source.seen_in(view)
        if view == "lights" and source.is_lit:
            lights = self._live.lighting.picture(frame)
            return StartedView(view, seen, lambda: lights, None)
        if view == "camera" or relit is None:
            return StartedView(view, seen, lambda: frame.color, None)
        composite = relit.compose_view(view)
        with self._live.timers.measure("readback"):
            take = self._begin_reading(source, relit, view, composite)
        return StartedView(view, seen, take, relit)

    def _begin_reading(
        self, source: FrameSource, relit: RelitFrame, view: ShownView, composite: Picture
    ) -> Callable[[], UInt8[np.ndarray, "h w 3"]]:
        """Begins to read a picture, and what the camera's artifacts on it need; returns what takes both."""
        frame, output = source.frame, self.scene.output
        artifacts = self._artifacts_of(source, relit, view)
        self._readback.push(composite.code, "u1")
        linear = None
        if output.has_bloom and view == "composite" and isinstance(composite, Composite):
            linear = composite.linear
            self._readback.push(linear, "f2")
        if artifacts is None and linear is None:
            return lambda: self._read(frame)
        shown, texels = relit.shown(), None
        self._readback.push(shown.object_coverage, shown.object_coverage.dtype)
        if artifacts is not None and artifacts.distance_blur is not None:
            self._readback.push(shown.object_buffer.position, "f4")
            texels = raster_texels(shown.view)[::-1]

        def take() -> UInt8[np.ndarray, "h w 3"]:
            color = self._read(frame)
            radiance = None if linear is None else self._readback.pop()[..., :3].astype(np.float32)
            coverage = self._readback.pop()[..., 0].astype(np.float32)
            depth_m = None if texels is None else self._readback.pop()[..., 3][texels]
            if radiance is not None:
                color = bloomed(color, radiance, coverage, frame, output.bloom, tone=output.tone)
            return color if artifacts is None else artifacts.applied(color, coverage, depth_m)

        return take

    def _finished(
        self,
        source: FrameSource,
        main: StartedView,
        rest: Sequence[StartedView],
        times: PassTimes,
        *,
        with_linear: bool,
    ) -> CompositeFrame:
        """Takes the pictures in the order in which they were started."""
        frame, color, linear = source.frame, main.take(), None
        if with_linear and main.composed is not None:
            linear = self._readback.pop()[..., :3].astype(np.float32)
        return CompositeFrame(
            frame.frame_id,
            frame.timestamp_ns,
            color,
            linear,
            "no_pose" if frame.pose is None else "ok",
            frame.camera,
            main.world_from_camera,
            times.ran,
            times.reused,
            source.lights,
            None if main.composed is None else main.composed.level,
            tuple(OtherView(each.view, each.take(), each.world_from_camera) for each in rest),
        )

    def _read(self, frame: ViewFrame) -> UInt8[np.ndarray, "h w 3"]:
        """Returns the oldest picture in flight, at the frame's size."""
        color = cv2.cvtColor(self._readback.pop(), cv2.COLOR_RGBA2RGB)
        size = frame.camera.width, frame.camera.height
        return np.asarray(color if color.shape[1::-1] == size else cv2.resize(color, size))

    def _artifacts_of(self, source: FrameSource, relit: RelitFrame, view: ShownView) -> FrameArtifacts | None:
        """Learns from the camera's frame; returns what it puts on the objects if the scene asks for that."""
        frame, output = source.frame, self.scene.output
        if not output.camera_artifacts or view != "composite":
            return None
        shown = relit.shown()
        if shown.object_coverage.size != frame.color.shape[1::-1]:
            return None
        low, high = shown.objects.bounds
        found = source.camera.artifacts.observe(frame, shown.view.world_from_camera, (low + high) / 2)
        return found.under(output.tone)

    def release(self) -> None:
        """Frees all GL objects."""
        self._live.release()
        self._readback.release()
