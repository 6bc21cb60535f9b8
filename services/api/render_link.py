"""Keeps the render server at the newest revision of the active scene."""

import threading
import time
import uuid
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import structlog

from protocol.clock import CLOCK_OP
from protocol.envelope import EnvelopeError
from protocol.errors import DeltalightError
from protocol.keys import Keys
from protocol.messages import ControlRequest
from protocol.transport import RequestClient
from services.api.live_hub import ShownScene
from services.storage.scenes import StoredScene
from services.storage.store import Store

LOOK_INTERVAL_S = 1.0
ALIVE_TIMEOUT_S = 1.0  # the server's own thread answers this, whatever the renderer does
COMMAND_TIMEOUT_S = 25.0  # the server gives up after 20 s itself
REMEMBERED_REVISIONS = 1024  # half a minute of a gesture's changes; pictures are a few frames behind

log = structlog.get_logger()


@dataclass(frozen=True)
class Picture:
    """What became of the newest revision: `shown` = from the next frame on, `pending` = the server does not answer,
    `refused` = it cannot render it and shows what it had before."""

    state: Literal["shown", "pending", "refused"]
    scene_id: str
    revision: int
    detail: str = ""


class RenderLink:
    """Sends the active scene to the render server, at once after a change and again after its restart.

    The server counts revisions of its own, across scenes: each sending is its newest plus one.
    """

    def __init__(
        self,
        store: Store,
        control: str,
        keys: Keys | None = None,
        *,
        on_picture: Callable[[Picture], None] = lambda _picture: None,
    ) -> None:
        self._store = store
        self._on_picture = on_picture
        self._client = RequestClient(control, keys=keys)
        self._sending = threading.Lock()
        self._answers: bool | None = None  # not asked yet
        self._server_revision: int | None = None
        self._picture: Picture | None = None
        self._source: list[str] | None = None
        self.on_source: Callable[[Sequence[str] | None], None] = lambda _endpoints: None
        self._sent: OrderedDict[int, ShownScene] = OrderedDict()  # by the server's revision
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._look, name="render-link", daemon=True)

    def start(self) -> None:
        """Begin to watch the server."""
        self._thread.start()

    def close(self) -> None:
        """Stop watching."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join(timeout=ALIVE_TIMEOUT_S)
        if (
            not self._thread.is_alive()
        ):  # else it waits for a renderer that hangs: the process ends without it
            self._client.close()

    @property
    def is_reachable(self) -> bool:
        """Whether the server answered when it was last asked; not before it was asked."""
        return self._answers is True

    @property
    def picture(self) -> Picture | None:
        """What the last sending came to."""
        return self._picture

    def refresh(self) -> Picture | None:
        """Send the newest revision of the active scene unless the server has it; None without an active scene.

        While a server that did not answer is being looked for, this does not wait for it.
        """
        with self._sending:
            active = self._store.scenes.active()
            if active is None or self._is_settled(active):
                return self._picture
            picture = _pending(active) if self._answers is False else self._send(active)
            if picture != self._picture:
                self._picture = picture
                self._on_picture(picture)
            return picture

    def shown(self, server_revision: int | None) -> ShownScene | None:
        """Which scene a picture shows, made with a revision of the server's; None where that came from elsewhere."""
        return None if server_revision is None else self._sent.get(server_revision)

    def command(
        self, op: str, payload: dict[str, object] | None = None, timeout_s: float = COMMAND_TIMEOUT_S
    ) -> dict[str, object]:
        """Carry out a command at the render server, after those that wait; gives the payload of the reply.

        Raises:
            UnansweredError: it does not answer.
            DeltalightError: it refused the command.
        """
        self._refuse_where_silent()
        with self._sending:
            self._refuse_where_silent()  # the first look may just have found nobody
            self._require_alive()
            return self._ask(op, timeout_s, payload)

    def use_source(self, endpoints: Sequence[str] | None) -> None:
        """Let the server read frames from there, None = from its own nodes; a server that was restarted too.

        `on_source` hears of it.

        Raises:
            UnansweredError: it does not answer, and is told as soon as it does.
            DeltalightError: it refused the endpoints.
        """
        self._source = None if endpoints is None else list(endpoints)
        self.on_source(self._source)
        self.command("set_source", {"endpoints": self._source})

    def _refuse_where_silent(self) -> None:
        if self._answers is False:
            raise UnansweredError("The render server does not answer; see that it runs, then try again.")

    def _require_alive(self) -> None:
        """Find out within a second that a server has died; how long its commands take, only the renderer knows."""
        try:
            self._ask(CLOCK_OP, ALIVE_TIMEOUT_S)
        except UnansweredError:
            self._note_reachable(False)
            self._refuse_where_silent()

    def _is_settled(self, active: StoredScene) -> bool:
        picture = self._picture
        return (
            picture is not None
            and picture.state != "pending"
            and (picture.scene_id, picture.revision) == (active.head.id, active.document.revision)
        )

    def _send(self, active: StoredScene) -> Picture:
        revision = active.document.revision
        try:
            self._ask(CLOCK_OP, ALIVE_TIMEOUT_S)
            self._set_scene(active)
        except UnansweredError:
            self._note_reachable(False)
            return _pending(active)
        except DeltalightError as refusal:
            detail = self._store.assets.without_paths(str(refusal))
            return Picture("refused", active.head.id, revision, detail)
        return Picture("shown", active.head.id, revision)

    def _set_scene(self, active: StoredScene) -> None:
        scene = self._store.assets.localised(active.document).model_dump(mode="json")
        shown = ShownScene(active.head.id, active.document.revision)
        sent = (self._seen_revision() if self._server_revision is None else self._server_revision) + 1
        try:
            self._set_revision(sent, scene, shown)
        except UnansweredError:
            raise
        except DeltalightError:
            newest = self._seen_revision()
            if newest < sent:  # refused for what it is, not because somebody else changed the scene meanwhile
                raise
            self._set_revision(newest + 1, scene, shown)

    def _set_revision(self, number: int, scene: object, shown: ShownScene) -> None:
        """Noted before the server answers: a picture of it may come earlier than the answer."""
        self._sent[number] = shown
        while len(self._sent) > REMEMBERED_REVISIONS:
            self._sent.popitem(last=False)
        try:
            self._ask("set_scene", COMMAND_TIMEOUT_S, {"scene": scene}, revision=number)
        except UnansweredError:
            raise
        except DeltalightError:
            del self._sent[number]
            raise
        self._server_revision = number

    def _seen_revision(self) -> int:
        revision: Any = self._ask("ping", COMMAND_TIMEOUT_S)["revision"]
        return int(revision)

    def _look(self) -> None:
        """At once and then once a second: a server that came (back) gets the scene."""
        while not self._stop.is_set():
            try:
                self._look_once()
            except DeltalightError as fault:
                log.warning("the render server cannot be kept up to date", fault=str(fault))
            self._stop.wait(LOOK_INTERVAL_S)

    def _look_once(self) -> None:
        with self._sending:
            try:
                self._ask(CLOCK_OP, ALIVE_TIMEOUT_S)
                seen = self._seen_revision()
            except UnansweredError:
                self._note_reachable(False)
                return
            if self._server_revision is None or not self._answers:
                self._restore_source()
            self._note_reachable(True)
            if self._server_revision is None or seen < self._server_revision:  # it was started (again)
                self._picture = None
                self._sent.clear()
            self._server_revision = seen
        self.refresh()

    def _restore_source(self) -> None:
        """Tell a server that came (back) where to read from; one that is left from a killed service too."""
        try:
            self._ask("set_source", COMMAND_TIMEOUT_S, {"endpoints": self._source})
        except UnansweredError:
            raise
        except DeltalightError as fault:  # pictures of elsewhere are better than no scene
            log.warning("the render server keeps its source", fault=str(fault))

    def _note_reachable(self, reachable: bool) -> None:
        if reachable != self._answers:
            log.info("render server answers" if reachable else "render server does not answer")
        self._answers = reachable

    def _ask(
        self,
        op: str,
        timeout_s: float,
        payload: dict[str, object] | None = None,
        revision: int | None = None,
    ) -> dict[str, object]:
        request = ControlRequest(
            node="api",
            capture_ns=time.time_ns(),
            id=uuid.uuid4().hex,
            op=op,
            payload=payload or {},
            revision=revision,
        )
        try:
            reply = self._client.request(request, timeout_s)
        except EnvelopeError:
            raise
        except DeltalightError as fault:
            raise UnansweredError(str(fault)) from fault
        if reply.error is not None:
            raise DeltalightError(reply.error)
        return reply.payload


class UnansweredError(DeltalightError):
    """The render server did not answer in time."""


def _pending(active: StoredScene) -> Picture:
    detail = "The render server does not answer; the scene is shown as soon as it does."
    return Picture("pending", active.head.id, active.document.revision, detail)
