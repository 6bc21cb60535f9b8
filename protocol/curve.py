"""Keys on sockets: who may connect, and reports of refused connections."""

import threading
from typing import Any

import structlog
import zmq
from zmq.auth.thread import ThreadAuthenticator
from zmq.utils.monitor import recv_monitor_message

from deltalight.protocol.endpoints import Endpoint
from deltalight.protocol.keys import Keys

ZAP_DOMAIN = "deltalight"
POLL_MS = 200
STOP_S = 2.0
# Events of libzmq at both ends if the keys do not fit, and at the end with keys if the other has none.
REFUSALS = (
    zmq.EVENT_HANDSHAKE_FAILED_AUTH
    | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL
    | zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL
)
_log = structlog.get_logger(__name__)

Context = zmq.Context[zmq.Socket[bytes]]


def uses_keys(endpoint: Endpoint, keys: Keys | None) -> bool:
    """Whether connections of an endpoint are encrypted."""
    return keys is not None and (endpoint.needs_keys or (keys.on_loopback and endpoint.is_tcp))


def secure(socket: zmq.Socket[bytes], endpoint: Endpoint, keys: Keys | None, *, bind: bool) -> None:
    """Sets the keys, or none, for the next bind or connect of a socket.

    Raises:
        DeltalightError: the key of the host behind the endpoint is unknown.
    """
    if keys is None or not uses_keys(endpoint, keys):
        socket.curve_server = False  # also removes the keys of an earlier endpoint
        return
    socket.curve_publickey, socket.curve_secretkey = keys.public, keys.secret
    if bind:
        socket.curve_server = True
        # With a domain libzmq refuses everybody until an authenticator answers for it; without, it would let them in.
        socket.zap_domain = ZAP_DOMAIN.encode()
    else:
        socket.curve_serverkey = keys.peer(endpoint)


def sender_key(frame: zmq.Frame) -> bytes | None:
    """Returns the public key (Z85) of who sent a message to a bound socket; None without keys."""
    try:
        return str(frame.get("User-Id")).encode()  # as the authenticator told libzmq
    except zmq.ZMQError:
        return None


class Guard:
    """Lets trusted keys into the sockets that one context binds, and counts a socket's refused connections.

    Create it before the socket is bound or connected; close it before the context is terminated.

    Args:
        context: of the socket, and of nothing else that is bound.
        socket: the socket to watch.
        keys: own keys, and the trusted ones.
        bind: whether the socket is bound; otherwise only refusals by the other end are reported.
    """

    def __init__(self, context: Context, socket: zmq.Socket[bytes], keys: Keys, *, bind: bool) -> None:
        self.refused = 0
        self._keys, self._is_server = keys, bind
        self._closing = threading.Event()
        self._authenticator = ThreadAuthenticator(context) if bind else None
        if self._authenticator is not None:
            self._authenticator.configure_curve_callback(ZAP_DOMAIN, self)
            self._authenticator.start()
        address = f"inproc://refusals-{id(self)}"
        socket.monitor(address, REFUSALS)
        self._thread = threading.Thread(
            target=self._watch, args=(context, address), name="guard", daemon=True
        )
        self._thread.start()

    def callback(self, domain: str, key: bytes) -> bool:
        """Whether a client's public key (Z85) is trusted; called by the authenticator."""
        del domain
        return key in self._keys.trusted().values()

    def close(self) -> None:
        """Stops watching; nobody else is let in."""
        self._closing.set()
        self._thread.join(STOP_S)
        if self._authenticator is not None:
            self._authenticator.stop()

    def _watch(self, context: Context, address: str) -> None:
        told: set[int] = set()
        with context.socket(zmq.PAIR) as events:
            events.linger = 0
            events.connect(address)
            while not self._closing.is_set():
                if events.poll(POLL_MS):
                    self._count(recv_monitor_message(events), told)

    def _count(self, event: Any, told: set[int]) -> None:  # noqa: ANN401 - as pyzmq types it
        kind = int(event["event"])
        if not kind & REFUSALS:
            return
        self.refused += 1
        if kind not in told:  # a refused peer keeps trying
            told.add(kind)
            _log.warning("connection refused", endpoint=event["endpoint"].decode(), reason=self._reason(kind))

    def _reason(self, kind: int) -> str:
        own = f"{self._keys.name}.key"
        if kind == zmq.EVENT_HANDSHAKE_FAILED_AUTH:
            if self._is_server:
                return (
                    "its key is not trusted; if it is yours, run `deltalight keys trust` with its public key"
                )
            return f"our key is not trusted there; run `deltalight keys trust {own}` on that host"
        if self._is_server:
            return (
                f"it has no keys, or not our present key; give it {own} and run `deltalight keys trust` there"
            )
        return "the other end has no keys, or another than the trusted one"


def guard(context: Context, socket: zmq.Socket[bytes], keys: Keys | None, *, bind: bool) -> Guard | None:
    """Returns the guard of a socket, None without keys."""
    return None if keys is None else Guard(context, socket, keys, bind=bind)
