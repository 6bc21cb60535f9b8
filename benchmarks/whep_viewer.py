"""A viewer by WHEP for measurements: it takes pictures when their last packet comes; a player waits a little."""

from collections.abc import Callable
from types import TracebackType
from typing import Self

import httpx
from aiortc import RTCConfiguration, RTCPeerConnection, RTCSessionDescription, RTCTransportStats
from aiortc.codecs.h264 import h264_depayload
from aiortc.rtp import RtpPacket

from deltalight.services.api.webrtc import listen_at
from deltalight.services.ports import LOOPBACK

SDP = {"Content-Type": "application/sdp"}


class WhepViewer:
    """A peer on loopback; `take` gets each picture's access unit. Use it as an asynchronous context manager.

    Args:
        address: of the endpoint of WHEP.
        take: what to do with a picture; aiortc would decode each, for every viewer.
    """

    def __init__(self, address: str, take: Callable[[bytes], None]) -> None:
        self._address, self._take = address, take
        self._unit = b""
        self._peer = RTCPeerConnection(RTCConfiguration(iceServers=[]))
        self._video = self._peer.addTransceiver("video", "recvonly")
        self._video.receiver._handle_rtp_packet = self._take_packet  # type: ignore[method-assign]
        listen_at(self._video, [LOOPBACK])

    async def __aenter__(self) -> Self:
        """Opens the session."""
        await self._peer.setLocalDescription()
        async with httpx.AsyncClient() as http:
            offer = self._peer.localDescription.sdp
            answer = await http.post(self._address, content=offer, headers=SDP)
        answer.raise_for_status()
        await self._peer.setRemoteDescription(RTCSessionDescription(answer.text, "answer"))
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Leaves the session, which ends with that."""
        await self._peer.close()

    async def received_bytes(self) -> int:
        """Returns the bytes of all datagrams so far, without their headers of UDP and IP."""
        stats = (await self._video.receiver.getStats()).values()
        return sum(each.bytesReceived for each in stats if isinstance(each, RTCTransportStats))

    async def _take_packet(self, packet: RtpPacket, arrival_time_ms: int) -> None:
        del arrival_time_ms
        self._unit += h264_depayload(packet.payload)
        if packet.marker:
            unit, self._unit = self._unit, b""
            self._take(unit)
