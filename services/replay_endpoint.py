"""The control endpoint of a replay: position, play, pause, seek, rate (SPEC.md, section 6)."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict

from protocol.documents import nearest
from protocol.errors import DeltalightError
from protocol.keys import Keys
from protocol.messages import ControlRequest
from protocol.transport import ReplyServer
from sensor_node.cameras.playback import PlaybackCamera

OPS = ("position", "play", "pause", "seek", "rate")


@contextmanager
def playback_control(camera: PlaybackCamera, endpoint: str, keys: Keys | None) -> Iterator[None]:
    """Answer requests about a replay for the duration of the block.

    Raises:
        DeltalightError: the endpoint cannot be used.
    """
    server = ReplyServer(endpoint, lambda request: _execute(camera, request), node="replay", keys=keys)
    try:
        yield
    finally:
        server.close()


def _execute(camera: PlaybackCamera, request: ControlRequest) -> dict[str, object]:
    """Execute a request; every op answers with the position after it."""
    match request.op:
        case "position":
            pass
        case "play":
            camera.play()
        case "pause":
            camera.pause()
        case "seek":
            camera.seek(_number(request.payload, "position_s"))
        case "rate":
            camera.set_rate(_number(request.payload, "rate"))
        case unknown:
            hint = nearest(unknown, OPS) or ", ".join(OPS)
            raise DeltalightError(f"a replay knows no command '{unknown}'; did you mean {hint}?")
    return asdict(camera.playback)


def _number(payload: Mapping[str, object], key: str) -> float:
    value = payload.get(key)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise DeltalightError(f"the command needs a number as `{key}` in its payload.")
    return float(value)
