"""Health checks: a render server by its control socket, a publisher by its reports, an API over HTTP.

Containers ask twice a minute by `python -m deltalight.services.health_check ADDRESS [--streams]`, which imports no
more than it needs: for HTTP a fifth of the processor time of `deltalight ping`.
"""

import sys
import urllib.error
import urllib.request
import uuid
from typing import TYPE_CHECKING

from deltalight.protocol.errors import DeltalightError

if TYPE_CHECKING:
    from deltalight.protocol.keys import Keys

HEALTH_PATH = "/api/v1/health"


def check_health(address: str, *, streams: bool, timeout_s: float) -> str | None:
    """Returns what is wrong as a sentence, or None.

    Raises:
        DeltalightError: the address is malformed, or requires keys that are missing.
    """
    if address.startswith(("http://", "https://")):
        return _ask_api(address.rstrip("/"), timeout_s)
    keys = _keys(address)
    return _await_report(address, keys, timeout_s) if streams else _ask_control(address, keys, timeout_s)


def _keys(endpoint: str) -> "Keys | None":
    if endpoint.startswith("ipc://"):
        return None
    from deltalight.protocol.keys import KeySettings
    from deltalight.services.settings import load_configuration

    return load_configuration().section("keys", KeySettings).load([endpoint])


def _ask_api(address: str, timeout_s: float) -> str | None:
    try:
        with urllib.request.urlopen(address + HEALTH_PATH, timeout=timeout_s):
            return None
    except urllib.error.HTTPError as fault:
        return f"{address} answers with status {fault.code}; its log says why."
    except (OSError, ValueError) as fault:
        return f"No API answers at {address} ({fault}); start it, or correct the address."


def _ask_control(endpoint: str, keys: "Keys | None", timeout_s: float) -> str | None:
    from deltalight.protocol.messages import ControlRequest
    from deltalight.protocol.request import RequestClient

    client = RequestClient(endpoint, keys=keys)
    try:
        reply = client.request(ControlRequest(node="ping", id=uuid.uuid4().hex, op="ping"), timeout_s)
    except DeltalightError as fault:
        return str(fault)
    finally:
        client.close()
    return reply.error


def _await_report(endpoint: str, keys: "Keys | None", timeout_s: float) -> str | None:
    from deltalight.protocol.envelope import decode
    from deltalight.protocol.messages import StatsMessage
    from deltalight.protocol.receiver import Receiver

    receiver = Receiver([endpoint], ["stats"], keys=keys)
    try:
        reports = receiver.latest(timeout_s) or {}
    finally:
        receiver.close()
    for multipart in reports.values():
        message, _ = decode(multipart)
        if isinstance(message, StatsMessage):
            return None
    return f"No report came from {endpoint} within {timeout_s:g} s; start its process, or check its log."


def main(words: list[str]) -> int:
    """Checks what the command line names; returns its exit code."""
    addresses = [word for word in words if word != "--streams"]
    if len(addresses) != 1:
        print("usage: python -m deltalight.services.health_check ADDRESS [--streams]", file=sys.stderr)
        return 2
    try:
        fault = check_health(addresses[0], streams="--streams" in words, timeout_s=5.0)
    except DeltalightError as error:
        fault = str(error)
    if fault is not None:
        print(f"deltalight: {fault}", file=sys.stderr)
    return int(fault is not None)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
