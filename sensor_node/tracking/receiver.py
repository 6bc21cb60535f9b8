"""Reception of a tracking system's poses over UDP, by the time of their arrival."""

import socket
import threading
import time
from bisect import bisect_left
from collections import deque
from ipaddress import IPv4Address
from types import TracebackType
from typing import Annotated, Self

import numpy as np
from jaxtyping import Float64
from pydantic import Field, field_validator

from deltalight.protocol.documents import StrictModel
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.poses import interpolate_pose, require_rigid
from deltalight.sensor_node.tracking.opentrackio import (
    MULTICAST_PREFIX,
    PORT,
    SOURCE_NUMBERS,
    PacketReader,
    Sample,
)

POLL_S = 0.1
MAX_PACKET_BYTES = 65536
KEPT_POSES = 512  # four seconds of a fast tracker
LONGEST_GAP_NS = 100_000_000  # poses farther apart are not interpolated, and none is used for longer
Row = Annotated[tuple[float, float, float, float], Field(strict=False)]
IDENTITY = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0))


class TrackingSettings(StrictModel):
    """OpenTrackIO packets that give the camera's pose in place of the marker board."""

    source_number: int = Field(
        default=1, ge=SOURCE_NUMBERS[0], le=SOURCE_NUMBERS[1], description="Number of the tracked source."
    )
    listen: str | None = Field(
        default=None,
        description="Address to listen on, such as 127.0.0.1 or 0.0.0.0; null = join the source's multicast "
        "group.",
    )
    port: int = Field(default=PORT, ge=0, le=65535, description="UDP port; 0 = a free one.")
    delay_s: float = Field(
        default=0.0,
        ge=-1,
        le=1,
        description="How much later a pose arrives than the picture of the same moment, s.",
    )
    world_from_stage: tuple[Row, Row, Row, Row] = Field(
        default=IDENTITY, description="Transform from the tracker's stage to the world, 4x4 by rows."
    )
    lens: bool = Field(default=False, description="Take the lens from the packets instead of rgb.yaml.")

    @field_validator("listen")
    @classmethod
    def _is_address(cls, address: str | None) -> str | None:
        if address is not None:
            IPv4Address(address)
        return address

    @field_validator("world_from_stage")
    @classmethod
    def _is_rigid(cls, matrix: object) -> object:
        try:
            require_rigid(matrix, "world_from_stage")
        except DeltalightError as error:
            raise ValueError(str(error)) from error
        return matrix


class TrackingReceiver:
    """Receives samples in a thread; use it as a context manager."""

    def __init__(self, settings: TrackingSettings) -> None:
        self._settings = settings
        self._world_from_stage = np.array(settings.world_from_stage)
        self._reader = PacketReader()
        self._poses: deque[tuple[int, Float64[np.ndarray, "4 4"]]] = deque(maxlen=KEPT_POSES)
        self._static: Sample | None = None
        self._changed = threading.Condition()
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="tracking", daemon=True)
        self._socket: socket.socket | None = None

    def __enter__(self) -> Self:
        """Starts receiving.

        Raises:
            DeltalightError: the address or port cannot be used.
        """
        try:
            self._socket = _opened(self._settings)
        except OSError as fault:
            raise DeltalightError(
                f"Tracking data cannot be received at UDP port {self._settings.port} ({fault.strerror}); stop the"
                " other program there, or set another port or address in [node.tracking]."
            ) from fault
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stops."""
        self._closing.set()
        self._thread.join()
        if self._socket is not None:
            self._socket.close()

    @property
    def port(self) -> int:
        """Where it receives."""
        assert self._socket is not None  # it is open
        return int(self._socket.getsockname()[1])

    def at(self, capture_ns: int) -> Float64[np.ndarray, "4 4"] | None:
        """Returns world_from_camera at a time by this host's clock; None if nothing is known of that time.

        It is interpolated between two poses, else the nearest one.
        """
        wanted_ns = capture_ns + round(self._settings.delay_s * 1e9)
        with self._changed:
            poses = list(self._poses)
        index = bisect_left(poses, wanted_ns, key=lambda each: each[0])
        near = poses[max(index - 1, 0) : index + 1]
        if len(near) == 2 and near[1][0] - near[0][0] <= LONGEST_GAP_NS:
            (before_ns, before), (after_ns, after) = near
            return interpolate_pose(before, after, (wanted_ns - before_ns) / (after_ns - before_ns))
        nearest = min(near, key=lambda each: abs(each[0] - wanted_ns), default=None)
        if nearest is None or abs(nearest[0] - wanted_ns) > LONGEST_GAP_NS:
            return None
        return nearest[1]

    def with_lens(self, timeout_s: float) -> Sample | None:
        """Waits for a sample that tells the sensor's size, and returns it; None if none comes in time."""
        with self._changed:
            self._changed.wait_for(lambda: self._static is not None, timeout_s)
            return self._static

    def remark(self, now_ns: int) -> str:
        """Says what is wrong with the newest packets; nothing if they are well."""
        with self._changed:
            newest_ns, fault = self._poses[-1][0] if self._poses else None, self._reader.fault
        if newest_ns is not None and now_ns - newest_ns <= LONGEST_GAP_NS:
            return ""
        if fault:
            return f"no pose comes from the tracker: {fault}"
        return f"no pose comes from the tracker; let it send OpenTrackIO to UDP port {self._settings.port}"

    def _run(self) -> None:
        assert self._socket is not None  # __enter__
        while not self._closing.is_set():
            try:
                packet = self._socket.recv(MAX_PACKET_BYTES)
            except TimeoutError:
                continue
            self._take(packet, time.time_ns())

    def _take(self, packet: bytes, now_ns: int) -> None:
        with self._changed:
            sample = self._reader.add(packet)
            if sample is None or sample.sourceNumber not in (None, self._settings.source_number):
                return
            pose = sample.stage_from_camera
            if pose is not None and (not self._poses or now_ns > self._poses[-1][0]):
                self._poses.append((now_ns, self._world_from_stage @ pose))
            if sample.static is not None and sample.static.camera is not None and sample.lens is not None:
                self._static = sample
                self._changed.notify_all()


def _opened(settings: TrackingSettings) -> socket.socket:
    group = f"{MULTICAST_PREFIX}{settings.source_number}"
    opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        opened.settimeout(POLL_S)
        if settings.listen is None:
            opened.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # others may listen to a group too
            opened.bind((group, settings.port))
            member = socket.inet_aton(group) + socket.inet_aton("0.0.0.0")
            opened.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, member)
        else:
            opened.bind((settings.listen, settings.port))
    except OSError:
        opened.close()
        raise
    return opened
