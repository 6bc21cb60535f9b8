"""Live viewing in Foxglove: the messages that recordings hold, and the relit picture, over a WebSocket."""

import logging
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from typing import TYPE_CHECKING

from mcap_protobuf.schema import build_file_descriptor_set

from deltalight.protocol.calibration import Extrinsics
from deltalight.protocol.envelope import decode
from deltalight.protocol.errors import DeltalightError, install_command
from deltalight.protocol.frames import SensorFrame
from deltalight.protocol.keys import Keys
from deltalight.protocol.messages import CompositeMessage, Message
from deltalight.protocol.recording_format import COMPOSITE_TOPIC, FOXGLOVE_TOPICS, SCENE_TOPIC
from deltalight.protocol.recording_messages import FrameMessages, composite_message
from deltalight.protocol.recording_scene import scene_message
from deltalight.protocol.scene import SceneDocument
from deltalight.services.raw_frames import RAW_STREAMS, RawFrameAssembler
from deltalight.services.recorder import scene_of_server
from deltalight.services.relit_pictures import relit_picture
from deltalight.services.stream_queue import StreamQueue

if TYPE_CHECKING:
    from foxglove import Channel, Context

POLL_S = 0.1
SCENE_PERIOD_S = 1.0
REPEAT_S = 2.0  # what seldom changes comes again, for whoever came late; as nodes do
IDLE_POLLS = 3  # afterwards, frames whose partners are late are taken as they are


@dataclass(frozen=True)
class BridgeJob:
    """What to show where: the streams of nodes and render servers at `endpoints`, on `host` and `port`.

    `node` None is the node whose colour picture comes first. The scene is that of the render server at `control`.
    """

    endpoints: tuple[str, ...]
    host: str
    port: int
    node: str | None = None
    control: str | None = None
    extrinsics: Extrinsics | None = None
    keys: Keys | None = None


class FoxgloveServer:
    """A WebSocket server of Foxglove's protocol, which advertises all topics at once.

    Raises:
        DeltalightError: foxglove-sdk is not installed, or the port is taken.
    """

    def __init__(self, host: str, port: int) -> None:
        try:
            import foxglove
        except ImportError as error:
            raise DeltalightError(
                f"Live viewing needs the package foxglove-sdk: {install_command('foxglove-sdk')}."
            ) from error
        logging.getLogger("foxglove").setLevel(logging.WARNING)
        self._context = foxglove.Context()  # whose end closes its channels
        # Before clients can come: a channel that is made later is advertised before it can be subscribed to.
        self._channels = {topic: _channel(topic, self._context) for topic in FOXGLOVE_TOPICS}
        try:
            self._server = foxglove.start_server(
                name="Deltalight", host=host, port=port, context=self._context
            )
        except RuntimeError as error:
            raise DeltalightError(
                f"cannot listen on {host} port {port} ({error}); choose another with --port."
            ) from error

    @property
    def port(self) -> int:
        """Where it listens."""
        return int(self._server.port)

    def publish(self, topic: str, data: bytes, timestamp_ns: int) -> None:
        """Sends a message to whoever subscribed."""
        self._channels[topic].log(data, log_time=timestamp_ns)

    def close(self) -> None:
        """Closes all connections."""
        self._server.stop()


def _channel(topic: str, context: "Context") -> "Channel":
    from foxglove import Channel, Schema

    kind = FOXGLOVE_TOPICS[topic]
    data = build_file_descriptor_set(kind).SerializeToString()
    schema = Schema(name=kind.DESCRIPTOR.full_name, encoding="protobuf", data=data)
    return Channel(topic, message_encoding="protobuf", schema=schema, context=context)


class FoxgloveBridge:
    """Publishes frames, relit pictures and the scene to Foxglove.

    `notice(sentence)` reports what the user should read.

    Raises:
        DeltalightError: as `FoxgloveServer`, or an endpoint is malformed or lacks keys.
    """

    def __init__(self, job: BridgeJob, notice: Callable[[str], None]) -> None:
        self._job, self._notice = job, notice
        self._assembler = RawFrameAssembler(job.node)
        self._messages, self._repeated_s = FrameMessages(job.extrinsics), time.monotonic()
        self._idle_polls = 0
        self._is_broken = False
        with ExitStack() as opened:
            self._queue = opened.enter_context(
                closing(StreamQueue(job.endpoints, (*RAW_STREAMS, "composite"), job.keys))
            )
            self.server = opened.enter_context(closing(FoxgloveServer(job.host, job.port)))
            self._open = opened.pop_all()

    def run(self, stop: threading.Event) -> None:
        """Publishes until `stop` is set."""
        watch = threading.Thread(target=self._watch_scene, args=(stop,), name="foxglove-scene")
        with self._open:
            watch.start()
            try:
                while not stop.is_set():
                    self._receive()
            finally:
                stop.set()
                watch.join()

    def _receive(self) -> None:
        """Takes what has come, and publishes the newest frame of it."""
        multipart = self._queue.take(POLL_S)
        self._idle_polls = 0 if multipart is not None else self._idle_polls + 1
        try:
            while multipart is not None:
                self._add(*decode(multipart))
                multipart = self._queue.take(0)
            self._publish(self._newest())
        except DeltalightError as error:
            if not self._is_broken:
                self._notice(f"Skipping a message: {error}")
            self._is_broken = True

    def _add(self, message: Message, parts: Sequence[memoryview]) -> None:
        if not isinstance(message, CompositeMessage):
            self._assembler.add(message, parts)
        elif message.node in self._assembler.foreign:  # another camera's
            return
        elif (picture := relit_picture(message, parts)) is not None:
            now_ns = message.capture_ns
            self.server.publish(COMPOSITE_TOPIC, composite_message(picture, now_ns), now_ns)

    def _newest(self) -> SensorFrame | None:
        newest, frame = None, self._assembler.take(is_idle=self._idle_polls >= IDLE_POLLS)
        while frame is not None:
            newest, frame = frame, self._assembler.take()
        return newest

    def _publish(self, frame: SensorFrame | None) -> None:
        if frame is None:
            return
        if time.monotonic() - self._repeated_s > REPEAT_S:
            self._messages, self._repeated_s = FrameMessages(self._job.extrinsics), time.monotonic()
        for topic, data in self._messages.of(frame):
            if topic in FOXGLOVE_TOPICS:
                self.server.publish(topic, data, frame.timestamp_ns)

    def _watch_scene(self, stop: threading.Event) -> None:
        """Publishes the render server's scene when it changes, and now and then."""
        shown: SceneDocument | None = None
        published_s = 0.0
        while self._job.control is not None and not stop.is_set():
            try:
                scene = scene_of_server(self._job.control, self._job.keys)
                if scene != shown or time.monotonic() - published_s > REPEAT_S:
                    now_ns, published_s = time.time_ns(), time.monotonic()
                    self.server.publish(SCENE_TOPIC, scene_message(scene, now_ns), now_ns)
                shown = scene
            except DeltalightError:
                pass  # no server runs there, or not any more
            stop.wait(SCENE_PERIOD_S)
