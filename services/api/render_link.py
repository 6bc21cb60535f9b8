"""Keeps the render server at the newest revision of the active scene."""

import threading
import time
import uuid
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress

import structlog

from deltalight.protocol.clock import CLOCK_OP
from deltalight.protocol.envelope import EnvelopeError
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.keys import Keys
from deltalight.protocol.messages import ControlRequest
from deltalight.protocol.request import RequestClient
from deltalight.protocol.scene_fields import ShownView
from deltalight.services.api.delivery import BUSY, SILENT, Change, Deliveries, DeliveryStatus, pending
from deltalight.services.storage.scenes import StoredScene
from deltalight.services.storage.store import Store

LOOK_INTERVAL_S = 1.0
WATCH_INTERVAL_S = 20.0  # the server forgets views after a minute
ALIVE_TIMEOUT_S = 1.0  # a separate thread of the server answers this, whatever the renderer does
COMMAND_TIMEOUT_S = 25.0  # the server itself times out after 20 s

log = structlog.get_logger()


class FifoLock:
    """FIFO lock: threads acquire it in their order of arrival.

    A thread that has just released a `threading.Lock` may acquire it again, ahead of those that wait.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._is_held = False
        self._waiting: deque[threading.Lock] = deque()

    def __enter__(self) -> None:
        """Waits until all earlier threads have released the lock."""
        with self._lock:
            if not self._is_held:
                self._is_held = True
                return
            turn = threading.Lock()
            turn.acquire()
            self._waiting.append(turn)
        turn.acquire()

    def __exit__(self, *_fault: object) -> None:
        """Hands the lock over to the thread that has waited longest."""
        with self._lock:
            if self._waiting:
                self._waiting.popleft().release()
            else:
                self._is_held = False


class RenderLink:
    """Sends the active scene to the render server, immediately after a change and again after its restart.

    One thread always sends the newest revision: it skips changes that come faster than the server takes them.
    Commands run in between, each after the changes that preceded it. `control` is the server's endpoint, None while
    there is no server. Several web processes may keep one server up to date; of these, one `chooses_source`.
    """

    def __init__(
        self,
        store: Store,
        control: str | None,
        keys: Keys | None = None,
        *,
        on_delivery: Callable[[DeliveryStatus], None] = lambda _status: None,
        chooses_source: bool = True,
    ) -> None:
        self._store = store
        self._name = f"api-{uuid.uuid4().hex[:8]}"  # by which the server keeps web processes apart
        self._chooses_source = chooses_source
        self._on_delivery = on_delivery
        self._keys = keys
        self._client = None if control is None else RequestClient(control, keys=keys)
        self._epoch: int | None = None  # that the server must have; None = any
        self._asking = FifoLock()  # held during requests to the server; guards the fields below
        self._changed = threading.Event()
        self._deliveries = Deliveries()
        self._look_due_s = 0.0
        self._answers: bool | None = None  # not asked yet
        self._instance: str | None = None  # of the server; a different one has lost its scene
        self._has_scene = False  # whether this instance received a scene from here
        self._source: list[str] | None = None
        self._watched: tuple[ShownView, ...] = ()
        self._sent_watched: tuple[ShownView, ...] | None = None  # by the server that answers; None: not yet
        self._watch_due_s = 0.0
        self.on_source: Callable[[Sequence[str] | None], None] = lambda _endpoints: None
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="render-link", daemon=True)

    def start(self) -> None:
        """Starts watching the server."""
        self._thread.start()

    def close(self) -> None:
        """Stops watching."""
        self._stop.set()
        self._changed.set()
        if self._thread.is_alive():
            self._thread.join(timeout=ALIVE_TIMEOUT_S)
        # Otherwise it waits for a renderer that hangs: the process ends without it.
        if not self._thread.is_alive() and self._client is not None:
            self._client.close()

    def follow(self, control: str | None, epoch: int | None) -> None:
        """Talks to another render server from now on, of this epoch; one of another is taken for silent.

        Requests to the one before end without an answer. The new one gets source, views and scene.
        """
        client = None if control is None else RequestClient(control, keys=self._keys)
        before, self._client = self._client, client
        if before is not None:
            before.abandon()
        with self._asking:
            self._epoch, self._instance, self._has_scene = epoch, None, False
            self._answers, self._look_due_s, self._sent_watched = None, 0.0, None
            self._deliveries.forget()
        self._changed.set()
        if before is not None:
            before.close()

    @property
    def is_reachable(self) -> bool:
        """Whether the server answered the last request; False before the first."""
        return self._answers is True

    @property
    def newest_delivery(self) -> DeliveryStatus | None:
        """The status of the last change that was sent."""
        return self._deliveries.newest

    def delivery(self, scene: StoredScene) -> DeliveryStatus | None:
        """Returns the status of the last change of a scene that was sent; None for a scene that is not shown."""
        newest = self._deliveries.newest
        if newest is not None and newest.scene_id == scene.head.id:
            return newest
        if not scene.head.is_active:
            return None
        return pending(_change(scene), SILENT if self._answers is False else BUSY)

    def show(self, scene: StoredScene) -> DeliveryStatus:
        """Sends a stored revision of the active scene; returns its status, or `pending` if that takes long.

        Does not wait for a server that did not answer the last request.
        """
        change = _change(scene)
        outcome = self._deliveries.expect(change)
        self._changed.set()
        if self._answers is False:
            return pending(change, SILENT)
        return self._deliveries.wait(change, outcome)

    def command(
        self, op: str, payload: dict[str, object] | None = None, timeout_s: float = COMMAND_TIMEOUT_S
    ) -> dict[str, object]:
        """Executes a command at the render server, after those that wait, and returns the payload of its reply.

        Raises:
            UnansweredError: the server does not answer.
            DeltalightError: the server refused the command.
        """
        self._refuse_where_silent()
        return self._execute(op, payload, timeout_s)

    def watch(self, views: Sequence[ShownView]) -> None:
        """Has frames rendered in these views beside the scene's own, as soon as the server takes it."""
        self._watched = tuple(views)
        self._changed.set()

    def look_again(self) -> None:
        """Sends the active scene if it is not what the server has: somebody else changed it."""
        self._changed.set()

    def use_source(self, endpoints: Sequence[str] | None) -> None:
        """Makes the server read frames from these endpoints, also after its restart; None = from its own nodes.

        Calls `on_source` with the endpoints.

        Raises:
            UnansweredError: the server does not answer; it will be told once it does.
            DeltalightError: the server refused the endpoints.
        """
        self._source = None if endpoints is None else list(endpoints)
        self.on_source(self._source)
        self._refuse_where_silent()
        self._execute("set_source", {"endpoints": self._source}, COMMAND_TIMEOUT_S)

    def _execute(self, op: str, payload: dict[str, object] | None, timeout_s: float) -> dict[str, object]:
        with self._asking:
            if self._changed.is_set():
                self._send_newest()
                self._send_watched()
            self._refuse_where_silent()  # the first check may just have found no server
            self._require_alive()
            return self._request(op, timeout_s, payload)

    def _refuse_where_silent(self) -> None:
        if self._answers is False:
            raise UnansweredError(
                "The render server does not answer; check that it is running, then try again."
            )

    def _require_alive(self) -> None:
        """Detects a dead server within a second; only the renderer knows how long its commands take."""
        try:
            self._request(CLOCK_OP, ALIVE_TIMEOUT_S)
        except UnansweredError:
            self._note_reachable(False)
            self._refuse_where_silent()

    def _send_newest(self) -> None:
        """Sends the newest revision of the active scene unless the server has it (while holding the lock)."""
        self._changed.clear()
        awaited = self._deliveries.awaited
        active = self._store.scenes.active()
        if active is None:
            return
        change, before = _change(active), self._deliveries.newest
        if before is not None and before.change == change and before.state != "pending":
            status = before
        elif self._answers is False:
            status = pending(change, SILENT)
        else:
            status = self._send(active)
        self._deliveries.note(status, awaited)
        if status != before:
            self._on_delivery(status)

    def _send_watched(self) -> None:
        """Tells the server which views are looked at, unless it knows (while holding the lock)."""
        watched = self._watched
        is_due = bool(watched) and time.monotonic() >= self._watch_due_s
        if not self._answers or (watched == self._sent_watched and not is_due):
            return
        try:
            self._request("watch", COMMAND_TIMEOUT_S, {"views": list(watched)})
        except UnansweredError:
            self._note_reachable(False)
            return
        except DeltalightError as fault:  # viewers see the scene's own view
            log.warning("the render server shows no other views", fault=str(fault))
        self._sent_watched = watched
        self._watch_due_s = time.monotonic() + WATCH_INTERVAL_S

    def _send(self, active: StoredScene) -> DeliveryStatus:
        revision = active.document.revision
        try:
            self._request(CLOCK_OP, ALIVE_TIMEOUT_S)
            self._set_scene(active)
        except UnansweredError:
            self._note_reachable(False)
            return pending(_change(active), SILENT)
        except DeltalightError as refusal:
            return self._refused(active, refusal)
        return DeliveryStatus("shown", active.head.id, revision)

    def _refused(self, active: StoredScene, refusal: DeltalightError) -> DeliveryStatus:
        """Returns the status of a refused scene; another web process may have sent a newer revision meanwhile."""
        revision = active.document.revision
        with suppress(DeltalightError):
            server = self._request("ping", ALIVE_TIMEOUT_S)
            newest = server.get("revision")
            if server.get("scene_id") == active.head.id and isinstance(newest, int) and newest > revision:
                return pending(_change(active), BUSY)  # until the next look
        detail = self._store.assets.without_paths(str(refusal))
        return DeliveryStatus("refused", active.head.id, revision, detail)

    def _set_scene(self, active: StoredScene) -> None:
        """Sends the scene.

        The first one without a revision, so that the server does not compare it with older ones.
        """
        if self._instance is None:
            self._instance = self._server_instance()
        scene = self._store.assets.localised(active.document).model_dump(mode="json")
        revision = active.document.revision if self._has_scene else None
        self._request(
            "set_scene", COMMAND_TIMEOUT_S, {"scene": scene}, scene_id=active.head.id, revision=revision
        )
        self._has_scene = True
        self._look_due_s = time.monotonic() + LOOK_INTERVAL_S

    def _server_instance(self) -> str:
        server = self._request("ping", COMMAND_TIMEOUT_S)
        if self._epoch is not None and server.get("epoch") != self._epoch:
            raise UnansweredError(f"The render server there is not the one of epoch {self._epoch}.")
        return str(server["instance"])

    def _run(self) -> None:
        """Sends changes; checks the server at first, and after each second of silence."""
        while not self._stop.is_set():
            try:
                with self._asking:
                    self._check_if_due()
                    self._send_newest()
                    self._send_watched()
            except (DeltalightError, OSError) as fault:
                log.warning("the render server cannot be kept up to date", fault=str(fault))
            self._changed.wait(max(0.0, self._look_due_s - time.monotonic()))

    def _check_if_due(self) -> None:
        if time.monotonic() < self._look_due_s:
            return
        try:
            self._check_server()
        finally:
            self._look_due_s = time.monotonic() + LOOK_INTERVAL_S

    def _check_server(self) -> None:
        """Checks whether the server answers; sends source and scene to one that (re)started."""
        answered_before = self._answers
        try:
            self._request(CLOCK_OP, ALIVE_TIMEOUT_S)
            # It answers even while the renderer is busy, e.g. compiling shaders for its first picture.
            self._note_reachable(True)
            instance = self._server_instance()
            is_new = instance != self._instance  # it was (re)started
            if is_new or not answered_before:
                self._restore_source()
                self._sent_watched = None
        except UnansweredError:
            self._note_reachable(False)
            return
        if is_new:
            self._deliveries.forget()
            self._instance, self._has_scene = instance, False

    def _restore_source(self) -> None:
        """Tells a (re)started server where to read from; its source may be left from a killed service."""
        if not self._chooses_source:
            return
        try:
            self._request("set_source", COMMAND_TIMEOUT_S, {"endpoints": self._source})
        except UnansweredError:
            raise
        except DeltalightError as fault:  # pictures of the wrong source are better than no scene
            log.warning("the render server keeps its source", fault=str(fault))

    def _note_reachable(self, reachable: bool) -> None:
        if reachable != self._answers:
            log.info("render server answers" if reachable else "render server does not answer")
        self._answers = reachable

    def _request(
        self,
        op: str,
        timeout_s: float,
        payload: dict[str, object] | None = None,
        *,
        scene_id: str | None = None,
        revision: int | None = None,
    ) -> dict[str, object]:
        request = ControlRequest(
            node=self._name,
            capture_ns=time.time_ns(),
            id=uuid.uuid4().hex,
            op=op,
            payload=payload or {},
            scene_id=scene_id,
            revision=revision,
        )
        client = self._client
        if client is None:
            raise UnansweredError("There is no render server now; see what the room waits for.")
        try:
            reply = client.request(request, timeout_s)
        except EnvelopeError:
            raise
        except DeltalightError as fault:
            raise UnansweredError(str(fault)) from fault
        if reply.error is not None:
            raise DeltalightError(reply.error)
        return reply.payload


class UnansweredError(DeltalightError):
    """The render server did not answer in time."""


def _change(scene: StoredScene) -> Change:
    return Change(scene.head.id, scene.document.revision)
