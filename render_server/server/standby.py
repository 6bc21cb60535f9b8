"""What a spare render server (a warm standby) builds ahead: a context, and a renderer of the running server's scene.

It reads the same document and nodes as the running server, publishes nothing and opens no socket for others. Its
renderer renders pictures of each camera, so that shaders are compiled and estimates made before it is needed.
"""

import time
import uuid
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import structlog

from deltalight.protocol.envelope import decode
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.keys import Keys
from deltalight.protocol.messages import ControlRequest, StatsMessage
from deltalight.protocol.request import RequestClient
from deltalight.protocol.scene import SceneDocument
from deltalight.protocol.scene_method import AroofMethod
from deltalight.render_server.freed_memory import give_back_garbage
from deltalight.render_server.gpu.context import GpuContext, create_context
from deltalight.render_server.gpu.device_memory import device_memory, free_host_memory, gl_integers
from deltalight.render_server.renderer import SceneRenderer
from deltalight.render_server.server.cameras import RoomCameras, Taken
from deltalight.render_server.server.frames import FrameReceiver
from deltalight.render_server.server.pace import CalledError, IsCalled, Pace
from deltalight.render_server.server.process import RECEIVE_TIMEOUT_S, ServerSettings
from deltalight.render_server.server.session import needs_depth

LOOK_INTERVAL_S = 2.0  # between looks at the document and at the other server's health
CALM_NS = 3 * 10**9  # how long a document must be unchanged
ANSWER_TIMEOUT_S = 2.0
ANSWER_POLL_S = 0.05
LISTEN_S = 3.0  # at most, to nodes, for a frame of each
PICTURES = 2  # of each camera: light from out of sight comes with the second
ATTEMPTS = 2 * PICTURES  # to get them
NEEDED_BYTES = 10**9  # of the host
NEEDED_DEVICE_BYTES = 6 * 10**9  # of a GPU: the volumes' default budget, and the rest

log = structlog.get_logger()


class _File(NamedTuple):
    """The state of a file, by which later writes are noticed."""

    path: str
    written_ns: int
    size: int


Stamp = tuple[_File, ...]


@dataclass(frozen=True, eq=False)
class _Built:
    """A renderer, what it shows, and the state of its files when it read them."""

    renderer: SceneRenderer
    scene: SceneDocument
    files: Stamp


class StandbyRenderer:
    """Keeps a renderer ready to take over from a running server with these settings.

    `is_called` waits for so many seconds and returns whether the spare must take over. A renderer that cannot be
    built, or for which there is no memory, is not tried again before the document changes.
    """

    def __init__(self, settings: ServerSettings, keys: Keys | None, is_called: IsCalled) -> None:
        self._settings, self._keys, self._is_called = settings, keys, is_called
        self._gpu: GpuContext | None = None
        self._built: _Built | None = None
        self._document: Stamp = ()  # as last seen
        self._is_done = False  # with this document

    def keep(self) -> None:
        """Builds the renderer, again after each change of the document, until the spare is called."""
        while not self._is_called(LOOK_INTERVAL_S):
            try:
                self._look()
            except CalledError:  # what was linked so far stays with the context
                self._release_renderer()
            except Exception as fault:  # whatever it is, the spare is still good for its imports
                log.warning("nothing is built ahead", fault=str(fault))
                self._release()

    def take(
        self, settings: ServerSettings, scene: SceneDocument
    ) -> tuple[GpuContext | None, SceneRenderer | None]:
        """Returns the context and renderer if they fit these settings and this scene, else None; frees the rest."""
        if self._gpu is not None and not self._fits(self._gpu, settings):
            self._release()
        built = self._built
        if built is None or not self._is_current(built, settings, scene):
            self._release_renderer()
            return self._gpu, None
        # As after any change, the next frame is not one at rest, which would be refined at once.
        built.renderer.set_scene(scene)
        return self._gpu, built.renderer

    def _fits(self, gpu: GpuContext, settings: ServerSettings) -> bool:
        try:
            gpu.check()
        except DeltalightError:  # the context is lost, or out of memory
            return False
        return settings.device == self._settings.device

    def _is_current(self, built: _Built, settings: ServerSettings, scene: SceneDocument) -> bool:
        return (
            scene == built.scene
            and settings.subscribe == self._settings.subscribe
            and _stamp(_assets(scene)) == built.files
        )

    def _look(self) -> None:
        paths = self._settings.session, self._settings.scene
        document = _stamp([path for path in paths if path is not None])
        if document != self._document:  # perhaps the same scene was sent again, as to each new server
            self._document, self._is_done = document, self._is_done and self._shows_document()
        written_ns = max((each.written_ns for each in document), default=0)
        is_due = not self._is_done and time.time_ns() - written_ns >= CALM_NS
        if not is_due and self._built is None:
            return
        state = self._state_of_server()
        if state == "degraded" and self._built is not None:
            raise DeltalightError("The render server is degraded, so it gets the memory of its spare.")
        if is_due and state == "running":
            self._is_done = True
            self._build()

    def _shows_document(self) -> bool:
        """Returns whether the renderer was built from the document as it is now."""
        built = self._built
        return built is not None and self._is_current(built, self._settings, self._settings.initial_scene())

    def _state_of_server(self) -> str | None:
        """Returns the state that the other server reports; None if it does not answer before this one is called."""
        request = ControlRequest(node=self._settings.name, id=uuid.uuid4().hex, op="stats")
        client = RequestClient(self._settings.control, keys=self._keys)
        try:
            with closing(client), ThreadPoolExecutor(1) as asking:
                answer = asking.submit(client.request, request, ANSWER_TIMEOUT_S)
                while not answer.done():
                    if self._is_called(ANSWER_POLL_S):
                        client.abandon()  # it is dead
                        break
                reply = answer.result()
            return StatsMessage.model_validate(reply.payload["stats"]).state
        except (DeltalightError, KeyError, ValueError):
            return None

    def _build(self) -> None:
        began_s, scene = time.monotonic(), self._settings.initial_scene()
        if isinstance(scene.method, AroofMethod) or scene.shading.is_precomputed:
            raise DeltalightError("What the scene precomputes of objects is computed by one process.")
        self._release_renderer()
        if self._gpu is None:
            self._gpu = create_context(self._settings.device, allow_software=self._settings.allow_software)
        _require_memory(self._gpu)
        files = _stamp(_assets(scene))
        pace = Pace(self._gpu, self._is_called)
        with pace.kept():
            renderer = SceneRenderer(self._gpu, scene, waits=False, held=self._settings.held_levels())
            self._built = _Built(renderer, scene, files)
            self._render(renderer, scene, pace)
        log.info("scene built ahead", revision=scene.revision, seconds=round(time.monotonic() - began_s, 1))

    def _render(self, renderer: SceneRenderer, scene: SceneDocument, pace: Pace) -> None:
        """Renders pictures of each camera, as a server would; nobody gets them.

        Raises:
            DeltalightError: a frame could not be rendered.
            CalledError: it was called too early: a new renderer shows its first picture sooner.
        """
        settings = self._settings
        cameras = RoomCameras(
            settings.pairing,
            lambda _fault: None,
            needs_depth=needs_depth(scene),
            endpoints=len(settings.subscribe),
        )
        rendered = attempts = 0
        while rendered < PICTURES and attempts < ATTEMPTS:
            if self._is_called(0.0):
                if rendered:  # one of each camera is enough
                    return
                raise CalledError
            attempts += 1
            taken = self._listen(cameras)
            if taken:
                for pending in renderer.submit_cameras([each.shown(is_shown=True) for each in taken]):
                    pending.finish()
                rendered += 1
                # The last pictures are finished: that takes less than new ones.
                pace.may_end = rendered < PICTURES - 1

    def _listen(self, cameras: RoomCameras) -> tuple[Taken, ...]:
        """Receives a frame of each camera, or of those that send any in time, and leaves the nodes alone again.

        On a busy host, a server's patience would miss some, and a renderer for fewer cameras has to be built again.
        """
        ends_s = time.monotonic() + LISTEN_S
        taken: tuple[Taken, ...] = ()
        with closing(FrameReceiver(self._settings.subscribe, self._keys)) as source:
            while len(taken) < len(self._settings.subscribe) and time.monotonic() < ends_s:
                if self._is_called(0.0):
                    return ()
                for multipart in (source.latest(RECEIVE_TIMEOUT_S) or {}).values():
                    with suppress(DeltalightError):  # the other server counts what is malformed
                        cameras.add(*decode(multipart), multipart)
                taken = cameras.take(time.time_ns()) or taken
        return taken

    def _release(self) -> None:
        self._release_renderer()
        if self._gpu is not None:
            self._gpu.release()
        self._gpu = None

    def _release_renderer(self) -> None:
        if self._built is not None:
            self._built.renderer.release()
            self._built = None
            give_back_garbage()


def _require_memory(gpu: GpuContext) -> None:
    """Refuses where a second renderer may not fit beside the first.

    Raises:
        DeltalightError: the host or the GPU has too little free memory, or its driver does not tell.
    """
    if free_host_memory() < NEEDED_BYTES:
        raise DeltalightError("The host has too little memory for a second renderer.")
    _, free = device_memory(gpu.ctx.extensions, gl_integers(), is_software=gpu.is_software)
    if not gpu.is_software and (free is None or free < NEEDED_DEVICE_BYTES):
        raise DeltalightError(
            "The GPU has too little memory for a second renderer, or does not report how much it has."
        )


def _assets(scene: SceneDocument) -> list[Path]:
    """Returns the files that a scene consists of."""
    found: list[Path] = []

    def note(_place: str, asset: str) -> str:
        found.append(Path(asset))
        return asset

    scene.with_assets(note)
    return found


def _stamp(files: list[Path]) -> Stamp:
    """Returns what tells whether these were written since; those that are missing are left out."""
    known = [(path, path.stat()) for path in files if path.is_file()]
    return tuple(_File(str(path), found.st_mtime_ns, found.st_size) for path, found in known)
