"""SceneRenderer renders camera frames of a scene document to pictures: the entry to the renderer.

It opens no sockets, and no files but the scene's assets. A frame goes through `submit_cameras`: `LiveScene.relight`
prepares it, and `PictureReadback` composes it and reads its picture back.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import ViewFrame
from deltalight.protocol.scene import SceneDocument
from deltalight.protocol.scene_fields import ShownView
from deltalight.render_server.camera_frames import CameraFrame, CameraState, FrameSource, PassTimes
from deltalight.render_server.frame_budget import HeldLevels, Level
from deltalight.render_server.gpu.context import GpuContext, GpuMemoryError
from deltalight.render_server.gpu.textures import read_texture
from deltalight.render_server.graph import Graph
from deltalight.render_server.live_scene import LiveScene
from deltalight.render_server.picking import SHOWN_FRACTION, Pick, raster_texels
from deltalight.render_server.picture_readback import PictureReadback, StartedView
from deltalight.render_server.room_mesh import RoomMesh, room_mesh
from deltalight.render_server.scene.depth_mesh import depth_mesh
from deltalight.render_server.view import CameraView, PosedFrame, output_size, resized_frame

MEMORY_RETRY_S = 10.0  # until a scene is rebuilt that the GPU had no memory for


@dataclass(frozen=True, eq=False)
class OtherView:
    """A frame in another view, at the composite's size. Without a pose it is not the camera's picture."""

    view: ShownView
    color: UInt8[np.ndarray, "h w 3"]
    world_from_camera: Float64[np.ndarray, "4 4"] | None


@dataclass(frozen=True, eq=False)
class CompositeFrame:
    """The finished picture of one frame.

    Attributes:
        color: the picture as the camera codes it.
        linear: the same in camera units, before the camera's response; None unless it was requested.
        status: `ok`, or `no_pose` if the frame has none.
        camera, world_from_camera: what the picture was rendered with. While nothing moves, the pose stays that of the
            frame that the real scene was built from. It is None if the frame has none, or if the picture is not the
            camera's.
        pass_times_ms: times of the passes that ran.
        reused_pass_times_ms: times of the passes whose results were used again, when they last ran.
        lights: plain values.
        level: quality and scale that it was rendered at; None if it is the camera's own picture.
        others: the frame in the other views that were requested.
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

    `coverage` (0..1) is the fraction of a pixel that virtual objects cover; `radiance` (camera units) is theirs, not
    premultiplied by it. `depth_m`, along the optical axis, is the object's where it covers half of the pixel or more,
    else the real surface's; 0 where it is unknown.
    """

    coverage: Float32[np.ndarray, "h w"]
    radiance: Float32[np.ndarray, "h w 3"]
    depth_m: Float32[np.ndarray, "h w"]


@dataclass(frozen=True)
class PendingComposite:
    """A frame in flight on the GPU. Frames must be finished in the order in which they were started.

    `immediate`: it is ready, so starting another frame first gains nothing (software renders synchronously).
    """

    finish: Callable[[], CompositeFrame]
    immediate: bool


class SceneRenderer:
    """Renders frames of one scene on one GPU context.

    Where the GPU's memory is full, frames are refused; every `MEMORY_RETRY_S`, and with the next scene, the renderer
    builds what the scene needs once more.

    Attributes:
        scene: the scene document.
        notices: sentences that a user should read (registration, memory, errors of OpenGL), each once.

    Args:
        gpu: the context to render with.
        scene: the first scene document.
        with_linear: composites carry the linear picture too (for files), and the document's frame budget is ignored.
        waits: the first picture waits until precomputation of objects and the search for unseen light are finished.
            Pictures after `set_scene` never wait for precomputation.
        checks: as for `Graph`.
        held: quality levels that held the frame budget before; rendering begins at them.
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
        self._out_of_memory: tuple[GpuMemoryError, float] | None = None  # and when to try again
        self._readback = PictureReadback(gpu)
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
        if self._out_of_memory is not None:
            self._out_of_memory = self._out_of_memory[0], 0.0

    def compile_ahead(self) -> None:
        """Compiles a program that the next motion will run, if there is one and everything is at rest."""
        if self._live.is_at_rest:
            self._gpu.precompile_queue.compile_next()

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
        full_size: bool = False,
        others: Sequence[ShownView] = (),
    ) -> PendingComposite:
        """Starts a frame on the GPU; reading its picture back does not stall later frames.

        `full_size`: at the output's size whatever the budget, as `with_linear` always is. `others`: views in which
        the frame is rendered beside the document's own.

        Raises:
            DeltalightError: the frame or the scene cannot be rendered, or the GPU's memory is full.
            GpuResetError: the GPU was reset; this process renders nothing any more. `finish` raises the same.
        """
        return self.submit_views([frame], with_linear=with_linear, full_size=full_size, others=others)[0]

    def submit_views(
        self,
        frames: Sequence[ViewFrame],
        *,
        with_linear: bool = False,
        full_size: bool = False,
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
            CameraFrame.numbered(frames), with_linear=with_linear, full_size=full_size, others=others
        )

    def submit_cameras(
        self,
        taken: Sequence[CameraFrame],
        *,
        with_linear: bool = False,
        full_size: bool = False,
        others: Sequence[ShownView] = (),
    ) -> list[PendingComposite]:
        """Starts the pictures of frames that cameras in one room took at one moment; otherwise as `submit`.

        The cameras share one real scene and its light, so what one of them sees lights what the others show. A camera
        without a pose shows its picture unchanged, and the real scene keeps what it saw before. A camera that is left
        out contributes nothing. Animations, boards on objects, and estimates of light follow the first camera. Times
        are those of all pictures together.
        """
        self._check_device()
        started_s = time.perf_counter()
        with_linear = with_linear or self._with_linear
        self._begin(taken)
        sized = [self._resized(camera, each.frame) for camera, each in zip(self._newest, taken, strict=True)]
        all_sources = self._sources(sized, full_size=full_size or with_linear or self.scene.output.has_bloom)
        sources = [source for source, each in zip(all_sources, taken, strict=True) if each.is_shown]
        started = [self._start_all(source, others, with_linear=with_linear) for source in sources]
        for source in all_sources:
            source.note_shown((self.scene.output.view, *others), self._live.model)
        times = self._end_frame(sources)
        submitted_ms = 1e3 * (time.perf_counter() - started_s)
        immediate = self._gpu.is_software or all(each.composed is None for views in started for each in views)
        return [
            PendingComposite(
                partial(self._finish, source, views, times, submitted_ms if source is sources[0] else None),
                immediate,
            )
            for source, views in zip(sources, started, strict=True)
        ]

    def _begin(self, taken: Sequence[CameraFrame]) -> None:
        """Makes these cameras the newest. Others keep their artifacts, but what they saw is forgotten."""
        self._newest = tuple(self._cameras.setdefault(each.camera, CameraState()) for each in taken)
        for camera in self._cameras.values():
            if camera not in self._newest:
                camera.posed = camera.sized = None

    def _start_all(
        self, source: FrameSource, others: Sequence[ShownView], *, with_linear: bool
    ) -> list[StartedView]:
        """Starts a frame in the document's view and the others."""
        output, readback = self.scene.output, self._readback
        main = readback.start(source, output, self._live, with_linear=with_linear)
        return [main, *(readback.start_other(source, view, output, self._live) for view in others)]

    def _end_frame(self, sources: Sequence[FrameSource]) -> PassTimes:
        ran = dict(self._live.timers.end_frame())  # what shows no surface was uploaded all the same
        if self.graph is None or all(source.relit is None for source in sources):
            return PassTimes({}, {})
        return PassTimes(ran, self.graph.reused_times_ms(ran))

    def _check_device(self) -> None:
        """Reports errors of OpenGL since the last call; rebuilds the scene after the GPU's memory was full.

        Raises:
            GpuResetError: the context is lost.
            GpuMemoryError: the memory is full, or was less than MEMORY_RETRY_S ago.
        """
        known = sum(self._gpu.errors.values())
        try:
            self._gpu.check()
        except GpuMemoryError as fault:
            self._out_of_memory = fault, time.monotonic() + MEMORY_RETRY_S
            for camera in self._cameras.values():
                camera.forget_picture()
        if self._out_of_memory is not None:
            self._rebuild(*self._out_of_memory)
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
        self._out_of_memory = None

    def _sources(self, frames: Sequence[ViewFrame], *, full_size: bool) -> list[FrameSource]:
        """Relights the frames together. Without a pose, all there is to show is the camera's picture."""
        for camera in self._cameras.values():
            camera.forget_picture()
        for camera, frame in zip(self._newest, frames, strict=True):
            if frame.pose is not None:
                camera.posed = PosedFrame(frame, CameraView(frame.camera, frame.pose.world_from_camera))
        known = [camera for camera in self._newest if camera.posed is not None]
        if any(frame.pose is not None for frame in frames):
            relit = self._live.relight(
                [each.posed for each in known if each.posed is not None], full_size=full_size
            )
            for camera, found in zip(known, relit, strict=False):
                camera.relit = found
        return [self._source(camera, frame) for camera, frame in zip(self._newest, frames, strict=True)]

    def _source(self, camera: CameraState, frame: ViewFrame) -> FrameSource:
        if frame.pose is None or camera.posed is None:
            camera.relit = None
            return FrameSource(camera, frame, None, None, None, [])
        buffers = None if camera.relit is None else camera.relit.shown()
        view = camera.posed.view if buffers is None else buffers.view
        return FrameSource(camera, frame, camera.relit, buffers, view, self._live.describe_lights())

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

    def _finish(
        self,
        source: FrameSource,
        views: Sequence[StartedView],
        times: PassTimes,
        submitted_ms: float | None,
    ) -> CompositeFrame:
        """Waits for a frame's pictures; accounts the time of all cameras' frames unless `submitted_ms` is None."""
        main, *rest = views
        if submitted_ms is not None and main.composed is not None:
            self._live.account(main.composed, max(submitted_ms, sum(times.ran.values())))
        done = _finished(source, main, rest, times)
        self._check_device()
        return done

    def release(self) -> None:
        """Frees all GL objects."""
        self._live.release()
        self._readback.release()


def _finished(
    source: FrameSource, main: StartedView, rest: Sequence[StartedView], times: PassTimes
) -> CompositeFrame:
    """Takes the pictures in the order in which they were started."""
    frame, color = source.frame, main.take()
    linear = None if main.take_linear is None else main.take_linear()
    return CompositeFrame(
        frame_id=frame.frame_id,
        timestamp_ns=frame.timestamp_ns,
        color=color,
        linear=linear,
        status="no_pose" if frame.pose is None else "ok",
        camera=frame.camera,
        world_from_camera=main.world_from_camera,
        pass_times_ms=times.ran,
        reused_pass_times_ms=times.reused,
        lights=source.lights,
        level=None if main.composed is None else main.composed.level,
        others=tuple(OtherView(each.view, each.take(), each.world_from_camera) for each in rest),
    )
