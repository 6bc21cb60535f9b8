"""Control by request and reply: a client with timeouts, and a server that executes nothing twice."""

import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

import structlog
import zmq

from deltalight.protocol.clock import CLOCK_OP
from deltalight.protocol.curve import guard, sender_key
from deltalight.protocol.envelope import EnvelopeError
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.keys import Keys
from deltalight.protocol.message_fields import as_sentence
from deltalight.protocol.messages import MAX_PAYLOAD_BYTES, SCHEMA_VERSION, ControlReply, ControlRequest
from deltalight.protocol.payloads import Control, decode_control, encode_control
from deltalight.protocol.rights import CONTROL, Rights, refusal
from deltalight.protocol.sockets import attach, open_context, open_socket

OPEN_OPS = (CLOCK_OP, "ping")  # for every trusted host: nodes compare clocks
UNREADABLE_ID = "unreadable"
REMEMBERED_REPLIES = 256
MAX_PIECE_BYTES = MAX_PAYLOAD_BYTES + 4096  # CURVE adds to each piece
REMEMBERED_BYTES = 16 * 1024 * 1024
ABANDONED_AFTER_MS = 100

Handler = Callable[[ControlRequest], dict[str, object]]
_log = structlog.get_logger(__name__)


@dataclass(frozen=True)
class _Applied:
    scene_id: str | None
    revision: int
    payload: dict[str, object]
    reply: ControlReply


class ReplyMemory:
    """Makes control idempotent: by request id, and by revision of a scene for each op (SPEC.md, section 6)."""

    def __init__(self, size: int = REMEMBERED_REPLIES) -> None:
        self._size = size
        self._by_id: OrderedDict[str, tuple[ControlReply, int]] = OrderedDict()
        self._bytes = 0
        self._applied: dict[str, _Applied] = {}

    def find(self, request: ControlRequest) -> ControlReply | None:
        """Returns the reply to an earlier request that this one repeats.

        Raises:
            DeltalightError: its revision is older than the applied one, or is the same with other content.
        """
        if request.id in self._by_id:
            return self._by_id[request.id][0]
        last = self._applied.get(request.op)
        if last is None or request.revision is None or request.scene_id != last.scene_id:
            return None
        if request.revision > last.revision:
            return None
        if request.revision < last.revision or request.payload != last.payload:
            raise DeltalightError(
                f"revision {request.revision} of {request.op} is not newer than the applied {last.revision}; "
                f"send {last.revision + 1} or higher."
            )
        return last.reply.model_copy(update={"id": request.id})

    def remember(self, request: ControlRequest, reply: ControlReply, length: int) -> None:
        """Remembers a reply of `length` bytes; a refused request may come again with the same revision."""
        self._by_id[request.id] = reply, length
        self._bytes += length
        while len(self._by_id) > self._size or self._bytes > REMEMBERED_BYTES:
            self._bytes -= self._by_id.popitem(last=False)[1][1]
        if not reply.ok:
            return
        self._applied.pop(request.op, None)
        if request.revision is not None:
            applied = _Applied(request.scene_id, request.revision, request.payload, reply)
            self._applied[request.op] = applied


LAST_REPLY_MS = 200  # how long a closing server waits for its last reply to leave


class ReplyServer:
    """Answers requests in a thread that owns the socket.

    `handler(request)` returns the payload of the reply; a `DeltalightError` from it refuses the request. `keys` are
    required if the endpoint leaves the host.
    """

    def __init__(
        self, endpoint: str, handler: Handler, *, node: str = "server", keys: Keys | None = None
    ) -> None:
        self._handler = handler
        self._node = node
        self._memory = ReplyMemory()
        self._answering = threading.Lock()
        self._context = open_context()
        self._socket = open_socket(self._context, zmq.REP, max_bytes=MAX_PIECE_BYTES)
        self._guard = guard(self._context, self._socket, keys, bind=True)
        self._rights = None if keys is None else Rights(keys)
        try:
            self.endpoint = attach(self._socket, endpoint, bind=True, keys=keys)
        except DeltalightError:
            if self._guard is not None:
                self._guard.close()
            self._context.destroy(0)
            raise
        self._thread = threading.Thread(target=self._run, name="control", daemon=True)
        self._thread.start()

    @property
    def refused(self) -> int:
        """Connections that were refused because their keys are not right."""
        return 0 if self._guard is None else self._guard.refused

    @property
    def not_allowed(self) -> int:
        """Requests that were refused because their host's key allows no commands."""
        return 0 if self._rights is None else self._rights.refused

    def close(self) -> None:
        """Stops the thread after the reply to the current request was sent."""
        with self._answering:
            pass
        if self._guard is not None:
            self._guard.close()
        self._context.term()
        self._thread.join()

    def _run(self) -> None:
        try:
            while True:
                frames = self._socket.recv_multipart(copy=False)
                sender = sender_key(frames[0])
                with self._answering:
                    self._socket.send_multipart(self._answer([frame.bytes for frame in frames], sender))
        except zmq.ContextTerminated:
            pass
        finally:
            self._socket.close(LAST_REPLY_MS)

    def _answer(self, multipart: list[bytes], sender: bytes | None) -> list[bytes]:
        try:
            request = decode_control(multipart, ControlRequest)
        except EnvelopeError as error:
            return encode_control(self._reply(UNREADABLE_ID, error=str(error)))
        try:
            self._require_right(sender, request)
            earlier = self._memory.find(request)
        except DeltalightError as error:
            return encode_control(
                _in_version(self._reply(request.id, error=str(error)), request.schema_version)
            )
        if earlier is not None:
            return encode_control(_in_version(earlier, request.schema_version))
        reply, pieces = self._encoded(_in_version(self._answered(request), request.schema_version))
        self._memory.remember(request, reply, sum(len(piece) for piece in pieces))
        return pieces

    def _require_right(self, sender: bytes | None, request: ControlRequest) -> None:
        rights = self._rights
        if rights is None or sender is None or request.op in OPEN_OPS or rights.lets(sender, CONTROL):
            return
        raise DeltalightError(refusal(rights.name_of(sender), CONTROL))

    def _encoded(self, reply: ControlReply) -> tuple[ControlReply, list[bytes]]:
        try:
            return reply, encode_control(reply)
        except EnvelopeError as error:
            told = self._reply(reply.id, error=f"the answer cannot be sent: {error}")
            told = _in_version(told, reply.schema_version)
            return told, encode_control(told)

    def _answered(self, request: ControlRequest) -> ControlReply:
        try:
            return self._reply(request.id, payload=self._handler(request))
        except DeltalightError as error:
            return self._reply(request.id, error=str(error))
        except Exception as error:  # the thread must survive a fault of the handler
            with suppress(OSError):  # of which no open file may be left for the log
                _log.exception("control handler failed", op=request.op)
            return self._reply(
                request.id, error=f"{request.op} failed with {error!r:.300}: see the log of {self._node}"
            )

    def _reply(
        self, request_id: str, *, payload: dict[str, object] | None = None, error: str | None = None
    ) -> ControlReply:
        return ControlReply(
            node=self._node,
            capture_ns=time.time_ns(),
            id=request_id,
            ok=error is None,
            error=None if error is None else as_sentence(error),
            payload=payload or {},
        )


class RequestClient:
    """Sends requests to one `ReplyServer`, one at a time; threads may share it.

    A request without an answer may be repeated unchanged: its id prevents a second execution. A server that reads
    only an older schema version says so in that version, and is asked in it from then on. `keys` are required if the
    endpoint leaves the host.
    """

    def __init__(self, endpoint: str, *, keys: Keys | None = None) -> None:
        self.endpoint = endpoint
        self._keys = keys
        self._context = open_context()
        self._lock = threading.Lock()
        self._abandoned = threading.Event()
        self._socket: zmq.Socket[bytes] | None = None
        self._version = SCHEMA_VERSION
        try:
            self._connected()
        except DeltalightError:
            self._context.destroy(0)
            raise

    def request(self, control: ControlRequest, timeout_s: float) -> ControlReply:
        """Sends `control` and returns the reply; check its `ok` and `error`.

        Raises:
            DeltalightError: there was no answer within `timeout_s` seconds, or the server could not read the request.
        """
        deadline = time.monotonic() + timeout_s
        if not self._lock.acquire(timeout=timeout_s):
            raise DeltalightError(f"{self.endpoint} is still busy with another request; try again.")
        try:
            reply = self._asked(control, deadline, timeout_s)
            if reply.id == UNREADABLE_ID and reply.schema_version < self._version:
                self._version = reply.schema_version
                reply = self._asked(control, deadline, timeout_s)
            return _matched(control, reply)
        except DeltalightError:
            self._drop()
            raise
        finally:
            self._lock.release()

    def _asked(self, control: ControlRequest, deadline: float, timeout_s: float) -> ControlReply:
        """Sends `control` in the server's version, and returns what comes back."""
        socket = self._connected()
        if not _exchange(
            socket, encode_control(_in_version(control, self._version)), deadline, self._abandoned
        ):
            trust = "" if self._keys is None else f" and trusts {self._keys.name}.key"
            raise DeltalightError(
                f"no answer from {self.endpoint} within {timeout_s:g} s; check that the server is running{trust}."
            )
        return decode_control(socket.recv_multipart(), ControlReply)

    def abandon(self) -> None:
        """Waits for no answers any more: the server is gone; requests end soon, without one (any thread)."""
        self._abandoned.set()

    def close(self) -> None:
        """Closes the socket."""
        with self._lock:
            self._context.destroy(0)

    def _connected(self) -> "zmq.Socket[bytes]":
        if self._context.closed:
            raise DeltalightError(f"the client of {self.endpoint} is closed; open a new one to ask.")
        if self._socket is None:
            self._socket = open_socket(self._context, zmq.REQ, max_bytes=MAX_PIECE_BYTES)
            attach(self._socket, self.endpoint, bind=False, keys=self._keys)
        return self._socket

    def _drop(self) -> None:
        """Replaces the socket, so that the next request meets neither a late answer nor a dead server's queue."""
        if self._socket is not None:
            self._socket.close(0)
            self._socket = None
        self._version = SCHEMA_VERSION  # whoever listens there next may speak a newer one


def _exchange(
    socket: "zmq.Socket[bytes]", multipart: list[bytes], deadline: float, abandoned: threading.Event
) -> bool:
    """Sends a request; returns whether an answer came before `deadline` (`time.monotonic`), or it was abandoned."""
    # If the other end refused the connection no pipe is left, and a plain send would block forever.
    socket.sndtimeo = _left_ms(deadline)
    try:
        socket.send_multipart(multipart)
    except zmq.Again:
        return False
    while not abandoned.is_set():
        left_ms = _left_ms(deadline)
        if socket.poll(min(left_ms, ABANDONED_AFTER_MS), zmq.POLLIN):
            return True
        if left_ms <= ABANDONED_AFTER_MS:
            return False
    return False


def _left_ms(deadline: float) -> int:
    return max(0, round((deadline - time.monotonic()) * 1000))


def _in_version(message: Control, version: int) -> Control:
    """Returns a request or reply as an older version writes it: none has changed since the oldest that is read."""
    return message.model_copy(update={"schema_version": version})


def _matched(control: ControlRequest, reply: ControlReply) -> ControlReply:
    if reply.id == UNREADABLE_ID:
        raise EnvelopeError(f"the server cannot read the request: {reply.error}")
    if reply.id != control.id:
        raise EnvelopeError(
            f"the answer belongs to request {reply.id} and not to {control.id}: send it again"
        )
    return reply
