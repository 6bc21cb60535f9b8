"""The render server's process: sockets around one `RenderSession`.

Threads: the receiver's, the reply server's, the sender's (which encodes and publishes), and the main one,
which owns the OpenGL context and does nothing but render and execute commands.
"""

import queue
import sys
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from concurrent.futures import TimeoutError as FutureTimeoutError
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Protocol

import numpy as np
import structlog
from pydantic import Field

from deltalight.protocol.clock import CLOCK_OP, clock_payload
from deltalight.protocol.codecs import encode_color
from deltalight.protocol.documents import StrictModel
from deltalight.protocol.envelope import encode
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.files import write_bytes
from deltalight.protocol.keys import Keys
from deltalight.protocol.message_fields import Name
from deltalight.protocol.messages import CamerasMessage, ControlRequest, StatsMessage
from deltalight.protocol.methods import PLUGINS
from deltalight.protocol.publisher import Publisher
from deltalight.protocol.request import ReplyServer
from deltalight.protocol.scene import SceneDocument, load_scene
from deltalight.render_server.frame_budget import HeldLevels
from deltalight.render_server.gpu.context import CompileWatcher, GpuContext, count_gl_objects, create_context
from deltalight.render_server.gpu.lost_context import GpuResetError
from deltalight.render_server.lights.lights import ENVIRONMENT_SIZE
from deltalight.render_server.lights.octahedral import prefilter
from deltalight.render_server.renderer import SceneRenderer
from deltalight.render_server.server.frames import FrameReceiver, PairingSettings
from deltalight.render_server.server.renderer_interface import Renderer
from deltalight.render_server.server.session import RenderedFrame, RenderSession
from deltalight.render_server.server.session_host import SessionHost, SessionIdentity, SourceInUse

SWITCH_INTERVAL_S = 0.0005  # how long a thread may keep the interpreter; 5 ms in Python itself
SHORT_TIMEOUT_S = 0.002  # a started frame is read back after this time if no other one comes
RECEIVE_TIMEOUT_S = 0.05  # bounds how long a command waits while no frames arrive
STATS_INTERVAL_S = 1.0
PREPARING_INTERVAL_S = 0.5
LAST_WORDS_MS = 100  # for what was sent at the end, where a subscriber is slow
ANSWER_TIMEOUT_S = 20.0
SNAPSHOT_TIMEOUT_S = 120.0  # a frame in many views and by several methods, in software

WAITING_OF_A_TOPIC = 2

Payload = dict[str, object]
Sendable = RenderedFrame | CamerasMessage | StatsMessage

log = structlog.get_logger()


class ServerSettings(StrictModel):
    """Settings of a render server."""

    scene: Path | None = Field(default=None, description="Scene document to start with.")
    session: Path | None = Field(
        default=None, description="File that keeps the current scene, so that a restart continues with it."
    )
    subscribe: tuple[str, ...] = Field(min_length=1, description="Endpoints of sensor nodes.")
    publish: str = Field(description="Endpoint for composites and statistics.")
    control: str = Field(description="Endpoint for commands.")
    name: Name = Field(default="render-server", description="Name in topics and messages.")
    epoch: int | None = Field(
        default=None,
        ge=1,
        description="Number of this start among those of its room's render server, as `ping` returns it; null = "
        "not part of a room.",
    )
    device: int | None = Field(default=None, ge=0, description="EGL device; null = the driver's first.")
    allow_software: bool = Field(default=False, description="Allow rendering without a GPU.")
    jpeg_quality: int = Field(default=90, ge=1, le=100, description="Quality of published composites.")
    pairing: PairingSettings = Field(default_factory=PairingSettings)

    def initial_scene(self) -> SceneDocument:
        """Returns the kept scene if there is one, else the scene document, else an empty scene.

        Raises:
            DeltalightError: the document is invalid.
        """
        if self.session is not None and self.session.is_file():
            return load_scene(self.session)
        return SceneDocument() if self.scene is None else load_scene(self.scene)

    def held_levels(self) -> HeldLevels:
        """Returns the levels that held budgets when as many cameras were rendered before."""
        return HeldLevels(f"{len(self.subscribe)} cameras")


class CommandQueue:
    """Passes commands from the thread that receives them to the thread that may use OpenGL."""

    def __init__(self) -> None:
        self._closed = False
        self._pending: queue.SimpleQueue[tuple[ControlRequest, Future[Payload]]] = queue.SimpleQueue()

    def ask(self, request: ControlRequest) -> Payload:
        """Queues a command and waits for the payload of its reply (called by the reply server's thread).

        Raises:
            DeltalightError: the command was refused, or the renderer did not answer in time.
        """
        answer: Future[Payload] = Future()
        if request.op == CLOCK_OP:  # answered here, because waiting for a frame would blur the times
            return clock_payload(time.time_ns())
        self._pending.put((request, answer))
        if self._closed:
            self.serve(_refuse)
        timeout_s = SNAPSHOT_TIMEOUT_S if request.op == "snapshot" else ANSWER_TIMEOUT_S
        try:
            return answer.result(timeout_s)
        except FutureTimeoutError as fault:
            raise DeltalightError(
                f"The renderer did not answer within {timeout_s:.0f} s; try again or restart it."
            ) from fault

    def serve(self, execute: Callable[[ControlRequest], Payload]) -> None:
        """Executes all queued commands (called by the rendering thread)."""
        while not self._pending.empty():
            request, answer = self._pending.get()
            try:
                answer.set_result(execute(request))
            except Exception as fault:  # the fault goes to whoever asked, and rendering continues
                answer.set_exception(fault)

    def close(self) -> None:
        """Refuses queued and later commands, so that nobody waits for a renderer that is gone."""
        self._closed = True
        self.serve(_refuse)


def _refuse(request: ControlRequest) -> Payload:
    raise DeltalightError(f"The render server ends and cannot carry out '{request.op}'; start it again.")


class Sender:
    """Encodes and publishes in its own thread, while the next frame is rendered.

    OpenCV encodes without the interpreter lock. Two messages of a topic may wait; the renderer never does.
    """

    def __init__(self, publisher: Publisher, jpeg_quality: int) -> None:
        self.dropped = 0
        self._publisher = publisher
        self._quality = jpeg_quality
        self._generation = 0  # pictures of earlier generations are not sent
        self._waiting: queue.SimpleQueue[tuple[Sendable | None, int]] = queue.SimpleQueue()
        self._places = defaultdict[str, threading.Semaphore](lambda: threading.Semaphore(WAITING_OF_A_TOPIC))
        self._thread = threading.Thread(target=self._run, name="sender", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Sends waiting messages, then ends the thread."""
        self._waiting.put((None, self._generation))
        self._thread.join(timeout=1.0)

    def offer(self, item: Sendable) -> None:
        """Queues an item, or counts it as dropped if sending is slower than rendering."""
        self._queue(item, blocking=False)

    def say_last(self, item: StatsMessage) -> None:
        """Queues an item; waits for room."""
        self._queue(item, blocking=True)

    def forget(self) -> None:
        """Discards all pictures offered so far."""
        self._generation += 1

    def _queue(self, item: Sendable, *, blocking: bool) -> None:
        place = self._places[_topic(item)]
        if place.acquire(blocking=blocking):
            self._waiting.put((item, self._generation))
        else:
            self.dropped += 1

    def _run(self) -> None:
        while True:
            item, generation = self._waiting.get()
            if item is None:
                return
            self._places[_topic(item)].release()
            try:
                pieces = self._multipart(item)
                if generation == self._generation or not isinstance(item, RenderedFrame):
                    self._publisher.send(pieces)
            except DeltalightError as fault:
                log.warning("not sent", fault=str(fault))

    def _multipart(self, item: Sendable) -> list[bytes]:
        if not isinstance(item, RenderedFrame):
            return encode(item)
        jpegs = [encode_color(picture, "jpeg", self._quality) for picture in item.pictures]
        return encode(item.message.model_copy(update={"encoding": "jpeg"}), jpegs)


class BuiltAhead(Protocol):
    """What a process built while it was a spare (`standby.StandbyRenderer`)."""

    def take(
        self, settings: ServerSettings, scene: SceneDocument
    ) -> tuple[GpuContext | None, SceneRenderer | None]:
        """Returns the context and renderer if they fit these settings and this scene, else None."""


def _topic(item: Sendable) -> str:
    return item.message.topic if isinstance(item, RenderedFrame) else item.topic


def warm_up() -> None:
    """Prepares what every renderer needs before its first picture and what takes no OpenGL, for spare processes."""
    prefilter(np.ones((ENVIRONMENT_SIZE, ENVIRONMENT_SIZE, 3), np.float32))  # what it looks up is kept


def run_server(settings: ServerSettings, keys: Keys | None = None, ahead: BuiltAhead | None = None) -> None:
    """Serves until a `shutdown` command or an exception (Ctrl-C, SIGTERM) ends it.

    `keys` are required if an endpoint leaves the host; `ahead` is what this process built while it was a spare.

    Raises:
        DeltalightError: the scene is wrong, no OpenGL device is suitable, or a port is in use.
        GpuResetError: the GPU was reset; a new process goes on where this one ended.
    """
    scene = settings.initial_scene()
    sys.setswitchinterval(SWITCH_INTERVAL_S)  # frames wait for it dozens of times
    for fault in PLUGINS.faults.values():
        log.warning(fault)
    with ExitStack() as stack:
        gpu, renderer = (None, None) if ahead is None else ahead.take(settings, scene)
        if gpu is None:
            gpu = create_context(settings.device, allow_software=settings.allow_software)
        stack.callback(gpu.release)
        if gpu.is_software:
            log.warning("no GPU found, rendering slowly in software", renderer=gpu.renderer_name)
        if renderer is None:
            # Commands are answered meanwhile.
            renderer = SceneRenderer(gpu, scene, waits=False, held=settings.held_levels())
        else:
            log.info("goes on with the scene that was built ahead", revision=scene.revision)
        stack.callback(renderer.release)
        serve(
            settings,
            renderer,
            scene,
            renderer_name=gpu.renderer_name,
            keys=keys,
            count_objects=count_gl_objects,
            compile_watchers=gpu.compile_watchers,
        )


def serve(
    settings: ServerSettings,
    renderer: Renderer,
    scene: SceneDocument,
    *,
    renderer_name: str,
    keys: Keys | None = None,
    count_objects: Callable[[], Mapping[str, int]] = dict,
    compile_watchers: list[CompileWatcher] | None = None,
) -> None:
    """Opens the sockets around a renderer that shows `scene`, and serves until a `shutdown` command.

    Renders in the calling thread. `count_objects` is as for `SessionHost`; `compile_watchers` are those of the
    renderer's context.

    Raises:
        DeltalightError: a port is in use, or an endpoint leaves the host without keys.
    """
    with ExitStack() as stack:
        publisher = Publisher(settings.publish, keys=keys)
        stack.callback(publisher.close, LAST_WORDS_MS)
        sender = Sender(publisher, settings.jpeg_quality)
        stack.callback(sender.close)
        source = FrameReceiver(settings.subscribe, keys)
        stack.callback(source.close)
        commands = CommandQueue()
        replies = ReplyServer(settings.control, commands.ask, node=settings.name, keys=keys)
        stack.callback(replies.close)
        stack.callback(commands.close)
        session = RenderSession(
            renderer,
            scene,
            pairing=settings.pairing,
            identity=SessionIdentity(settings.name, settings.epoch, renderer_name),
            host=SessionHost(
                keep_scene=partial(_keep, settings.session),
                mailbox_drops=partial(_drops, source, sender, replies),
                use_source=partial(_use_source, source, sender),
                count_objects=count_objects,
            ),
            endpoints=len(source.endpoints),
        )
        if compile_watchers is not None:
            compile_watchers.append(_Preparation(session, sender))
        log.info("render server runs", renderer=renderer_name, publish=settings.publish)
        try:
            _loop(session, source, sender, commands)
        except GpuResetError as fault:
            sender.say_last(session.stats(ends_by=fault))
            raise


def _use_source(source: FrameReceiver, sender: Sender, endpoints: Sequence[str] | None) -> SourceInUse:
    """Reads other endpoints; pictures of the old ones that wait to be sent are discarded."""
    is_another = source.use(endpoints)
    if is_another:
        sender.forget()
    return SourceInUse(source.endpoints, is_another)


def _drops(source: FrameReceiver, sender: Sender, replies: ReplyServer) -> dict[str, int]:
    """Returns the number of messages that were dropped, by topic or reason."""
    refused = {"commands_not_allowed": replies.not_allowed} if replies.not_allowed else {}
    return {"send": sender.dropped, **source.drops, **refused}


class _Preparation:
    """Reports how many shaders the first picture has taken so far, between two of them.

    Without a shader cache of the driver that picture takes a minute and more, and nothing else is reported meanwhile.
    """

    def __init__(self, session: RenderSession, sender: Sender) -> None:
        self._session, self._sender = session, sender
        self._compiled: set[str] = set()
        self._due_s = time.monotonic()

    def __call__(self, label: str, _sources: Mapping[str, str]) -> None:
        finished = len(self._compiled)
        self._compiled.add(label)
        if time.monotonic() < self._due_s:
            return
        self._due_s = time.monotonic() + PREPARING_INTERVAL_S
        report = self._session.preparation(finished)
        if report is not None:
            self._sender.offer(report)


def _patience_s(session: RenderSession) -> float:
    """Returns how long to wait for a message."""
    if session.has_picture:
        return 0.0
    return SHORT_TIMEOUT_S if session.is_waiting else RECEIVE_TIMEOUT_S


def _loop(session: RenderSession, source: FrameReceiver, sender: Sender, commands: CommandQueue) -> None:
    stats_due_s = time.monotonic()
    while not session.stopping:
        for multipart in (source.latest(_patience_s(session)) or {}).values():
            session.receive(multipart)
        rendered = session.step()
        is_due = time.monotonic() >= stats_due_s
        cameras = session.cameras(if_changed=not is_due)
        if cameras is not None:  # before pictures that name one of them
            sender.offer(cameras)
        if rendered is not None:
            sender.offer(rendered)
        if is_due:
            _offer_stats(session, sender)
            stats_due_s = time.monotonic() + STATS_INTERVAL_S
        commands.serve(session.execute)
        session.compile_ahead()  # last, for it may take a second


def _offer_stats(session: RenderSession, sender: Sender) -> None:
    """Offers the statistics; a fault in them is no reason to stop rendering."""
    try:
        sender.offer(session.stats())
    except Exception as fault:
        log.warning("no statistics", fault=str(fault))


def _keep(path: Path | None, scene: SceneDocument) -> None:
    if path is not None:
        write_bytes(path, scene.model_dump_json(indent=1).encode())
