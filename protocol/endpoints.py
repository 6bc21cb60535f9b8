"""Endpoints of the wire: `tcp://[NAME@]HOST:PORT` and `ipc://PATH` (SPEC.md, section 5)."""

import ipaddress
import re
from dataclasses import dataclass

from deltalight.protocol.errors import DeltalightError

_TCP = re.compile(
    r"tcp://(?:(?P<peer>[A-Za-z0-9][A-Za-z0-9_-]{0,63})@)?"
    r"(?P<host>\[[0-9A-Fa-f:.]+\]|[^:/@\[\]]+):(?P<port>\d{1,5}|\*)"
)
_IPC = re.compile(r"ipc://.+")
MAX_PORT = 65535


@dataclass(frozen=True)
class Endpoint:
    """An endpoint as ZeroMQ takes it (`address`), and the name of the host's key, if one is written.

    `host` and `port` are None for `ipc://`; a port `*` is 0.
    """

    address: str
    peer: str | None = None
    host: str | None = None
    port: int | None = None

    @property
    def is_tcp(self) -> bool:
        """Whether it uses the network stack."""
        return self.host is not None

    @property
    def leaves_host(self) -> bool:
        """Whether it can be reached from, or reaches, another host."""
        return self.host is not None and not is_loopback(self.host)

    @property
    def needs_keys(self) -> bool:
        """Whether it must not be used without keys."""
        return self.leaves_host or self.peer is not None


def parse_endpoint(endpoint: str) -> Endpoint:
    """Parses an endpoint.

    Raises:
        DeltalightError: its transport or form is not supported.
    """
    if _IPC.fullmatch(endpoint):
        return Endpoint(endpoint)
    parts = _TCP.fullmatch(endpoint)
    if parts is None or (parts["port"] != "*" and int(parts["port"]) > MAX_PORT):
        raise DeltalightError(f"{endpoint} is not an endpoint; write tcp://127.0.0.1:PORT or ipc://PATH.")
    host, port = parts["host"], parts["port"]
    return Endpoint(f"tcp://{host}:{port}", parts["peer"], host.strip("[]"), 0 if port == "*" else int(port))


def is_loopback(host: str) -> bool:
    """Whether a host name or address means this host only."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False
