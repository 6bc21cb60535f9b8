"""A sensor node in this process, with the settings of a configuration file: what `node` and `replay` run."""

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Event

from protocol.keys import KeySettings
from sensor_node.node import NodeConfig, run_node
from services.settings import load_configuration


def run_configured_node(given: Mapping[str, object], config_file: Path | None) -> None:
    """Run a node until Ctrl-C or its end; `given` settings win over the file's.

    Raises:
        DeltalightError: wrong settings, or the source, an endpoint or a key cannot be used.
    """
    configuration = load_configuration(config_file)
    config = configuration.section("node", NodeConfig, given)
    endpoints = [each for each in (config.endpoint, config.clock_endpoint) if each is not None]
    keys = configuration.section("keys", KeySettings).load(endpoints)
    stop = Event()
    with ThreadPoolExecutor(1) as thread:
        running = thread.submit(run_node, config, stop, keys)
        try:
            running.result()  # signals interrupt this wait, not the node's work
        finally:
            stop.set()
