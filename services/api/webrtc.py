"""One peer that watches the live picture by WebRTC, with aiortc (extra `whep`): what `whep` imports when it is asked.

Pictures come from the encoder that all viewers of a view share, and are only cut into RTP packets here (RFC 6184).
Candidates of the peer's offer are not used: its address is where its authenticated connectivity checks come from
(RFC 8445, 7.3.1.3), so nobody can have packets sent to a third party.
"""

import asyncio
import time
from collections.abc import Sequence
from fractions import Fraction

import av
from aioice import Candidate
from aiortc import (
    MediaStreamTrack,
    RTCConfiguration,
    RTCPeerConnection,
    RTCRtpCodecCapability,
    RTCRtpCodecParameters,
    RTCRtpSender,
    RTCRtpTransceiver,
    RTCSessionDescription,
)
from aiortc.codecs import CODECS
from aiortc.mediastreams import MediaStreamError
from aiortc.rtcrtpparameters import ParametersDict
from aiortc.rtp import DYNAMIC_PAYLOAD_TYPES
from aiortc.sdp import SessionDescription
from av.stream import Stream

from deltalight.protocol.errors import DeltalightError
from deltalight.services.api.live_hub import Viewer
from deltalight.services.api.problems import ProblemError
from deltalight.services.h264 import TICKS_PER_S

CONNECT_TIMEOUT_S = 15.0  # from the answer to the first packet
# The encoders make High. A receiver that names (Constrained) Baseline alone gets it too: Chromium on Linux is one,
# and decodes it.
OUR_PROFILES = ("64001f", "640c1f")  # High and Constrained High (RFC 6184, 8.1)
PROFILES = (*OUR_PROFILES, "42e01f", "42001f")  # that are answered, the best first
FIRST_OF_OURS = 120  # payload type; aiortc takes those from 97 on
BAD_OFFER = "The body is not an SDP offer of WebRTC; send that of an RTCPeerConnection."
NO_VIDEO = "The offer must receive one video (recvonly), and may have audio, and nothing else."
NO_CODEC = (
    "The offer has no H.264 with packetization-mode 1, in which the pictures come; use a receiver that has."
)


def _capability(profile: str) -> RTCRtpCodecCapability:
    parameters: ParametersDict = {
        "level-asymmetry-allowed": "1",
        "packetization-mode": "1",
        "profile-level-id": profile,
    }
    return RTCRtpCodecCapability("video/H264", TICKS_PER_S, parameters=parameters)


def _add_profiles() -> None:
    """Has aiortc negotiate the profiles of our encoders: it lists those of its own alone."""
    feedback = next(codec.rtcpFeedback for codec in CODECS["video"] if codec.name == "H264")
    for number, profile in enumerate(OUR_PROFILES):
        ours = _capability(profile)
        type_ = FIRST_OF_OURS + 2 * number
        CODECS["video"] += [
            RTCRtpCodecParameters(
                ours.mimeType,
                TICKS_PER_S,
                payloadType=type_,
                rtcpFeedback=feedback,
                parameters=ours.parameters,
            ),
            RTCRtpCodecParameters("video/rtx", TICKS_PER_S, payloadType=type_ + 1, parameters={"apt": type_}),
        ]


_add_profiles()


class Peer:
    """A connection to one peer, which gets what `viewer` sees.

    Args:
        viewer: it wants H.264.
        addresses: of this host, at which it listens, on ports that the system chooses.
    """

    def __init__(self, viewer: Viewer, addresses: Sequence[str]) -> None:
        self._addresses = addresses
        self._connection = RTCPeerConnection(RTCConfiguration(iceServers=[]))
        self._has_connected, self._has_ended = False, asyncio.Event()
        self._connection.on("connectionstatechange", self._note_state)
        self._track = _LiveTrack(viewer)
        self._track.on("ended", self._has_ended.set)
        self._transceiver = self._connection.addTransceiver(self._track, "sendonly")
        preferred = [_capability(profile) for profile in PROFILES]
        retransmission = RTCRtpCodecCapability("video/rtx", TICKS_PER_S)
        self._transceiver.setCodecPreferences([*preferred, retransmission])
        on_key_wanted(self._transceiver.sender, viewer)

    async def answer(self, offer: str) -> str:
        """Returns the answer to an offer, with all candidates of this host.

        Raises:
            DeltalightError: it is no offer, or wants what is not there.
            ProblemError: no port opens.
        """
        await self._take(offer)
        for transceiver in self._connection.getTransceivers():
            if transceiver is not self._transceiver:
                transceiver.direction = "inactive"  # or aiortc would receive and decode what the peer sends
            listen_at(transceiver, self._addresses)
        await self._connection.setLocalDescription()
        if not self._transceiver.sender.transport.transport.iceGatherer.getLocalCandidates():
            places = ", ".join(self._addresses)
            sentence = f"No UDP port opens at {places}; set `whep_host` to an address of this host."
            raise ProblemError(503, "no-whep", sentence)
        asyncio.get_running_loop().call_later(CONNECT_TIMEOUT_S, self._give_up)
        return self._connection.localDescription.sdp

    async def until_ended(self) -> None:
        """Waits until the peer has gone or did not come, or until there are no more pictures."""
        await self._has_ended.wait()

    async def close(self) -> None:
        """Ends the connection; tells the peer."""
        await self._connection.close()

    async def _take(self, offer: str) -> None:
        try:
            description = SessionDescription.parse(offer)
            _restrict(description)
            await self._connection.setRemoteDescription(RTCSessionDescription(str(description), "offer"))
        except DeltalightError:
            raise
        except Exception as fault:  # aiortc's parser raises what its expressions happen to raise
            raise DeltalightError(NO_CODEC if "send parameters" in str(fault) else BAD_OFFER) from fault

    def _note_state(self) -> None:
        state = self._connection.connectionState
        self._has_connected = self._has_connected or state == "connected"
        if state in ("failed", "closed"):
            self._has_ended.set()

    def _give_up(self) -> None:
        if not self._has_connected:
            self._has_ended.set()


class _LiveTrack(MediaStreamTrack):
    """Coded pictures as they come, at the time of their sending: a key may be an older picture, coded again."""

    kind = "video"

    def __init__(self, viewer: Viewer) -> None:
        super().__init__()
        self._viewer = viewer
        self._sent = 0  # ticks

    async def recv(self) -> "av.Packet[Stream]":
        while (picture := await self._viewer.next_video()) is not None:
            if picture.data:
                return self._packet(picture.data)
        raise MediaStreamError

    def _packet(self, data: bytes) -> "av.Packet[Stream]":
        packet: av.Packet[Stream] = av.Packet(data)
        self._sent = max(self._sent + 1, round(time.monotonic() * TICKS_PER_S))
        packet.pts, packet.time_base = self._sent, Fraction(1, TICKS_PER_S)
        return packet


def on_key_wanted(sender: RTCRtpSender, viewer: Viewer) -> None:
    """Gives the viewer a key when the peer lost pictures (RFC 4585, 6.3.1; RFC 5104, 4.3.1).

    aiortc tells its own encoder alone, which coded pictures do not pass.
    """
    sender._send_keyframe = viewer.want_key  # type: ignore[method-assign]


def listen_at(transceiver: RTCRtpTransceiver, addresses: Sequence[str]) -> None:
    """Opens ports at these addresses alone; aiortc would at all of the host but loopback."""
    connection = transceiver.sender.transport.transport.iceGatherer._connection
    gather = connection.get_component_candidates

    chosen = list(addresses)

    async def gather_at(component: int, addresses: list[str], timeout: int = 5) -> list[Candidate]:
        del addresses
        return await gather(component, chosen, timeout)

    connection.get_component_candidates = gather_at  # type: ignore[method-assign]


def _restrict(offer: SessionDescription) -> None:
    """Checks an offer, and leaves out of it what is not used.

    Raises:
        DeltalightError: it is for something else, or incomplete.
    """
    videos = [media for media in offer.media if media.kind == "video"]
    wanted = len(videos) == 1 and videos[0].direction in ("recvonly", "sendrecv")
    if not wanted or any(media.kind not in ("audio", "video") for media in offer.media):
        raise DeltalightError(NO_VIDEO if offer.media else BAD_OFFER)
    for media in offer.media:
        ice, dtls = media.ice, media.dtls
        has_keys = ice is not None and ice.usernameFragment and ice.password
        if not has_keys or dtls is None or not dtls.fingerprints:
            raise DeltalightError(BAD_OFFER)
        media.ice_candidates, media.ice_candidates_complete = [], False
    parameters = videos[0].rtp  # aiortc answers other numbers than these with one of its own
    parameters.codecs = [each for each in parameters.codecs if each.payloadType in DYNAMIC_PAYLOAD_TYPES]
