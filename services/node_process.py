"""A sensor node in this process, for `node` and `replay`: configured by a file, and controlled during a replay."""

from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import asdict
from pathlib import Path
from threading import Event

import cv2

from deltalight.protocol.documents import nearest
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.keys import Keys, KeySettings
from deltalight.protocol.messages import ControlRequest
from deltalight.protocol.request import ReplyServer
from deltalight.sensor_node.cameras.playback import PlaybackCamera
from deltalight.sensor_node.node import NodeConfig, run_node
from deltalight.services.kept_memory import keep_freed_memory
from deltalight.services.settings import load_configuration

OPS = (
    "position",
    "play",
    "pause",
    "seek",
    "step",
    "rate",
)  # of a replay's control endpoint (SPEC.md, section 6)


def run_configured_node(
    given: Mapping[str, object],
    config_file: Path | None,
    camera: PlaybackCamera | None = None,
    control: str | None = None,
) -> None:
    """Runs a node until Ctrl-C or its end; `given` settings override the file's.

    Args:
        given: settings of the node.
        config_file: configuration file; None = the default one.
        camera: replaces the source of the settings.
        control: endpoint that controls that camera.

    Raises:
        DeltalightError: the settings are wrong, or the source, an endpoint or a key cannot be used.
    """
    keep_freed_memory()
    cv2.setNumThreads(
        1
    )  # threads that wait for the next part spin: a third more processor time, for pictures this small
    configuration = load_configuration(config_file)
    config = configuration.section("node", NodeConfig, given)
    endpoints = [each for each in (config.endpoint, config.clock_endpoint, control) if each is not None]
    keys = configuration.section("keys", KeySettings).load(endpoints)
    stop = Event()
    with ExitStack() as stack, ThreadPoolExecutor(1) as thread:
        if camera is not None and control is not None:
            stack.enter_context(playback_control(camera, control, keys))
        running = thread.submit(run_node, config, stop, keys, camera)
        try:
            running.result()  # signals interrupt this wait, not the node's work
        finally:
            stop.set()


@contextmanager
def playback_control(camera: PlaybackCamera, endpoint: str, keys: Keys | None) -> Iterator[None]:
    """Answers requests at a replay's control endpoint for the duration of the block.

    Raises:
        DeltalightError: the endpoint cannot be used.
    """
    server = ReplyServer(endpoint, lambda request: _execute(camera, request), node="replay", keys=keys)
    try:
        yield
    finally:
        server.close()


def _execute(camera: PlaybackCamera, request: ControlRequest) -> dict[str, object]:
    """Executes a request; every op answers with the position after it."""
    match request.op:
        case "position":
            pass
        case "play":
            camera.play()
        case "pause":
            camera.pause()
        case "seek":
            camera.seek(_number(request.payload, "position_s"))
        case "step":
            camera.step(_whole_number(request.payload, "frames"))
        case "rate":
            camera.set_rate(_number(request.payload, "rate"))
        case unknown:
            hint = nearest(unknown, OPS) or ", ".join(OPS)
            raise DeltalightError(f"a replay has no command '{unknown}'; did you mean {hint}?")
    return asdict(camera.playback)


def _number(payload: Mapping[str, object], key: str) -> float:
    value = payload.get(key)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise DeltalightError(f"the command needs a number as `{key}` in its payload.")
    return float(value)


def _whole_number(payload: Mapping[str, object], key: str) -> int:
    value = _number(payload, key)
    if not value.is_integer():
        raise DeltalightError(f"the command needs a whole number as `{key}` in its payload, not {value:g}.")
    return int(value)
