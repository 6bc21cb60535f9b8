"""What all sockets of the wire share: which endpoints are allowed, and their options (SPEC.md, section 5)."""

import ipaddress
import re

import zmq

from protocol.errors import DeltalightError
from protocol.messages import MAX_PART_BYTES

HIGH_WATER_MARK = 2  # frames; the default of 1000 showed a slow consumer frames that were seconds old
RECONNECT_MS = 100
RECONNECT_MAX_MS = 1000
HEARTBEAT_MS = 1000
HEARTBEAT_TIMEOUT_MS = 3000
_TCP = re.compile(r"tcp://(?P<host>\[[0-9A-Fa-f:.]+\]|[^:/\[\]]+):(?P<port>\d{1,5}|\*)")
_IPC = re.compile(r"ipc://.+")


def check_endpoint(endpoint: str) -> None:
    """Accept `tcp://` on loopback and `ipc://`: without CURVE keys nothing may leave the host.

    Raises:
        DeltalightError: another transport, or a host that is not loopback.
    """
    if _IPC.fullmatch(endpoint):
        return
    parts = _TCP.fullmatch(endpoint)
    if parts is None:
        raise DeltalightError(f"{endpoint} is not an endpoint: write tcp://127.0.0.1:PORT or ipc://PATH")
    if not _is_loopback(parts["host"]):
        raise DeltalightError(
            f"{endpoint} leaves this host, and without keys it may not: use 127.0.0.1, or a tunnel to it"
        )


def _is_loopback(host: str) -> bool:
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


def open_socket(
    context: zmq.Context[zmq.Socket[bytes]],
    kind: int,
    *,
    high_water_mark: int = HIGH_WATER_MARK,
    max_bytes: int = MAX_PART_BYTES,
) -> zmq.Socket[bytes]:
    """Socket with queues of `high_water_mark` messages, pieces up to `max_bytes`, no linger, heartbeats."""
    socket = context.socket(kind)
    socket.linger = 0
    if kind == zmq.PUB:
        socket.sndhwm = high_water_mark
    else:  # a SUB socket sends its subscriptions, and loses those beyond its send mark
        socket.rcvhwm = high_water_mark
    socket.maxmsgsize = max_bytes
    socket.reconnect_ivl = RECONNECT_MS
    socket.reconnect_ivl_max = RECONNECT_MAX_MS
    socket.heartbeat_ivl = HEARTBEAT_MS
    socket.heartbeat_timeout = HEARTBEAT_TIMEOUT_MS
    return socket


def attach(socket: zmq.Socket[bytes], endpoint: str, *, bind: bool) -> str:
    """Bind or connect; returns the endpoint with the port that was got (port 0 lets the system choose).

    Raises:
        DeltalightError: the endpoint leaves the host, is taken, or is not understood.
    """
    check_endpoint(endpoint)
    socket.ipv6 = "[" in endpoint  # where it is on, IPv4 addresses come back in their IPv6 form
    try:
        (socket.bind if bind else socket.connect)(endpoint)
    except zmq.ZMQError as error:
        verb = "listen at" if bind else "connect to"
        raise DeltalightError(
            f"cannot {verb} {endpoint} ({error.strerror}): choose another, or stop the program that holds it"
        ) from error
    return socket.get_string(zmq.LAST_ENDPOINT)
