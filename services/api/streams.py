"""What node and render server publish, as far as the service shows it."""

import threading
from collections.abc import Callable, Mapping, Sequence

import structlog

from protocol.envelope import decode
from protocol.errors import DeltalightError
from protocol.keys import Keys
from protocol.messages import CompositeMessage, Message, StatsMessage
from protocol.transport import ReceivedMultipart, Receiver
from services.api.context import Context
from services.api.models import ProcessAnswer

RECEIVE_TIMEOUT_S = 0.2
LIGHT = "radiance."  # topics of what nodes see of the light

Sink = Callable[[Message, Sequence[memoryview]], None]

log = structlog.get_logger()


class Streams:
    """Hands the newest message of each topic to the sink of its stream, in a thread of its own."""

    def __init__(self, endpoints: Sequence[str], sinks: Mapping[str, Sink], keys: Keys | None = None) -> None:
        self._receiver = Receiver(endpoints, list(sinks), keys=keys)
        self._keys = keys
        self._sinks = sinks
        self._source: Receiver | None = None
        self._changing = threading.Lock()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="streams", daemon=True)

    def start(self) -> None:
        """Begin to listen."""
        self._thread.start()

    def follow(self, endpoints: Sequence[str] | None) -> None:
        """Hear also what the render server reads from now on, None = its own nodes; light comes from there only."""
        with self._changing:
            before = self._source
            self._source = Receiver(endpoints, list(self._sinks), keys=self._keys) if endpoints else None
        if before is not None:
            before.close()

    def close(self) -> None:
        """Stop listening."""
        self._stop.set()
        self.follow(None)
        self._receiver.close()
        if self._thread.is_alive():
            self._thread.join()

    def _run(self) -> None:
        while not self._stop.is_set():
            own = self._receiver.latest(RECEIVE_TIMEOUT_S) or {}
            source = self._source
            for topic, multipart in own.items():
                if source is None or not topic.startswith(LIGHT):
                    self._pass_on(multipart)
            for multipart in (source.latest(0) or {}).values() if source is not None else ():
                self._pass_on(multipart)

    def _pass_on(self, multipart: ReceivedMultipart) -> None:
        try:
            message, parts = decode(multipart)
            self._sinks[message.stream](message, parts)
        except DeltalightError as fault:
            log.warning("message not understood", fault=str(fault))


def sinks(context: Context) -> dict[str, Sink]:
    """Where what is received goes: pictures to viewers, reports to the watch and to those who hear events."""
    return {
        "composite": lambda message, parts: _show(context, message, parts),
        "radiance": context.fisheye.note,
        "stats": lambda message, _parts: _note_report(context, message),
    }


def _show(context: Context, message: Message, parts: Sequence[memoryview]) -> None:
    if isinstance(message, CompositeMessage) and message.encoding == "jpeg":
        scene = context.link.shown(message.scene_revision)
        context.live.publish(message, bytes(parts[0]), scene, context.watch.detail(message.node))


def _note_report(context: Context, message: Message) -> None:
    if isinstance(message, StatsMessage):
        report = context.watch.note(message)
        context.events.publish("process", ProcessAnswer.of(report).model_dump())
