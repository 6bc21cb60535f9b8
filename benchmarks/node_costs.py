"""What a frame costs a sensor node, by part: `deltalight bench node`."""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final, Literal

import cv2
import numpy as np
from rich.console import Console
from rich.table import Table

from deltalight import __version__
from deltalight.benchmarks.report_output import put_report
from deltalight.benchmarks.soak.station import write_take
from deltalight.benchmarks.speed.motions import STANDING
from deltalight.protocol.documents import StrictModel
from deltalight.protocol.recording_reader import RecordingReader
from deltalight.sensor_node.board_tracker import BoardTracker
from deltalight.sensor_node.depth import clean_depth, estimate_noise_sigma
from deltalight.sensor_node.frame_messages import Stamps, color_multipart, depth_multipart, pose_multipart
from deltalight.sensor_node.markers import BoardDetector
from deltalight.services.kept_memory import keep_freed_memory

REPORT: Final = "deltalight bench node"
MOVING = range(20, 30)
"""Frames of the demo in which its camera swings out and back."""
FRAMES_PER_S = 15.0
STAMPS = Stamps(node="camera", frame_id=0, capture_ns=0, clock_offset_ns=0, clock_bound_ns=None)
PARTS = ("reading", "pose", "clean depth", "messages")


class NodeReport(StrictModel):
    """What `bench node` measured: medians of processor time of a frame's parts and of all of it, ms, by motion."""

    report: Literal["deltalight bench node"] = REPORT
    version: str
    size: tuple[int, int]
    rounds: int
    motions: dict[str, dict[str, float]]


@dataclass
class _Times:
    """Seconds of processor time of each part, a value per frame."""

    parts: dict[str, list[float]] = field(default_factory=dict)

    @contextmanager
    def of(self, part: str) -> Iterator[None]:
        began_s = time.process_time()
        yield
        self.parts.setdefault(part, []).append(time.process_time() - began_s)

    def medians_ms(self) -> dict[str, float]:
        found = {part: 1e3 * float(np.median(values)) for part, values in self.parts.items()}
        whole = np.sum(list(self.parts.values()), axis=0)
        return {**found, "frame": 1e3 * float(np.median(whole))}


def measure_node(size: tuple[int, int], rounds: int, say: Callable[[str], None]) -> NodeReport:
    """Measures frames of the demo at a size (width, height), each `rounds` times.

    Raises:
        DeltalightError: the demo's recording is missing.
    """
    keep_freed_memory()  # as a node does, and the next
    cv2.setNumThreads(1)
    motions = {}
    with TemporaryDirectory(prefix="deltalight-bench-") as folder:
        for name, frames in {"rests": STANDING, "moves": MOVING}.items():
            say(f"measuring a camera that {name}")
            take = Path(folder) / f"{name}.mcap"
            write_take(take, size, FRAMES_PER_S, frames)
            motions[name] = _measured(RecordingReader(take), range(len(frames)), rounds)
    return NodeReport(version=__version__, size=size, rounds=rounds, motions=motions)


def _measured(source: RecordingReader, frames: Sequence[int], rounds: int) -> dict[str, float]:
    first = source[0].depth
    assert source.board is not None
    assert first is not None
    noise_m = first.noise_sigma_m or estimate_noise_sigma(first)  # a node measures it once
    tracker, times = BoardTracker(BoardDetector(source.board, source.camera)), _Times()
    for number in [*frames] * rounds:
        with times.of("reading"):
            frame = source[number]
        assert frame.depth is not None
        with times.of("pose"):
            pose = tracker.detect(frame.color)
        with times.of("clean depth"):
            clean = clean_depth(replace(frame.depth, noise_sigma_m=noise_m), frame.color)
        with times.of("messages"):
            depth_multipart(frame.depth, STAMPS, "depth", source.depth_scale)
            depth_multipart(clean, STAMPS, "clean_depth")
            pose_multipart(pose, source.board, STAMPS)
            color_multipart(frame, STAMPS, "jpeg", 90)
    return times.medians_ms()


def run_node_costs(size: tuple[int, int], rounds: int, *, out: Path | None, as_json: bool) -> None:
    """Measures, writes the report to `out` if given, and prints it."""
    report = measure_node(size, rounds, lambda text: Console(stderr=True).print(text))
    put_report(
        report.model_dump_json(indent=2), lambda: Console().print(_table(report)), out=out, as_json=as_json
    )


def _table(report: NodeReport) -> Table:
    table = Table(title="{} x {}, processor time of a frame, ms".format(*report.size))
    table.add_column("camera")
    for name in (*PARTS, "frame"):
        table.add_column(name, justify="right")
    for motion, found in report.motions.items():
        table.add_row(motion, *(f"{found[name]:.1f}" for name in (*PARTS, "frame")))
    return table
