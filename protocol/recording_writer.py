"""Writing a recording (docs/formats.md 2): an MCAP file that loses at most the last second at any crash."""

import json
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from mcap.writer import CompressionType, Writer
from mcap_protobuf.schema import register_schema

from deltalight.protocol.board import BoardSpec
from deltalight.protocol.calibration import Extrinsics
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.files import ACTIVE_SUFFIX
from deltalight.protocol.frames import DepthImage, FisheyePictures, SensorFrame
from deltalight.protocol.pictures import encode_png, exact_depth_scale, known_depth, steps_from_depth
from deltalight.protocol.recording_fisheye import fisheye_messages
from deltalight.protocol.recording_format import (
    COLOR_CAMERA_TOPIC,
    COLOR_FRAME,
    COLOR_TOPIC,
    DEPTH_CAMERA_TOPIC,
    DEPTH_FRAME,
    DEPTH_TOPIC,
    FISHEYE_FRAME,
    FOXGLOVE_TOPICS,
    FRAME_TOPIC,
    OWN_TOPICS,
    POSE_TOPIC,
    SCENE_ATTACHMENT,
    SESSION_TOPIC,
    WORLD_FRAME,
    DepthRecord,
    FrameRecord,
    SessionRecord,
    calibration_message,
    timestamp_fields,
    transform_message,
)
from deltalight.protocol.scene import DIGEST_PREFIX, SceneDocument

CHUNK_BYTES = 256 * 1024
SYNC_PERIOD_S = 1.0


class RecordingWriter:
    """Writes frames to an `.mcap` file; use it as a context manager, or call `close`.

    While it grows the file is called `*.mcap.active`. Every frame is handed to the system when `add` returns, in
    chunks of its own (at most 256 kB, or one message), and the disk is synchronised every second. If the `with` block
    ends by an exception the file keeps that name (without frames it is removed); otherwise it is renamed.

    Colour is stored as the frame's JPEG bytes if it has them, else as PNG. Depth is stored without loss: in 16-bit
    steps if one of the usual steps is exact, else as 32-bit floats. With `depth_scale` (metres) it is rounded to
    these steps. Fish-eye pictures are stored without loss, once for all frames that share them; they are identified
    by their time. Asset paths of the attached scene are stored relative to the recording.

    Raises:
        DeltalightError: the name is taken or not `*.mcap`, the disk refuses, or frames are out of order.
    """

    def __init__(
        self,
        path: Path,
        *,
        board: BoardSpec | None = None,
        extrinsics: Extrinsics | None = None,
        scene: SceneDocument | None = None,
        depth_scale: float | None = None,
    ) -> None:
        self.path, self.active_path = path, path.with_name(path.name + ACTIVE_SUFFIX)
        self._check_names()
        self._extrinsics, self._depth_scale, self._usual_scale = (
            extrinsics or Extrinsics(),
            depth_scale,
            depth_scale,
        )
        self._session = SessionRecord(
            board=board, extrinsics=self._extrinsics.to_dict(), depth_scale=depth_scale
        )
        self._last_ns, self._count, self._is_open = -1, 0, True
        self._fisheye_ns: int | None = None
        with self._disk_errors():
            self._file = self.active_path.open("xb")
            self._writer = Writer(self._file, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
            self._writer.start(library="deltalight")
            self._channels = self._register_channels()
            if scene is not None:
                self._attach_scene(scene)
            self._file.flush()
        self._stop = threading.Event()
        self._syncing = threading.Thread(target=self._sync_each_second, name="recording-sync", daemon=True)
        self._syncing.start()

    def __enter__(self) -> Self:
        """Return the writer."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Finish the file; after an exception it keeps its `.active` name."""
        self._finish(rename=error is None)

    def close(self) -> None:
        """Write the index and rename the file; idempotent."""
        self._finish(rename=True)

    def add(self, frame: SensorFrame) -> None:
        """Append a frame, later than the one before."""
        if not self._is_open:
            raise DeltalightError(f"{self.path} is already finished; start another recording.")
        if frame.timestamp_ns <= self._last_ns:
            raise DeltalightError(
                f"frame {frame.frame_id} is not later than the one before; record in order."
            )
        with self._disk_errors():
            if self._count == 0:
                self._write(SESSION_TOPIC, frame.timestamp_ns, self._session.packed())
                # In a chunk with nothing but the channels, because without these no other chunk can be read.
                self._writer.flush()
            if frame.fisheye is not None and frame.fisheye.timestamp_ns != self._fisheye_ns:
                self._write_fisheye(frame.fisheye, frame.timestamp_ns)
            self._write_frame(frame)
            self._writer.flush()
        self._last_ns = frame.timestamp_ns
        self._count += 1

    def _check_names(self) -> None:
        if self.path.suffix != ".mcap":
            raise DeltalightError(f"{self.path} must end in .mcap; choose another name.")
        for taken in (self.path, self.active_path):
            if taken.exists():
                raise DeltalightError(f"{taken} already exists; choose another name or remove it.")

    @contextmanager
    def _disk_errors(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise DeltalightError(
                f"{self.active_path} cannot be written ({error.strerror}); "
                "free the disk or choose another place."
            ) from error

    def _register_channels(self) -> dict[str, int]:
        channels, schemas = (
            {},
            {kind: register_schema(self._writer, kind) for kind in set(FOXGLOVE_TOPICS.values())},
        )
        for topic, kind in FOXGLOVE_TOPICS.items():
            channels[topic] = self._writer.register_channel(topic, "protobuf", schemas[kind])
        for topic, record in OWN_TOPICS.items():
            schema = json.dumps(record.model_json_schema()).encode()
            schema_id = self._writer.register_schema(f"deltalight.{record.__name__}", "jsonschema", schema)
            channels[topic] = self._writer.register_channel(topic, "msgpack", schema_id)
        return channels

    def _attach_scene(self, scene: SceneDocument) -> None:
        folder = self.path.parent.resolve()

        def relative(_place: str, asset: str) -> str:
            is_path = not asset.startswith(DIGEST_PREFIX) and Path(asset).is_absolute()
            return os.path.relpath(Path(asset).resolve(), folder) if is_path else asset

        data = scene.with_assets(relative).canonical_json().encode()
        self._writer.add_attachment(0, 0, SCENE_ATTACHMENT, "application/json", data)

    def _write(self, topic: str, timestamp_ns: int, data: bytes) -> None:
        self._writer.add_message(self._channels[topic], timestamp_ns, data, timestamp_ns)

    def _write_frame(self, frame: SensorFrame) -> None:
        now = frame.timestamp_ns
        self._write(COLOR_TOPIC, now, _color_message(frame).SerializeToString())
        camera = calibration_message(frame.camera, COLOR_FRAME, now)
        self._write(COLOR_CAMERA_TOPIC, now, camera.SerializeToString())
        depth = None if frame.depth is None else self._write_depth(frame.depth, frame)
        pose = frame.world_from_camera
        if pose is not None:
            transform = transform_message(pose, WORLD_FRAME, COLOR_FRAME, now)
            self._write(POSE_TOPIC, now, transform.SerializeToString())
        record = FrameRecord(
            frame_id=frame.frame_id,
            timestamp_ns=now,
            camera=frame.camera.to_dict(),
            exposure_s=frame.exposure_s,
            response=None if frame.response is None else frame.response.astype("<f4").tobytes(),
            world_from_camera=None if pose is None else pose.ravel().tolist(),
            depth=depth,
            fisheye_ns=None if frame.fisheye is None else frame.fisheye.timestamp_ns,
        )
        self._write(FRAME_TOPIC, now, record.packed())

    def _write_depth(self, depth: DepthImage, frame: SensorFrame) -> DepthRecord:
        now, scale = frame.timestamp_ns, self._scale_for(depth)
        values = (
            known_depth(depth).astype("<f4")
            if scale is None
            else steps_from_depth(depth, scale).astype("<u2")
        )
        name = COLOR_FRAME if depth.camera == frame.camera else DEPTH_FRAME
        message = RawImage(
            timestamp=timestamp_fields(now if frame.depth_timestamp_ns is None else frame.depth_timestamp_ns),
            frame_id=name,
            width=values.shape[1],
            height=values.shape[0],
            encoding="32FC1" if scale is None else "16UC1",
            step=values.strides[0],
            data=values.tobytes(),
        )
        self._write(DEPTH_TOPIC, now, message.SerializeToString())
        camera = calibration_message(depth.camera, name, now)
        self._write(DEPTH_CAMERA_TOPIC, now, camera.SerializeToString())
        if name == DEPTH_FRAME:
            self._write_depth_place(now)
        return DepthRecord(
            camera=depth.camera.to_dict(),
            timestamp_ns=frame.depth_timestamp_ns,
            scale=scale,
            noise_sigma_m=depth.noise_sigma_m,
        )

    def _write_fisheye(self, pictures: FisheyePictures, now: int) -> None:
        for topic, data in fisheye_messages(pictures):
            self._write(topic, now, data)
        own, probe = self._extrinsics.rgb_from_fisheye, self._extrinsics.world_from_fisheye
        parent, place = (WORLD_FRAME, probe) if own is None else (COLOR_FRAME, own)
        if place is not None:
            transform = transform_message(place, parent, FISHEYE_FRAME, now)
            self._write(POSE_TOPIC, now, transform.SerializeToString())
        self._fisheye_ns = pictures.timestamp_ns

    def _write_depth_place(self, now: int) -> None:
        depth_from_rgb = self._extrinsics.depth_from_rgb
        rgb_from_depth = np.eye(4) if depth_from_rgb is None else np.linalg.inv(depth_from_rgb)
        transform = transform_message(rgb_from_depth, COLOR_FRAME, DEPTH_FRAME, now)
        self._write(POSE_TOPIC, now, transform.SerializeToString())

    def _scale_for(self, depth: DepthImage) -> float | None:
        if self._depth_scale is not None:
            return self._depth_scale
        # The last frame's exact step is most likely exact again.
        scale = exact_depth_scale(depth, self._usual_scale)
        self._usual_scale = scale
        return scale

    def _sync_each_second(self) -> None:
        """Synchronise in a separate thread, so that a slow disk does not delay the frames."""
        while not self._stop.wait(SYNC_PERIOD_S):
            os.fsync(self._file.fileno())

    def _finish(self, *, rename: bool) -> None:
        if not self._is_open:
            return
        self._is_open = False
        self._stop.set()
        self._syncing.join()
        with self._disk_errors(), self._file:
            self._writer.finish()
            self._file.flush()
            os.fsync(self._file.fileno())
        if self._count == 0:
            self.active_path.unlink()
        elif rename:
            self.active_path.rename(self.path)


def _color_message(frame: SensorFrame) -> CompressedImage:
    kind, data = ("jpeg", frame.color_jpeg) if frame.color_jpeg else ("png", encode_png(frame.color))
    stamp = timestamp_fields(frame.timestamp_ns)
    return CompressedImage(timestamp=stamp, frame_id=COLOR_FRAME, data=data, format=kind)
