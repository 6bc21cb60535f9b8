"""Time from a fish-eye picture to lights: split, resampling, message, filtering; on one core.

`python -m deltalight.benchmarks.median_cut` prints a table.
"""

import statistics
import time
from collections.abc import Callable

import cv2
import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from deltalight.protocol.envelope import decode
from deltalight.protocol.hemisphere import texel_directions
from deltalight.protocol.hemisphere_map import HemisphereMap, to_world
from deltalight.protocol.light_codecs import sky_lights
from deltalight.protocol.light_cutter import RESIDUAL_SIZE
from deltalight.protocol.light_tracker import LightTracker
from deltalight.protocol.median_cut import Split, split_map
from deltalight.protocol.messages import LightsMessage
from deltalight.protocol.scene_lights import LightCut
from deltalight.protocol.sky_lights import SkyLights
from deltalight.render_server.lights.octahedral import prefilter
from deltalight.sensor_node.frame_messages import Stamps, lights_multipart

ROUNDS = 30
SIZES = (256, 512)
COUNTS = (4, 16)


def room(size: int) -> HemisphereMap:
    """Returns a room with three windows and a lamp from below, with noise: peaks spread over most of the map."""
    rng = np.random.default_rng(4)
    directions = texel_directions(size)
    radiance = np.full((size, size, 3), 0.2, np.float32) + 0.05 * rng.random((size, size, 3), np.float32)
    for axis, radius_deg, value in (
        ((1.0, 0.2, 0.5), 14.0, 6.0),
        ((-0.9, 0.6, 0.4), 10.0, 9.0),
        ((0.1, -1.0, 0.6), 12.0, 5.0),
        ((0.1, 0.2, 1.0), 3.0, 80.0),
    ):
        unit = np.array(axis, np.float32) / np.float32(np.linalg.norm(axis))
        radiance[directions @ unit > np.cos(np.radians(radius_deg))] = value
    return HemisphereMap(radiance, np.ones((size, size), bool), np.eye(3))


def median_ms(work: Callable[[], object]) -> float:
    """Returns the median time of a call, ms, without the first one, which fills caches."""
    work()
    times = []
    for _ in range(ROUNDS):
        started_s = time.perf_counter()
        work()
        times.append(1e3 * (time.perf_counter() - started_s))
    return statistics.median(times)


def message(split: Split[HemisphereMap]) -> list[bytes]:
    """Returns the message in which a node publishes a split."""
    sky, tracker = to_world(split.residual, RESIDUAL_SIZE), LightTracker(0.0)
    tracker.set_target(0, split.lights, sky.filled())
    assert tracker.residual is not None
    regions = tuple(light.region for light in split.lights)
    lights = SkyLights(LightCut(), np.eye(4), tracker.lights, regions, tracker.residual, sky.seen)
    stamps = Stamps(node="camera", frame_id=0, capture_ns=0, clock_offset_ns=0, clock_bound_ns=None)
    return lights_multipart(lights, stamps, stamps)


def taken(multipart: list[bytes]) -> SkyLights:
    """Returns the lights that a server takes from a message."""
    header, parts = decode(multipart)
    assert isinstance(header, LightsMessage)
    return sky_lights(header, parts)


def main() -> None:
    """Measures and prints."""
    cv2.setNumThreads(1)
    table = Table(title="fish-eye picture to lights, median ms")
    table.add_column("hemisphere")
    for head in (
        "4 lights",
        "16 lights",
        "whole map, 16",
        "to the world",
        "node: all",
        "server takes",
        "filtered",
    ):
        table.add_column(head, justify="right")
    for size in SIZES:
        sky = room(size)
        residual, multipart = split_map(sky).residual, message(split_map(sky))
        world = to_world(residual, RESIDUAL_SIZE)
        times = [median_ms(lambda sky=sky, count=count: split_map(sky, count)) for count in COUNTS]  # type: ignore[misc]
        times.append(median_ms(lambda sky=sky: split_map(sky, COUNTS[-1], whole_map=True)))  # type: ignore[misc]
        times.append(median_ms(lambda residual=residual: to_world(residual, RESIDUAL_SIZE).filled()))  # type: ignore[misc]
        times.append(median_ms(lambda sky=sky: message(split_map(sky))))  # type: ignore[misc]
        times.append(median_ms(lambda multipart=multipart: taken(multipart)))  # type: ignore[misc]
        times.append(median_ms(lambda world=world: prefilter(world.filled())))  # type: ignore[misc]
        table.add_row(f"{size}x{size}", *(f"{value:.2f}" for value in times))
    Console().print(table)


if __name__ == "__main__":
    typer.run(main)
