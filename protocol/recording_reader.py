"""Reading a recording (docs/formats.md 2), even a truncated one."""

import struct
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import IO, Any

import numpy as np
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.message import DecodeError  # type: ignore[import-untyped]
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Attachment, Channel, Chunk, Message, MessageIndex
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.summary import Summary
from mcap.writer import MCAP0_MAGIC
from zstandard import ZstdError

from deltalight.protocol.board import BoardSpec
from deltalight.protocol.calibration import Extrinsics
from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.counts import counted
from deltalight.protocol.documents import parse_mapping
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import DepthImage, SensorFrame
from deltalight.protocol.pictures import decode_rgb, depth_from_steps, is_jpeg
from deltalight.protocol.recording_fisheye import FisheyeTrack
from deltalight.protocol.recording_format import (
    COLOR_FRAME,
    COLOR_TOPIC,
    COMPOSITE_TOPIC,
    DEPTH_TOPIC,
    FISHEYE_RECORD_TOPIC,
    FRAME_TOPIC,
    POSE_TOPIC,
    SCENE_ATTACHMENT,
    SESSION_TOPIC,
    DepthRecord,
    FrameRecord,
    SessionRecord,
    matrix_of,
)
from deltalight.protocol.ros_bag_names import refuse_bag
from deltalight.protocol.scene import SceneDocument, parse_scene, resolve_asset

MAX_RECORD_BYTES = 512 * 1024 * 1024
RECORD_TOPICS = (FRAME_TOPIC, FISHEYE_RECORD_TOPIC)
LAST_NS = 2**63 - 1  # of times in arrays, which have a sign; those of MCAP have none
RECORD_HEAD = struct.Struct("<BQ")
# Exceptions of the mcap package for damaged records (the last three come from wrong offsets and lengths).
DAMAGE = (McapError, ZstdError, struct.error, ValueError, LookupError, OverflowError, OSError, MemoryError)

Times = defaultdict[str, set[int]]  # log times of the records of each topic


@dataclass(frozen=True)
class _Span:
    """Offset of a chunk in the file, and the times of its messages."""

    offset: int
    start_ns: int
    end_ns: int


class RecordingReader:
    """The frames of a recording, decoded on demand; a `Source`.

    `notes` says whether the file was unfinished or damaged and how many frames were found. `board` replaces the board
    in the recording.

    Raises:
        DeltalightError: not a recording, of another schema version, or without a complete frame.
    """

    def __init__(self, path: Path, board: BoardSpec | None = None) -> None:
        self.path = path
        self.notes: list[str] = []
        self._channels: dict[int, str] = {}
        self._spans: list[_Span] = []
        self._cached: tuple[int, list[Message]] = (-1, [])
        self._scene_json: bytes | None = None
        times = self._open()
        self.timestamps_ns = sorted(times[FRAME_TOPIC])
        self._fisheye = FisheyeTrack(sorted(times[FISHEYE_RECORD_TOPIC]), self._parts, str(path))
        self._starts_ns = np.array([span.start_ns for span in self._spans], np.uint64)
        self._ends_ns = np.array([span.end_ns for span in self._spans], np.uint64)
        if not self.timestamps_ns:
            raise DeltalightError(f"{path} holds no complete Deltalight frame; record it again.")
        if self.timestamps_ns[-1] > LAST_NS:
            raise DeltalightError(
                f"{path} has a frame after the year 2262, so it is damaged; record it again."
            )
        session = self._read_session()
        self.board = board or session.board
        self.extrinsics = Extrinsics.from_dict(session.extrinsics, str(path))
        first, _ = self._read_record(0)
        self.camera = CameraModel.from_dict(first.camera)
        self.depth_scale = session.depth_scale or (first.depth.scale if first.depth else None)
        self.scene = self._read_scene()
        self._note_missing(first)

    def __len__(self) -> int:
        return len(self.timestamps_ns)

    def __iter__(self) -> Iterator[SensorFrame]:
        """Yields every frame in order."""
        return (self[index] for index in range(len(self)))

    def __getitem__(self, index: int) -> SensorFrame:
        """Decodes one frame.

        Raises:
            IndexError: no such frame.
            DeltalightError: the frame's messages are damaged.
        """
        record, parts = self._read_record(range(len(self))[index])
        name = f"{self.path} frame {record.frame_id}"
        try:
            data = CompressedImage.FromString(parts[COLOR_TOPIC]).data
            depth = None if record.depth is None else _depth_image(record.depth, parts[DEPTH_TOPIC])
            relit = parts.get(COMPOSITE_TOPIC)
            composite = None if relit is None else CompressedImage.FromString(relit).data
        except (KeyError, ValueError, DecodeError) as error:
            raise DeltalightError(f"{name} is damaged; leave it out of the range of frames.") from error
        color, camera = decode_rgb(data, name), self._camera(record)
        if color.shape[:2] != (camera.height, camera.width):
            raise DeltalightError(f"{name} has a picture whose size differs from its camera's; leave it out.")
        pose = record.world_from_camera
        return SensorFrame(
            frame_id=record.frame_id,
            timestamp_ns=record.timestamp_ns,
            color=color,
            camera=camera,
            response=_response(record),
            exposure_s=record.exposure_s,
            depth=depth,
            depth_timestamp_ns=None if record.depth is None else record.depth.timestamp_ns,
            world_from_camera=None if pose is None else np.array(pose).reshape(4, 4),
            color_jpeg=data if is_jpeg(data) else None,
            fisheye=self._fisheye.at(record.timestamp_ns),
            found_pose=_found_pose(parts.get(POSE_TOPIC)) if pose is None else None,
            composite=composite,
        )

    def _camera(self, record: FrameRecord) -> CameraModel:
        """Returns the camera, the same instance while it does not change, so that its rays are computed once."""
        camera = CameraModel.from_dict(record.camera)
        return self.camera if camera == self.camera else camera

    def _open(self) -> Times:
        """Finds the chunks and the times of all records: by the index if there is one, else by a scan."""
        try:
            with self.path.open("rb") as file:
                if file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
                    refuse_bag(self.path)
                    raise DeltalightError(f"{self.path} is not an MCAP recording; give a file that is.")
                try:
                    summary = _summary(file)
                    if summary is not None:
                        return self._use_index(file, summary)
                except DAMAGE:
                    self._channels, self._spans = {}, []
                return self._scan(file)
        except OSError as error:
            raise DeltalightError(
                f"{self.path} cannot be read ({error.strerror}); give an .mcap recording."
            ) from error

    def _use_index(self, file: IO[bytes], summary: Summary) -> Times:
        self._channels = {channel.id: channel.topic for channel in summary.channels.values()}
        records = {number: topic for number, topic in self._channels.items() if topic in RECORD_TOPICS}
        times: Times = defaultdict(set)
        for chunk in summary.chunk_indexes:
            self._spans.append(
                _Span(chunk.chunk_start_offset, chunk.message_start_time, chunk.message_end_time)
            )
            for number in records.keys() & chunk.message_index_offsets.keys():
                index = _record_at(file, chunk.message_index_offsets[number])
                entries = index.records if isinstance(index, MessageIndex) else []
                times[records[number]].update(time for time, _ in entries)
        for entry in summary.attachment_indexes:
            attachment = _record_at(file, entry.offset) if entry.name == SCENE_ATTACHMENT else None
            if isinstance(attachment, Attachment):
                self._scene_json = attachment.data
        return times

    def _scan(self, file: IO[bytes]) -> Times:
        topics: dict[int, set[str]] = defaultdict(set)
        damaged = 0
        for opcode, offset in _walk(file):
            try:
                self._scan_record(opcode, _record_at(file, offset), offset, topics)
            except DAMAGE:
                damaged += 1
        frames = {time for time, found in topics.items() if {FRAME_TOPIC, COLOR_TOPIC} <= found}
        fisheyes = {time for time, found in topics.items() if FISHEYE_RECORD_TOPIC in found}
        lost = f", without {counted(damaged, 'damaged part')}" if damaged else ""
        were = "frame was" if len(frames) == 1 else "frames were"
        self.notes.append(
            f"{self.path} was not finished; {len(frames)} {were} recovered by reading it through{lost}."
        )
        return defaultdict(set, {FRAME_TOPIC: frames, FISHEYE_RECORD_TOPIC: fisheyes})

    def _scan_record(self, opcode: int, record: Any, offset: int, topics: dict[int, set[str]]) -> None:  # noqa: ANN401
        if opcode == Opcode.ATTACHMENT and isinstance(record, Attachment) and record.name == SCENE_ATTACHMENT:
            self._scene_json = record.data
        if opcode != Opcode.CHUNK:
            return
        contents = _chunk_contents(record)
        self._channels.update({item.id: item.topic for item in contents if isinstance(item, Channel)})
        for item in contents:
            if isinstance(item, Message):
                topics[item.log_time].add(self._channels[item.channel_id])
        self._spans.append(_Span(offset, record.message_start_time, record.message_end_time))

    def _parts(self, time_ns: int) -> list[tuple[str, bytes]]:
        """Returns the readable messages (topic, data) of a time in their order."""
        near = np.flatnonzero((self._starts_ns <= time_ns) & (time_ns <= self._ends_ns))
        messages = (message for index in near for message in self._messages(self._spans[index].offset))
        return [
            (self._channels.get(part.channel_id, ""), part.data)
            for part in messages
            if part.log_time == time_ns
        ]

    def _messages(self, offset: int) -> list[Message]:
        """Returns the messages of a chunk, none of a damaged one.

        Caches the last, as frames are mostly read in order.
        """
        if self._cached[0] != offset:
            try:
                with self.path.open("rb") as file:
                    contents = _chunk_contents(_record_at(file, offset))
            except DAMAGE:
                contents = []
            self._cached = offset, [item for item in contents if isinstance(item, Message)]
        return self._cached[1]

    def _read_record(self, index: int) -> tuple[FrameRecord, dict[str, bytes]]:
        parts = dict(self._parts(self.timestamps_ns[index]))
        if FRAME_TOPIC not in parts:
            raise DeltalightError(f"{self.path} is damaged; leave frame {index} out.")
        return FrameRecord.unpacked(parts[FRAME_TOPIC], str(self.path)), parts

    def _read_session(self) -> SessionRecord:
        parts = dict(self._parts(self.timestamps_ns[0]))
        if SESSION_TOPIC in parts:
            return SessionRecord.unpacked(parts[SESSION_TOPIC], str(self.path))
        self.notes.append(f"{self.path} has lost its beginning; board and transforms are unknown.")
        return SessionRecord()

    def _read_scene(self) -> SceneDocument | None:
        if self._scene_json is None:
            return None
        name, folder = f"{self.path} ({SCENE_ATTACHMENT})", self.path.parent
        text = self._scene_json.decode("utf-8", errors="replace")
        try:
            scene = parse_scene(parse_mapping(text, name, is_json=True), name)
            return scene.with_assets(lambda _place, asset: resolve_asset(asset, folder))
        except DeltalightError as error:  # the frames are usable all the same
            self.notes.append(f"the attached scene document is not used: {error}")
            return None

    def _note_missing(self, first: FrameRecord) -> None:
        if self.board is None:
            self.notes.append(f"{self.path} describes no marker board; no board is looked for.")
        elif self.board.white_albedo is None:
            albedo = self.board.paper_albedo
            self.notes.append(f"{self.path} gives no white_albedo; {albedo} is assumed for the paper.")
        if first.depth is None:
            self.notes.append(
                f"{self.path} begins without depth; the scene document must give a model of the room."
            )


def _summary(file: IO[bytes]) -> Summary | None:
    """Returns the index at the end of the file; None if the file was truncated."""
    file.seek(0, 2)
    if file.tell() < 2 * len(MCAP0_MAGIC):
        return None
    file.seek(-len(MCAP0_MAGIC), 2)
    if file.read() != MCAP0_MAGIC:
        return None
    file.seek(0)
    return SeekingReader(file).get_summary()


def _walk(file: IO[bytes]) -> Iterator[tuple[int, int]]:
    """Yields (opcode, offset) of every complete record, up to where the file was truncated (or filled with zeros)."""
    file.seek(0, 2)
    size, offset = file.tell(), len(MCAP0_MAGIC)
    while offset + RECORD_HEAD.size <= size:
        file.seek(offset)
        opcode, length = RECORD_HEAD.unpack(file.read(RECORD_HEAD.size))
        end = offset + RECORD_HEAD.size + length
        if opcode == 0 or end > size:
            return
        yield opcode, offset
        offset = end


def _record_at(file: IO[bytes], offset: int) -> Any:  # noqa: ANN401 - one of mcap's record classes
    file.seek(offset)
    head = file.read(RECORD_HEAD.size)
    _, length = RECORD_HEAD.unpack(head)
    if length > MAX_RECORD_BYTES:
        raise ValueError("a record is longer than any that is written")
    # From memory, so that a wrong length inside the record cannot request more than is there.
    record = BytesIO(head + file.read(length))
    return next(iter(StreamReader(record, skip_magic=True, emit_chunks=True).records), None)


def _chunk_contents(chunk: Any) -> list[Any]:  # noqa: ANN401 - mcap's record classes
    if not isinstance(chunk, Chunk) or chunk.uncompressed_size > MAX_RECORD_BYTES:
        raise ValueError("not a chunk that can be read")
    contents: list[Any] = breakup_chunk(chunk, validate_crc=True)
    return contents


def _depth_image(record: DepthRecord, data: bytes) -> DepthImage:
    image = RawImage.FromString(data)
    camera = CameraModel.from_dict(record.camera)
    kind = "<f4" if record.scale is None else "<u2"
    values = np.frombuffer(image.data, kind).reshape(image.height, image.width)
    if values.shape != (camera.height, camera.width):
        raise ValueError("the depth image's size differs from its camera's")
    if record.scale is not None:
        return depth_from_steps(values.astype(np.uint16), record.scale, camera, record.noise_sigma_m)
    depth_m = values.astype(np.float32)
    return DepthImage(depth_m, depth_m > 0, camera, record.noise_sigma_m)


def _found_pose(data: bytes | None) -> np.ndarray | None:
    """Returns the pose among a frame's transforms, whose last it is."""
    try:
        message = FrameTransform.FromString(data or b"")
    except DecodeError:
        return None
    return matrix_of(message) if message.child_frame_id == COLOR_FRAME else None


def _response(record: FrameRecord) -> np.ndarray | None:
    if record.response is None:
        return None
    return np.frombuffer(record.response, "<f4").reshape(256, 3).astype(np.float32)
