"""Names by which this service may be reached.

A page of another site can make its own name resolve to this host's address (DNS rebinding), after which the browser
takes the service for that site. It still sends that name as Host, so requests for unknown names are refused.
"""

import socket
from collections.abc import Iterable
from ipaddress import ip_address
from urllib.parse import urlsplit

from deltalight.services.api.problems import ProblemError
from deltalight.services.ports import LOOPBACK

LOOPBACK_NAMES = frozenset({LOOPBACK, "localhost", "::1"})


class HostNames:
    """Checks the Host header of requests.

    On loopback, where no token is needed, it must be a name of loopback. Elsewhere it may be any IP address, which no
    name can pretend to be, a name of this host, or one that is `allowed`.
    """

    def __init__(self, *, on_loopback: bool, allowed: Iterable[str] = ()) -> None:
        self._on_loopback = on_loopback
        self._names = LOOPBACK_NAMES if on_loopback else LOOPBACK_NAMES | own_names() | set(allowed)

    def require(self, host: str) -> None:
        """Checks the value of a Host header.

        Raises:
            ProblemError: it names something else.
        """
        name = _name(host)
        if name in self._names or (not self._on_loopback and _is_address(name)):
            return
        if self._on_loopback:
            sentence = "This service is only reachable on loopback; open it as 127.0.0.1 or localhost."
        else:
            sentence = (
                f"This service is not known as {name!r:.80}; open it by its IP address, or add the name to "
                "`allowed_hosts` in [api] of deltalight.toml."
            )
        raise ProblemError(400, "host", sentence)


def own_names() -> frozenset[str]:
    """Returns this host's names: its own, that with its domain, and that in the local network (mDNS)."""
    name = socket.gethostname().lower()
    return frozenset({name, socket.getfqdn().lower(), f"{name.partition('.')[0]}.local"} - {""})


def _name(host: str) -> str:
    """Returns the name in a Host header, without its port; empty if there is none."""
    try:
        name = urlsplit(f"//{host}").hostname or ""
    except ValueError:
        return ""
    return name.removesuffix(".")


def _is_address(name: str) -> bool:
    try:
        ip_address(name)
    except ValueError:
        return False
    return True
