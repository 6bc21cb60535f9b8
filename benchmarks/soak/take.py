"""The recording that the nodes of a soaked station replay: the demo's, at rest, at another size and rate."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from deltalight.benchmarks.speed.motions import STANDING
from deltalight.protocol.frames import DepthImage, SensorFrame
from deltalight.protocol.recording_reader import RecordingReader
from deltalight.protocol.recording_writer import RecordingWriter
from deltalight.services.demo import RECORDING


def write_take(path: Path, size: tuple[int, int], frames_per_s: float) -> None:
    """Write the frames in which nothing moves but noise: pictures before and after a fault can be compared.

    Raises:
        DeltalightError: the demo's recording is missing, or the file cannot be written.
    """
    reader = RecordingReader(RECORDING)
    began_ns, period_ns = reader.timestamps_ns[0], round(1e9 / frames_per_s)
    with RecordingWriter(path, board=reader.board, extrinsics=reader.extrinsics) as writer:
        for number in STANDING:
            now_ns = began_ns + number * period_ns
            frame = resized(reader[number], size)
            writer.add(replace(frame, frame_id=number, timestamp_ns=now_ns, depth_timestamp_ns=now_ns))


def resized(frame: SensorFrame, size: tuple[int, int]) -> SensorFrame:
    """Return a frame whose colour and registered depth have another size (width, height, pixels)."""
    camera, depth = frame.camera.resized(*size), frame.depth
    color = cv2.resize(frame.color, size, interpolation=cv2.INTER_AREA)
    if depth is not None:
        metres = cv2.resize(depth.depth_m, size, interpolation=cv2.INTER_NEAREST)
        valid = cv2.resize(depth.valid.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST).astype(bool)
        depth = DepthImage(metres, valid, camera, depth.noise_sigma_m)
    return replace(frame, color=color.astype(np.uint8), camera=camera, depth=depth, color_jpeg=None)
