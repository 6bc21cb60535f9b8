"""The render session of one scene: newest frame in, composite out, commands in between.

No sockets, no threads: process.py feeds it and sends its output; tests pass messages and a renderer.
"""

import time
import uuid
from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import structlog
from jaxtyping import Float64, UInt8

from deltalight.protocol.documents import nearest, validate
from deltalight.protocol.envelope import decode
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.message_fields import Matrix4, as_counts, as_sentence, matrix_rows
from deltalight.protocol.messages import (
    CamerasMessage,
    CameraStatus,
    CompositeMessage,
    ControlRequest,
    OtherPicture,
    ProcessState,
    StatsMessage,
)
from deltalight.protocol.scene import SceneDocument, parse_scene
from deltalight.protocol.scene_fields import ShownView
from deltalight.protocol.subscriber import ReceivedMultipart
from deltalight.render_server.gpu.context import is_software_renderer
from deltalight.render_server.gpu.lost_context import GpuResetError
from deltalight.render_server.server.cameras import RoomCameras, Taken
from deltalight.render_server.server.frames import AssembledFrame, PairingSettings, SourceRequest
from deltalight.render_server.server.renderer_interface import Pending, Renderer
from deltalight.render_server.server.requests import PickRequest, RoomMeshRequest, WatchRequest
from deltalight.render_server.server.scene_reader import SceneReader
from deltalight.render_server.server.session_host import SessionHost, SessionIdentity
from deltalight.render_server.server.snapshot import SnapshotRequest, take_snapshot

RATE_WINDOW_S = 5.0
WAITING_AFTER_S = 2.0
MAXIMUM_FAULTS_IN_A_ROW = 30
LOG_INTERVAL_NS = 10**9
SAME_LOG_INTERVAL_NS = 60 * 10**9  # of one sentence, whose fault may come and go
WATCHED_NS = 60 * 10**9
SOME_SHADERS = 60  # of a first picture, roughly; more are told as they are counted

log = structlog.get_logger()


@dataclass(frozen=True)
class RenderedFrame:
    """A composite to be encoded and sent; `pictures` are the parts of `message` (declared as raw)."""

    message: CompositeMessage
    pictures: tuple[UInt8[np.ndarray, "h w 3"], ...]


@dataclass(frozen=True)
class _Started:
    """A frame in flight on the GPU, with id, revision and view of the scene that it was started with.

    `name` is who the picture says that it is of.
    """

    name: str
    camera: str
    frame: AssembledFrame
    pending: Pending
    scene_id: str | None
    scene_revision: int
    view: ShownView


class RenderSession:
    """Holds one scene, its renderer and the frames that wait for it. Frames are rendered in the `watched` views, too.

    Attributes:
        scene: the scene document.
        scene_id: the sender's id of the scene, if given.
        instance: distinguishes this session from those before a restart.

    Args:
        renderer: renders the frames.
        scene: the first scene.
        pairing: how frames of colour and depth, and of several cameras, are paired.
        identity: who the session says that it is.
        host: what the process around the session does for it.
        endpoints: how many are read at first.
        clock_ns: the time.
    """

    def __init__(
        self,
        renderer: Renderer,
        scene: SceneDocument,
        *,
        pairing: PairingSettings | None = None,
        identity: SessionIdentity | None = None,
        host: SessionHost | None = None,
        endpoints: int = 1,
        clock_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        self.scene = scene
        self._reader = SceneReader()
        self.scene_id: str | None = None
        self.instance = uuid.uuid4().hex
        self.counts: Counter[str] = Counter()
        self.stopping = False
        self._watchers: dict[str, tuple[int, tuple[ShownView, ...]]] = {}  # when each said so, and what
        self._renderer = renderer
        self._cameras = RoomCameras(
            pairing,
            lambda fault: self._count_fault("bad_frames", fault),
            needs_depth=needs_depth(scene),
            endpoints=endpoints,
        )
        self._told: Mapping[str, CameraStatus] = {}  # of the cameras, by name
        self._identity, self._host = identity or SessionIdentity(), host or SessionHost()
        self._clock_ns = clock_ns
        self._newest: tuple[Taken, ...] = ()
        self._finished: deque[RenderedFrame] = deque()
        self._started: tuple[_Started, ...] = ()
        self._rendered: deque[tuple[int, str]] = deque()  # when, and the camera
        self._is_starting = True  # until the first picture
        self._last_fault = ""
        self._faults_in_a_row = 0
        self._logged_notices = 0
        self._logged = "", -SAME_LOG_INTERVAL_NS  # which fault, and when

    def receive(self, multipart: ReceivedMultipart) -> None:
        """Takes a message of the sensor node; a malformed one is counted and logged."""
        try:
            message, parts = decode(multipart)
        except DeltalightError as fault:
            self._count_fault("bad_messages", fault)
            return
        self._cameras.add(message, parts, multipart)

    @property
    def has_picture(self) -> bool:
        """Whether the next step returns a picture that is finished."""
        return bool(self._finished)

    @property
    def is_waiting(self) -> bool:
        """Whether the next step is to finish a started frame, or to start one that has waited for others."""
        return bool(self._started) or self._cameras.is_waiting

    def step(self) -> RenderedFrame | None:
        """Starts the newest frames, if some are ready, and returns a picture of those started before.

        (In software, of themselves.) The pictures of several cameras come one by one, and before others are started,
        as one does that a command finished. A frame that cannot be rendered is counted and logged.

        Raises:
            GpuResetError: the GPU was reset: this process renders nothing any more.
            Exception: `MAXIMUM_FAULTS_IN_A_ROW` unexpected faults without a picture: the renderer is broken, not the
                frames, and only a restart of the process helps.
        """
        if self._finished:
            return self._finished.popleft()
        taken = self._cameras.take(self._clock_ns())
        try:
            return self._render(taken)
        except GpuResetError:
            self.counts["gpu_resets"] += 1
            raise
        except DeltalightError as fault:
            self._count_fault("bad_frames", fault)
        except Exception as fault:  # whatever failed, the next frame must still be rendered
            self._count_fault("bad_frames", fault)
            self._faults_in_a_row += 1
            if self._faults_in_a_row >= MAXIMUM_FAULTS_IN_A_ROW:
                raise
        return None

    def compile_ahead(self) -> None:
        """Prepares the renderer for the next motion, a program at a time, unless a picture is to be finished."""
        if not (self.has_picture or self.is_waiting):
            self._renderer.compile_ahead()

    def cameras(self, *, if_changed: bool = False) -> CamerasMessage | None:
        """Returns the room's cameras; None where there are and were none.

        `if_changed`: also None if nothing but their frames is another than the last time.
        """
        told, self._told = self._told, self._cameras.statuses
        if not (told or self._told) or (if_changed and told == self._told):
            return None
        return CamerasMessage(
            node=self._identity.name, capture_ns=self._clock_ns(), cameras=self._cameras.entries
        )

    def drops(self) -> dict[str, int]:
        """Returns the numbers of lost frames, by cause; topics come last, because nodes choose their number."""
        return as_counts({**self._cameras.counts, **self.counts, **self._host.mailbox_drops()})

    def stats(self, ends_by: DeltalightError | None = None) -> StatsMessage:
        """Returns the state of the session, which may be that it ends by a fault."""
        now_ns = self._clock_ns()
        while self._rendered and self._rendered[0][0] < now_ns - RATE_WINDOW_S * 1e9:
            self._rendered.popleft()
        is_running = bool(self._rendered) and self._rendered[-1][0] > now_ns - WAITING_AFTER_S * 1e9
        state: ProcessState = "degraded" if self._last_fault else "running" if is_running else "waiting"
        fault = self._last_fault if ends_by is None else str(ends_by)
        details = self._identity.renderer_name, fault, *self._cameras.remarks
        return StatsMessage(
            node=self._identity.name,
            capture_ns=now_ns,
            state=state if ends_by is None else "stopping",
            detail=as_sentence("; ".join(filter(None, details))),
            rates=self._rates(),
            drops=self.drops(),
        )

    def preparation(self, shaders: int) -> StatsMessage | None:
        """Returns how far the first picture is, of whose shaders so many were compiled; None once there was one."""
        if not self._is_starting:
            return None
        some = max(SOME_SHADERS, shaders)
        return StatsMessage(
            node=self._identity.name,
            capture_ns=self._clock_ns(),
            state="starting",
            detail=f"Compiling shaders, once per machine: {shaders} of about {some}.",
        )

    def _rates(self) -> dict[str, float]:
        """Returns the rate of the fastest camera's pictures and, of several cameras, that of each."""
        counts = Counter(camera for _, camera in self._rendered)
        fastest = max(counts.values(), default=0)
        each = {f"frames_per_s {name}": count for name, count in counts.items() if self._cameras.are_several}
        return {name: count / RATE_WINDOW_S for name, count in {"frames_per_s": fastest, **each}.items()}

    def execute(self, request: ControlRequest) -> dict[str, object]:
        """Executes a command between two frames and returns the payload of the reply.

        Raises:
            DeltalightError: the command is unknown, or refused.
        """
        commands: dict[str, Callable[[ControlRequest], dict[str, object]]] = {
            "ping": self._ping,
            "get_scene": lambda _: {"scene": self.scene.model_dump(mode="json")},
            "set_scene": self._set_scene,
            "set_view": self._set_view,
            "watch": self._watch,
            "pick": self._pick,
            "room": self._room,
            "snapshot": self._snapshot,
            "set_source": self._set_source,
            "stats": self._stats,
            "gl_objects": lambda _: dict(self._host.count_objects()),
            "shutdown": self._shut_down,
        }
        if request.op not in commands:
            hint = nearest(request.op, commands) or ", ".join(commands)
            raise DeltalightError(f"There is no command '{request.op}'; did you mean {hint}?")
        return commands[request.op](request)

    def _ping(self, _request: ControlRequest) -> dict[str, object]:
        epoch = {} if self._identity.epoch is None else {"epoch": self._identity.epoch}
        shown = {"scene_id": self.scene_id, "revision": self.scene.revision, "instance": self.instance}
        return {**shown, **epoch}

    def _stats(self, _request: ControlRequest) -> dict[str, object]:
        is_software = is_software_renderer(self._identity.renderer_name)
        return {"stats": self.stats().model_dump(mode="json"), "is_software": is_software}

    def _set_view(self, request: ControlRequest) -> dict[str, object]:
        """Changes the view; the sender of the previous scene does not know the result, so its id is dropped."""
        return self._use_scene(_with_view(self.scene, request.payload.get("view")), scene_id=None)

    def _watch(self, request: ControlRequest) -> dict[str, object]:
        """Renders frames in these views too from now on, and in those of other senders."""
        views = validate(WatchRequest, request.payload, "the command watch").views
        self._watchers[request.node] = (self._clock_ns(), views)
        return {"views": list(self.watched)}

    @property
    def watched(self) -> tuple[ShownView, ...]:
        """The views that senders watch who said so within the last minute."""
        since_ns = self._clock_ns() - WATCHED_NS
        self._watchers = {name: each for name, each in self._watchers.items() if each[0] >= since_ns}
        return tuple(dict.fromkeys(view for _, views in self._watchers.values() for view in views))

    def _shut_down(self, _request: ControlRequest) -> dict[str, object]:
        self.stopping = True
        return {}

    def _pick(self, request: ControlRequest) -> dict[str, object]:
        wanted = validate(PickRequest, request.payload, "the command pick")
        return self._renderer.pick(wanted.x, wanted.y, wanted.ignore, wanted.camera).as_dict()

    def _room(self, request: ControlRequest) -> dict[str, object]:
        order = validate(RoomMeshRequest, request.payload, "the command room")
        self._renderer.room().write(order.file)
        return {}

    def _snapshot(self, request: ControlRequest) -> dict[str, object]:
        order = validate(SnapshotRequest, request.payload, "the command snapshot")
        wanted = self._newest[:1] if order.camera is None else self._newest
        frame = next((each.frame for each in wanted if order.camera in (None, each.camera)), None)
        if frame is None:
            raise DeltalightError("No frame has come yet; take the snapshot when there is a picture.")
        self._finish_started()
        room = [each.shown(is_shown=each.frame is frame) for each in self._newest]
        taken = take_snapshot(self._renderer, self.scene, room, order)
        return {
            "frame_id": frame.color.frame_id,
            "capture_ns": frame.color.capture_ns,
            "files": taken.files,
            "errors": taken.errors,
        }

    def _set_source(self, request: ControlRequest) -> dict[str, object]:
        order = validate(SourceRequest, request.payload, "the command set_source")
        self._finish_started()
        source = self._host.use_source(order.endpoints)
        if source.is_another:
            self._newest = ()  # of the previous source
            self._finished.clear()
            self._cameras.restart(len(source.endpoints))
            self._renderer.forget_frames()
        return {"endpoints": list(source.endpoints)}

    def _finish_started(self) -> None:
        """Waits for the frames on the GPU, so that a command can use it; the next steps return their pictures."""
        before, self._started = self._started, ()
        self._finished.extend(self._finish(each) for each in before)

    def _render(self, taken: tuple[Taken, ...]) -> RenderedFrame | None:
        before, started = self._started, tuple[_Started, ...]()
        if taken:
            self._newest = taken
            started = self._start(taken)  # a fault leaves the frames before in flight
        self._started = started
        if not before and all(each.pending.immediate for each in self._started):
            before, self._started = self._started, ()
        self._finished.extend(self._finish(each) for each in before)
        return self._finished.popleft() if self._finished else None

    def _start(self, taken: tuple[Taken, ...]) -> tuple["_Started", ...]:
        """Starts a picture of each new frame; the others light the room."""
        view = self.scene.output.view
        others = tuple(each for each in self.watched if each != view)
        room = [each.shown(is_shown=each.is_new) for each in taken]
        pending = self._renderer.submit_cameras(room, others=others)
        are_several = self._cameras.are_several
        return tuple(
            _Started(
                each.camera if are_several else self._identity.name,
                each.camera,
                each.frame,
                started,
                self.scene_id,
                self.scene.revision,
                view,
            )
            for each, started in zip([each for each in taken if each.is_new], pending, strict=True)
        )

    def _finish(self, started: "_Started") -> RenderedFrame:
        composite, frame = started.pending.finish(), started.frame
        self._last_fault = ""
        self._faults_in_a_row = 0
        self._is_starting = False
        self._log_notices()
        rendered_ns = self._clock_ns()
        self._rendered.append((rendered_ns, started.camera))
        color = frame.color
        message = CompositeMessage(
            node=started.name,
            frame_id=color.frame_id,
            capture_ns=color.capture_ns,
            clock_offset_ns=color.clock_offset_ns,
            clock_bound_ns=color.clock_bound_ns,
            encoding="raw",
            shape=(*composite.color.shape[:2], 3),
            status="ok" if composite.status == "ok" else "no_pose",
            scene_id=started.scene_id,
            scene_revision=started.scene_revision,
            camera=composite.camera.to_dict(),
            world_from_camera=_rows(composite.world_from_camera),
            received_ns=frame.received_ns,
            rendered_ns=rendered_ns,
            pass_times_ms=composite.pass_times_ms,
            reused_pass_times_ms=composite.reused_pass_times_ms,
            lights=tuple(composite.lights),
            drops=self.drops(),
            quality=None if composite.level is None else composite.level.quality,
            scale=1.0 if composite.level is None else composite.level.scale,
            view=started.view,
            others=tuple(
                OtherPicture(view=other.view, world_from_camera=_rows(other.world_from_camera))
                for other in composite.others
            ),
        )
        return RenderedFrame(message, (composite.color, *(other.color for other in composite.others)))

    def _set_scene(self, request: ControlRequest) -> dict[str, object]:
        """Sets a scene, idempotently by id and revision: confirms the current revision and refuses an older one."""
        scene = self._scene_of(request)
        current = self.scene.revision
        if request.revision is None or request.scene_id != self.scene_id or scene.revision > current:
            return self._use_scene(scene, request.scene_id)
        if scene.revision < current or scene != self.scene:
            raise DeltalightError(
                f"The scene is already at revision {current}; get it, change it and send it as {current + 1}."
            )
        return {"revision": current}

    def _scene_of(self, request: ControlRequest) -> SceneDocument:
        """Returns the document of a request, with the request's revision.

        Without id and revision it gets the next one.
        """
        document = request.payload.get("scene")
        if not isinstance(document, dict):
            raise DeltalightError("The command set_scene needs the scene document as `scene` in its payload.")
        if request.revision is not None:
            document = {**document, "revision": request.revision}
        elif request.scene_id is None:
            document = {**document, "revision": self.scene.revision + 1}
        return self._reader.read(document)

    def _use_scene(self, scene: SceneDocument, scene_id: str | None) -> dict[str, object]:
        self._renderer.set_scene(scene)
        self._cameras.need_depth(needs_depth(scene))
        self.scene, self.scene_id = scene, scene_id
        self._host.keep_scene(scene)
        return {"revision": scene.revision}

    def _log_notices(self) -> None:
        for notice in self._renderer.notices[self._logged_notices :]:
            log.info(notice)
        self._logged_notices = len(self._renderer.notices)

    def _count_fault(self, kind: str, fault: Exception) -> None:
        self.counts[kind] += 1
        named = str(fault) if isinstance(fault, DeltalightError) else f"{type(fault).__name__}: {fault}"
        sentence = as_sentence(named)
        now_ns, (logged, logged_ns) = self._clock_ns(), self._logged
        interval_ns = SAME_LOG_INTERVAL_NS if sentence == logged else LOG_INTERVAL_NS
        # A fault of every frame is one line, not thirty a second, and a node that finds others fills no disk.
        if sentence != self._last_fault and now_ns - logged_ns >= interval_ns:
            self._logged = sentence, now_ns
            log.warning(kind, fault=sentence)
            log.debug("traceback", exc_info=fault)
        self._last_fault = sentence


def _rows(matrix: Float64[np.ndarray, "4 4"] | None) -> Matrix4 | None:
    return None if matrix is None else matrix_rows(matrix)


def needs_depth(scene: SceneDocument) -> bool:
    """Returns whether frames of a scene are complete only with depth."""
    return scene.real.geometry in ("depth", "fused")


def _with_view(scene: SceneDocument, view: object) -> SceneDocument:
    document = scene.model_dump(mode="json")
    document["output"]["view"] = view
    return parse_scene({**document, "revision": scene.revision + 1})
