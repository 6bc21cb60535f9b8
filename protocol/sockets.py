"""Common to all sockets of the wire: contexts, allowed endpoints, and socket options (SPEC.md, section 5)."""

import threading

import zmq

from deltalight.protocol.curve import Context, secure
from deltalight.protocol.endpoints import Endpoint, parse_endpoint
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.keys import CREATE_HINT, Keys
from deltalight.protocol.messages import MAX_PART_BYTES

HIGH_WATER_MARK = 2  # frames; with the default of 1000 a slow consumer saw frames that were seconds old
# What the kernel may hold for one subscriber. It would take megabytes by itself, which on a slow network are seconds.
SEND_BUFFER_BYTES = 1 << 17
RECONNECT_MS = 100
RECONNECT_MAX_MS = 1000
# The kernel finds dead peers, after 30 s. Not ZeroMQ's heartbeats: libzmq 4.3.5 aborts the process (`!_io_error`) at
# the next of them where a peer hung up while the queue of what it had sent was full.
KEEPALIVE_IDLE_S, KEEPALIVE_INTERVAL_S, KEEPALIVE_PROBES = 10, 5, 4
HANDSHAKE_MS = 10_000  # who says nothing for so long takes nobody's place

_contexts: set[Context] = set()
_contexts_lock = threading.Lock()


def open_context() -> Context:
    """Creates a context, and keeps it until it is ended.

    One that is forgotten stays. Its finalizer would stop whatever thread collects garbage for ever: it waits for the
    context's sockets, which are collected with it and of which it no longer knows.
    """
    context: Context = zmq.Context()
    with _contexts_lock:
        _contexts.difference_update([each for each in _contexts if each.closed])
        _contexts.add(context)
    return context


def check_endpoint(endpoint: str, keys: Keys | None = None) -> Endpoint:
    """Parses an endpoint: without keys, `tcp://` on loopback or `ipc://`; with keys any `tcp://`.

    Raises:
        DeltalightError: another transport, or it leaves the host and there are no keys.
    """
    parts = parse_endpoint(endpoint)
    if parts.needs_keys and keys is None:
        raise DeltalightError(
            f"{endpoint} is reachable from other hosts, which requires keys; {CREATE_HINT}, or use 127.0.0.1."
        )
    return parts


def open_socket(
    context: Context,
    kind: int,
    *,
    high_water_mark: int = HIGH_WATER_MARK,
    max_bytes: int = MAX_PART_BYTES,
) -> zmq.Socket[bytes]:
    """Creates a socket with queues of `high_water_mark` messages, pieces up to `max_bytes`, no linger, keepalive."""
    socket = context.socket(kind)
    socket.linger = 0
    if kind == zmq.PUB:
        socket.sndhwm = high_water_mark
        socket.sndbuf = SEND_BUFFER_BYTES
    else:  # a SUB socket sends its subscriptions, and loses those beyond its send mark
        socket.rcvhwm = high_water_mark
    socket.maxmsgsize = max_bytes
    socket.reconnect_ivl = RECONNECT_MS
    socket.reconnect_ivl_max = RECONNECT_MAX_MS
    socket.handshake_ivl = HANDSHAKE_MS
    socket.tcp_keepalive = 1
    socket.tcp_keepalive_idle = KEEPALIVE_IDLE_S
    socket.tcp_keepalive_intvl = KEEPALIVE_INTERVAL_S
    socket.tcp_keepalive_cnt = KEEPALIVE_PROBES
    return socket


def attach(socket: zmq.Socket[bytes], endpoint: str, *, bind: bool, keys: Keys | None = None) -> str:
    """Binds or connects; returns the endpoint with its actual port (port 0 lets the system choose).

    Raises:
        DeltalightError: the endpoint leaves the host without keys, is taken, or is malformed.
    """
    parts = check_endpoint(endpoint, keys)
    secure(socket, parts, keys, bind=bind)
    socket.ipv6 = "[" in endpoint  # if on, IPv4 addresses come back in their IPv6 form
    try:
        (socket.bind if bind else socket.connect)(parts.address)
    except zmq.ZMQError as error:
        verb = "listen at" if bind else "connect to"
        reason = zmq.strerror(error.errno or 0)  # the error's own text would name the endpoint again
        raise DeltalightError(
            f"cannot {verb} {endpoint} ({reason}); choose another, or stop the program that holds it."
        ) from error
    return socket.get_string(zmq.LAST_ENDPOINT)
