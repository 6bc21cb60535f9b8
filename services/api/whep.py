"""WHEP: sessions that watch the live picture by WebRTC (draft-ietf-wish-whep; extra `whep`).

A session outlives the request that opened it; it counts as one of its client's streams, and ends with its token.
"""

import asyncio
import secrets
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import cached_property
from importlib.util import find_spec
from ipaddress import ip_address
from typing import TYPE_CHECKING

import structlog
from starlette.concurrency import run_in_threadpool

from deltalight.protocol.errors import install_command
from deltalight.protocol.scene_fields import ShownView
from deltalight.services.api.limits import StreamLimits, run_while
from deltalight.services.api.live_hub import LiveHub
from deltalight.services.api.problems import ProblemError
from deltalight.services.api.settings import ApiSettings
from deltalight.services.h264 import why_unavailable
from deltalight.services.ports import LOOPBACK
from deltalight.services.storage.faults import NotFoundError
from deltalight.services.storage.tokens import TokenStore

if TYPE_CHECKING:
    from deltalight.services.api.webrtc import Peer

NO_AIORTC = f"WHEP needs the package aiortc: {install_command('aiortc')}."
NONE_ALLOWED = "WHEP is disabled here; set `whep_sessions` to the number of viewers to allow."
ALL_TAKEN = "All WHEP sessions are in use; close some, or watch through WS /live."
ID_BYTES = 16  # whoever knows an id may end that session

log = structlog.get_logger()


@dataclass(frozen=True)
class Watcher:
    """Who asks: the address that its streams are counted by, and its token (None = none was needed)."""

    client: str
    token_id: str | None


@dataclass(frozen=True)
class WatchedView:
    """What is watched: a view (None = the scene's own) of a camera (None = the first one)."""

    view: ShownView | None
    camera: str | None


class WhepSessions:
    """The sessions of all rooms of a web process (in its event loop)."""

    def __init__(self, settings: ApiSettings, tokens: TokenStore, streams: StreamLimits) -> None:
        self._settings, self._tokens, self._streams = settings, tokens, streams
        self._running: dict[str, asyncio.Task[None]] = {}
        self._taken = 0  # also by those that are being opened

    @cached_property
    def why_not(self) -> str | None:
        """Why there is no WHEP here; None where there is. Found out when first asked for: PyAV is large."""
        if self._settings.whep_sessions == 0:
            return NONE_ALLOWED
        return why_unavailable() or (NO_AIORTC if find_spec("aiortc") is None else None)

    async def open(self, hub: LiveHub, watched: WatchedView, offer: str, watcher: Watcher) -> tuple[str, str]:
        """Begins a session; returns its id and the answer to the offer.

        Raises:
            ProblemError: there is no WHEP here, no port opens, or there are too many sessions.
            DeltalightError: the offer is wrong.
        """
        if self.why_not is not None:
            raise ProblemError(503, "no-whep", self.why_not)
        peer_of = await run_in_threadpool(_peer_class)
        with ExitStack() as held:
            held.enter_context(self._place())
            held.enter_context(self._streams.slot(watcher.client))
            peer = peer_of(
                held.enter_context(hub.viewer(watched.view, "h264", watched.camera)), self._addresses()
            )
            try:
                answer = await peer.answer(offer)
            except BaseException:
                await peer.close()
                raise
            session_id = secrets.token_urlsafe(ID_BYTES)
            serving = self._serve(peer, watcher.token_id, held.pop_all())
        self._running[session_id] = task = asyncio.create_task(serving)
        task.add_done_callback(lambda _: self._running.pop(session_id))
        return session_id, answer

    async def end(self, session_id: str) -> None:
        """Ends a session.

        Raises:
            NotFoundError: there is none of this id.
        """
        task = self._running.get(session_id)
        if task is None:
            raise NotFoundError("there is no such WHEP session; it may have ended.")
        task.cancel()
        await asyncio.wait([task])

    async def close(self) -> None:
        """Ends all sessions."""
        for task in (tasks := list(self._running.values())):
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    async def _serve(self, peer: "Peer", token_id: str | None, held: ExitStack) -> None:
        async def is_allowed() -> bool:
            return token_id is None or await run_in_threadpool(self._tokens.knows, token_id)

        log.info("a session of WHEP begins", sessions=self._taken)
        try:
            with held:
                try:
                    await run_while(peer.until_ended(), is_allowed)
                finally:
                    await peer.close()
        finally:
            log.info("a session of WHEP ended", sessions=self._taken)

    @contextmanager
    def _place(self) -> Iterator[None]:
        if self._taken >= self._settings.whep_sessions:
            raise ProblemError(429, "too-many-streams", ALL_TAKEN, {"Retry-After": "5"})
        self._taken += 1
        try:
            yield
        finally:
            self._taken -= 1

    def _addresses(self) -> Sequence[str]:
        chosen = self._settings.whep_host or self._settings.host
        address = ip_address(LOOPBACK if chosen == "localhost" else chosen)
        return _addresses_of_host(address.version) if address.is_unspecified else [str(address)]


def _peer_class() -> "type[Peer]":
    """Imports aiortc, which takes a third of a second."""
    from deltalight.services.api.webrtc import Peer

    return Peer


def _addresses_of_host(version: int) -> Sequence[str]:
    """Returns this host's addresses, without loopback and those of one link alone.

    Raises:
        ProblemError: it has none.
    """
    import ifaddr

    found = [
        ip.ip if isinstance(ip.ip, str) else ip.ip[0] for each in ifaddr.get_adapters() for ip in each.ips
    ]
    parsed = [ip_address(each) for each in found]
    usable = [
        str(each)
        for each in parsed
        if each.version == version and not each.is_loopback and not each.is_link_local
    ]
    if not usable:
        raise ProblemError(503, "no-whep", "This host has no address for WHEP; set `whep_host` to one.")
    return usable
