"""Announcement of a node on the local network: DNS service discovery over multicast (RFC 6762, RFC 6763)."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING

import structlog

from deltalight.protocol.endpoints import Endpoint, is_loopback, parse_endpoint
from deltalight.protocol.keys import Keys
from deltalight.protocol.messages import SCHEMA_VERSION

if TYPE_CHECKING:
    from zeroconf import ServiceInfo

SERVICE_TYPE = "_deltalight._tcp.local."
EVERY_ADDRESS = ("0.0.0.0", "::")
_log = structlog.get_logger(__name__)


def service_info(
    name: str, endpoint: Endpoint, streams: Sequence[str], keys: Keys | None, addresses: Sequence[str]
) -> "ServiceInfo":
    """Returns the announcement of a node.

    The TXT record holds `name`, `streams` (with commas), `schema` (version of the wire), `curve` (1 with keys, else
    0) and, with keys, the public `key`.
    """
    from zeroconf import ServiceInfo

    properties = {
        "name": name,
        "streams": ",".join(streams),
        "schema": str(SCHEMA_VERSION),
        "curve": "0" if keys is None else "1",
    }
    if keys is not None:
        properties["key"] = keys.public.decode()
    return ServiceInfo(
        SERVICE_TYPE,
        f"{name}.{SERVICE_TYPE}",
        port=endpoint.port,
        properties=properties,
        parsed_addresses=list(addresses),
    )


@contextmanager
def announced(
    name: str,
    endpoint: str,
    streams: Sequence[str],
    keys: Keys | None,
    *,
    interfaces: Sequence[str] | None = None,
) -> Iterator[None]:
    """Announces a node for the duration of the context; a node that only this host can reach is not announced.

    Args:
        name: of the node.
        endpoint: where it publishes, with its actual port.
        streams: what it publishes.
        keys: that it uses there, None = none.
        interfaces: addresses of this host to announce, and to announce on, even if they are loopback; None = those
            that the endpoint is bound to.
    """
    parts = parse_endpoint(endpoint)
    addresses = list(interfaces) if interfaces is not None else _addresses(parts)
    if not addresses:
        yield
        return
    from zeroconf import Error, Zeroconf

    zeroconf = None
    try:
        zeroconf = Zeroconf(interfaces=addresses)
        zeroconf.register_service(service_info(name, parts, streams, keys, addresses), allow_name_change=True)
    except (OSError, Error) as error:
        _log.warning("the node is not announced; name its endpoint where it is wanted", reason=str(error))
    try:
        yield
    finally:
        if zeroconf is not None:
            zeroconf.close()


def _addresses(endpoint: Endpoint) -> list[str]:
    """Returns the addresses by which other hosts reach a bound endpoint; none if they cannot."""
    if endpoint.host is None or not endpoint.leaves_host:
        return []
    return _own_addresses() if endpoint.host in EVERY_ADDRESS else [endpoint.host]


def _own_addresses() -> list[str]:
    """Returns the IPv4 addresses of this host except loopback."""
    import ifaddr

    ips = [str(ip.ip) for adapter in ifaddr.get_adapters() for ip in adapter.ips if ip.is_IPv4]
    return [ip for ip in ips if not is_loopback(ip)]
