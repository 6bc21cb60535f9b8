"""A sensor node in this process, with the settings of a configuration file, for `node` and `replay`."""

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from threading import Event

from protocol.keys import KeySettings
from sensor_node.cameras.playback import PlaybackCamera
from sensor_node.node import NodeConfig, run_node
from services.replay_endpoint import playback_control
from services.settings import load_configuration


def run_configured_node(
    given: Mapping[str, object],
    config_file: Path | None,
    camera: PlaybackCamera | None = None,
    control: str | None = None,
) -> None:
    """Run a node until Ctrl-C or its end; `given` settings override the file's.

    Args:
        given: settings of the node.
        config_file: configuration file; None = the default one.
        camera: replaces the source of the settings.
        control: endpoint that controls that camera.

    Raises:
        DeltalightError: the settings are wrong, or the source, an endpoint or a key cannot be used.
    """
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
