"""Writing a recording (docs/formats.md 2): an MCAP file that loses at most the last second at any crash."""

import json
import os
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import IO, Self, cast

from mcap.writer import CompressionType, Writer
from mcap_protobuf.schema import register_schema

from deltalight.protocol.board import BoardSpec
from deltalight.protocol.calibration import Extrinsics
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.files import ACTIVE_SUFFIX
from deltalight.protocol.frames import SensorFrame
from deltalight.protocol.growing_file import PASSING_ERRORS, GrowingFile
from deltalight.protocol.recording_format import (
    COMPOSITE_TOPIC,
    FOXGLOVE_TOPICS,
    OWN_TOPICS,
    SCENE_ATTACHMENT,
    SCENE_TOPIC,
    SESSION_TOPIC,
    SessionRecord,
)
from deltalight.protocol.recording_messages import FrameMessages, composite_message
from deltalight.protocol.recording_scene import scene_message
from deltalight.protocol.scene import DIGEST_PREFIX, SceneDocument

CHUNK_BYTES = 256 * 1024
SYNC_PERIOD_S = 1.0
NO_SCHEMA = 0  # of MCAP's channels


class DiskRefusesError(DeltalightError):
    """The disk is full or read-only, or a limit is reached: `RecordingWriter.resume` goes on when that has passed."""


class RecordingWriter:
    """Writes frames to an `.mcap` file; use it as a context manager, or call `close`.

    While it grows the file is called `*.mcap.active`. Every frame is handed to the system when `add` returns, in
    chunks of its own (at most 256 kB, or one message), and the disk is synchronised every second. If the `with` block
    ends by an exception the file keeps that name (without frames it is removed); otherwise it is renamed.

    Colour is stored as the frame's JPEG bytes if it has them, else as PNG. Depth is stored without loss: in 16-bit
    steps if one of the usual steps is exact, else as 32-bit floats. With `depth_scale` (metres) it is rounded to
    these steps. Fish-eye pictures are stored without loss, once for all frames that share them; they are identified
    by their time. Asset paths of the attached scene are stored relative to the recording.

    If the disk refuses a frame or relit picture after the first frame, the file ends with the one before, and the
    writer holds the refused one: call `resume` until it succeeds, and only then add others.

    Raises:
        DiskRefusesError: the disk is full or read-only.
        DeltalightError: the name is taken or not `*.mcap`, the disk fails, or frames are out of order.
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
        extrinsics = extrinsics or Extrinsics()
        self._messages = FrameMessages(extrinsics, depth_scale)
        self._session = SessionRecord(board=board, extrinsics=extrinsics.to_dict(), depth_scale=depth_scale)
        self._scene = scene
        self._last_ns, self._count, self._is_open = -1, 0, True
        with self._disk_errors():
            self._file = GrowingFile(self.active_path)
            stream = cast("IO[bytes]", self._file)  # which has what the writer calls
            self._writer = Writer(stream, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
            self._writer.start(library="deltalight")
            self._channels = self._register_channels()
            if scene is not None:
                self._attach_scene(scene)
            self._commit_beginning()
        self._stop = threading.Event()
        self._syncing = threading.Thread(target=self._sync_each_second, name="recording-sync", daemon=True)
        self._syncing.start()

    def __enter__(self) -> Self:
        """Returns the writer."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Finishes the file; after an exception it keeps its `.active` name."""
        self._finish(rename=error is None)

    def close(self) -> None:
        """Writes the index and renames the file; idempotent."""
        self._finish(rename=True)

    def add(self, frame: SensorFrame) -> None:
        """Appends a frame, later than the one before."""
        if not self._is_open:
            raise DeltalightError(f"{self.path} is already finished; start another recording.")
        if frame.timestamp_ns <= self._last_ns:
            raise DeltalightError(
                f"frame {frame.frame_id} is not later than the one before; record in order."
            )
        if self._count == 0:
            self._write(SESSION_TOPIC, frame.timestamp_ns, self._session.packed())
            # In a chunk with nothing but the channels, because without these no other chunk can be read.
            self._writer.flush()
            if self._scene is not None:
                self._write(SCENE_TOPIC, frame.timestamp_ns, scene_message(self._scene, frame.timestamp_ns))
        for topic, data in self._messages.of(frame):
            self._write(topic, frame.timestamp_ns, data)
        self._last_ns = frame.timestamp_ns
        self._count += 1
        self._commit()

    def add_composite(self, timestamp_ns: int, picture: bytes) -> None:
        """Appends the relit picture, JPEG or PNG, of a frame that was added before without one."""
        self._write(COMPOSITE_TOPIC, timestamp_ns, composite_message(picture, timestamp_ns))
        self._commit()

    def resume(self) -> None:
        """Writes what the disk refused.

        Raises:
            DiskRefusesError: it still refuses.
            DeltalightError: the file was removed or truncated meanwhile, or the disk fails.
        """
        with self._disk_errors():
            self._file.commit()

    def _commit(self) -> None:
        """Ends the chunk in progress, so that frames are whole, and hands it to the system."""
        self._writer.flush()
        with self._disk_errors():
            self._file.commit()

    def _commit_beginning(self) -> None:
        try:
            self._file.commit()
        except OSError:
            self.active_path.unlink(missing_ok=True)
            raise

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
            kind = DiskRefusesError if error.errno in PASSING_ERRORS else DeltalightError
            raise kind(
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
            # No schema of MCAP describes msgpack: what a message holds is told beside it.
            told = {"name": f"deltalight.{record.__name__}", "fields": json.dumps(record.model_json_schema())}
            channels[topic] = self._writer.register_channel(topic, "msgpack", NO_SCHEMA, told)
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

    def _sync_each_second(self) -> None:
        """Synchronises in a separate thread, so that a slow disk does not delay the frames."""
        while not self._stop.wait(SYNC_PERIOD_S):
            with suppress(
                OSError
            ):  # the next frame, which is written anew with what may be lost, tells of it
                self._file.sync()

    def _finish(self, *, rename: bool) -> None:
        if not self._is_open:
            return
        self._is_open = False
        self._stop.set()
        self._syncing.join()
        with self._disk_errors(), closing(self._file):
            self._writer.finish()
            self._file.commit()
            self._file.sync()
        if self._count == 0:
            self.active_path.unlink()
        elif rename:
            self.active_path.rename(self.path)
