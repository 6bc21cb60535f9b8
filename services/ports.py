"""Loopback ports of the processes, and whether they are free."""

import random
import socket
from collections import deque
from collections.abc import Container, Sequence
from typing import NamedTuple

from deltalight.protocol.errors import DeltalightError

LOOPBACK = "127.0.0.1"
NODE_PORT = 5601  # a sensor node publishes
COMPOSITE_PORT = 5602  # the render server publishes
CONTROL_PORT = 5603  # the render server answers
ROOMS_PORT = 5604  # the directory of rooms answers
PAGE_PORT = 8000  # the web process serves dashboard, REST API and live video
PRIVATE_PORTS = range(20_000, 32_000)  # below the kernel's range for outgoing connections
REMEMBERED_PORTS = len(PRIVATE_PORTS) // 2  # of those that were used: a room may be placed without end


def endpoint(port: int) -> str:
    """Returns the ZeroMQ endpoint of a loopback port."""
    return f"tcp://{LOOPBACK}:{port}"


def is_free(port: int) -> bool:
    """Whether a server could listen on this loopback port now."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # a connection in TIME_WAIT is no server
        try:
            probe.bind((LOOPBACK, port))
        except OSError:
            return False
        return True


def answers(port: int) -> bool:
    """Whether a server accepts connections on this loopback port now."""
    try:
        socket.create_connection((LOOPBACK, port), timeout=0.5).close()
    except OSError:
        return False
    return True


def require_free(port: int, purpose: str, option: str) -> None:
    """Checks a port before anything starts.

    Raises:
        DeltalightError: another program listens on it.
    """
    if not is_free(port):
        raise DeltalightError(
            f"Port {port} ({purpose}) is in use by another program; stop it, or choose another with {option}."
        )


class ChosenPort(NamedTuple):
    """A port, what is to listen on it, and the option that chooses another."""

    port: int
    purpose: str
    option: str


def require_all_free(chosen: Sequence[ChosenPort]) -> None:
    """Checks the ports of one host before anything starts.

    Raises:
        DeltalightError: another program listens on one of them, or two are the same.
    """
    taken: dict[int, str] = {}
    for each in chosen:
        if each.port in taken:
            raise DeltalightError(
                f"Port {each.port} is given for both the {taken[each.port]} and the {each.purpose};"
                f" give {each.option} another."
            )
        taken[each.port] = each.purpose
    for each in chosen:
        require_free(*each)


def used_ports() -> deque[int]:
    """Returns an empty memory of the ports that were used last."""
    return deque(maxlen=REMEMBERED_PORTS)


def private_ports(count: int, avoid: Container[int] = ()) -> list[int]:
    """Returns free ports for one run's own processes, chosen so that two runs rarely collide, and none to `avoid`.

    Raises:
        DeltalightError: nearly all ports of the range are in use.
    """
    found: list[int] = []
    for port in random.sample(PRIVATE_PORTS, len(PRIVATE_PORTS)):
        if port not in avoid and is_free(port):
            found.append(port)
        if len(found) == count:
            return found
    raise DeltalightError(f"No {count} free ports between {PRIVATE_PORTS.start} and {PRIVATE_PORTS.stop}.")
