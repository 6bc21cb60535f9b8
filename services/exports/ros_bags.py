"""ROS 1 and ROS 2 bags: recordings written as the usual messages of RGB-D cameras, and such bags read (extra `ros`).

Depth is 16-bit millimetres or 32-bit metres (REP 118), poses are in `/tf`, the sensors' transform in `/tf_static`.
What ROS has no message for, board, response and scene, is JSON on `/deltalight/description`. Relit and fish-eye
pictures have topics below `/deltalight/` too, so that the bag has one colour camera.
"""

import json
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, Literal, cast

import numpy as np
from jaxtyping import Float64
from pydantic import Field

from deltalight.protocol.board import BoardSpec
from deltalight.protocol.calibration import Extrinsics
from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.documents import StrictModel, validate
from deltalight.protocol.errors import DeltalightError, install_command
from deltalight.protocol.frames import DepthImage, SensorFrame
from deltalight.protocol.pictures import decode_rgb, depth_from_steps, is_jpeg, known_depth, steps_from_depth
from deltalight.protocol.poses import rigid_matrix, rotation_from_wxyz, wxyz_from_rotation
from deltalight.protocol.recording_writer import RecordingWriter
from deltalight.protocol.ros_bag_names import BAG_METADATA, BAG_SUFFIX
from deltalight.protocol.scene import SceneDocument
from deltalight.protocol.source import Source
from deltalight.services.exports.ros_fisheye import FISHEYE_TOPICS, FisheyeReader, write_fisheye
from deltalight.services.files import appearing, make_output_folder, require_absent, require_recording_name
from deltalight.services.recording_copies import Copied, Track

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader
    from rosbags.typesys.store import Typestore

COLOR, DEPTH = "/camera/color", "/camera/depth"
OWN = "/deltalight/"
DESCRIPTION, EXPOSURE = f"{OWN}description", f"{OWN}exposure_s"
COMPOSITE = f"{OWN}composite/compressed"
WORLD, COLOR_FRAME, DEPTH_FRAME = "world", "camera_color_optical_frame", "camera_depth_optical_frame"
WORLDS = (WORLD, "map")
TOGETHER_NS = 20_000_000  # what is farther apart is not of the same frame
MILLIMETRE = 0.001
NO_ROSBAGS = f"ROS bags need the package rosbags: {install_command('rosbags')}."

Version = Literal["ros1", "ros2"]


class Description(StrictModel):
    """What a recording says that ROS has no message for."""

    board: BoardSpec | None = None
    extrinsics: dict[str, list[list[float]]] = Field(default_factory=dict)
    depth_scale: float | None = None
    noise_sigma_m: float | None = None
    response: list[list[float]] | None = None
    scene: SceneDocument | None = None


@dataclass
class _Bag:
    """A bag that is being written: a connection for each topic, made when it is first used."""

    writer: Any
    store: "Typestore"
    version: Version
    connections: dict[str, Any] = field(default_factory=dict)
    fisheye_ns: int | None = None  # time of the fish-eye pictures that were written last

    def make(self, kind: str, *values: object, **named: object) -> Any:  # noqa: ANN401 - classes made at run time
        """Returns a message such as `sensor_msgs/msg/Image`."""
        return self.store.types[kind](*values, **named)

    def header(self, time_ns: int, frame: str) -> Any:  # noqa: ANN401
        """Returns a header; ROS 1 counts messages in it."""
        stamp = self.make("builtin_interfaces/msg/Time", time_ns // 10**9, time_ns % 10**9)
        numbers = (0,) if self.version == "ros1" else ()
        return self.make("std_msgs/msg/Header", *numbers, stamp, frame)

    def image(self, header: object, encoding: str, picture: np.ndarray) -> Any:  # noqa: ANN401
        """Returns an uncompressed picture."""
        height, width = picture.shape[:2]
        data = np.ascontiguousarray(picture).view(np.uint8).ravel()
        step = data.size // height
        return self.make("sensor_msgs/msg/Image", header, height, width, encoding, 0, step, data)

    def write(self, topic: str, time_ns: int, message: Any) -> None:  # noqa: ANN401
        """Appends a message."""
        kind = message.__msgtype__
        if topic not in self.connections:
            self.connections[topic] = self.writer.add_connection(topic, kind, typestore=self.store)
        serialize = self.store.serialize_ros1 if self.version == "ros1" else self.store.serialize_cdr
        self.writer.write(self.connections[topic], time_ns, serialize(message, kind))


def export_bag(source: Source, out: Path, version: Version, track: Track) -> Copied:
    """Writes frames as a bag: a file `.bag` for ROS 1, a folder for ROS 2.

    Raises:
        DeltalightError: rosbags is missing, a frame is damaged, `out` is taken, or the disk refuses.
    """
    if version == "ros1" and out.suffix != ".bag":
        raise DeltalightError(f"{out} must end in .bag; choose another name.")
    require_absent(out)
    make_output_folder(out.parent)
    store = _store(version)
    with TemporaryDirectory(dir=out.parent, prefix=f".{out.name}.") as folder:
        made = Path(folder) / out.name  # ROS 2 names the files inside after the folder
        with _writer(made, version) as writer:
            bag = _Bag(writer, store, version)
            for index in track(range(len(source))):
                frame = source[index]
                if index == 0:
                    _write_description(bag, source, frame)
                _write_frame(bag, frame)
        require_absent(out)
        made.rename(out)
    return Copied(out, len(source), notes=source.notes)


def _writer(path: Path, version: Version) -> Any:  # noqa: ANN401
    if version == "ros1":
        from rosbags.rosbag1 import Writer as Writer1

        return Writer1(path)
    from rosbags.rosbag2 import Writer as Writer2

    return Writer2(path, version=9)


def _store(version: Version) -> "Typestore":
    try:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ImportError as fault:
        raise DeltalightError(NO_ROSBAGS) from fault
    store = get_typestore(Stores.ROS1_NOETIC if version == "ros1" else Stores.ROS2_HUMBLE)
    if version == "ros1":  # which lists tf2_msgs among packages of its own
        text = "geometry_msgs/TransformStamped[] transforms"
        store.register(get_types_from_msg(text, "tf2_msgs/msg/TFMessage"))
    return store


def _write_description(bag: _Bag, source: Source, first: SensorFrame) -> None:
    depth = first.depth
    described = Description(
        board=source.board,
        extrinsics=source.extrinsics.to_dict(),
        depth_scale=source.depth_scale,
        noise_sigma_m=None if depth is None else depth.noise_sigma_m,
        response=None if first.response is None else np.asarray(first.response, float).tolist(),
        scene=source.scene,
    )
    now_ns = first.timestamp_ns
    bag.write(DESCRIPTION, now_ns, bag.make("std_msgs/msg/String", described.model_dump_json()))
    depth_from_rgb = source.extrinsics.depth_from_rgb
    if depth_from_rgb is not None:
        rgb_from_depth = np.linalg.inv(depth_from_rgb)
        bag.write("/tf_static", now_ns, _transform(bag, now_ns, COLOR_FRAME, DEPTH_FRAME, rgb_from_depth))


def _write_frame(bag: _Bag, frame: SensorFrame) -> None:
    time_ns, header = frame.timestamp_ns, bag.header(frame.timestamp_ns, COLOR_FRAME)
    if frame.fisheye is not None and frame.fisheye.timestamp_ns != bag.fisheye_ns:
        bag.fisheye_ns = frame.fisheye.timestamp_ns
        write_fisheye(bag, frame.fisheye, time_ns)
    pose = frame.found_pose if frame.world_from_camera is None else frame.world_from_camera
    if pose is not None:
        bag.write("/tf", time_ns, _transform(bag, time_ns, WORLD, COLOR_FRAME, pose))
    if frame.exposure_s is not None:
        bag.write(EXPOSURE, time_ns, bag.make("std_msgs/msg/Float64", frame.exposure_s))
    bag.write(f"{COLOR}/camera_info", time_ns, _camera_info(bag, header, frame.camera))
    if frame.composite is not None:
        bag.write(COMPOSITE, time_ns, _compressed(bag, header, frame.composite))
    if frame.color_jpeg is not None:
        bag.write(f"{COLOR}/image_raw/compressed", time_ns, _compressed(bag, header, frame.color_jpeg))
    else:
        bag.write(f"{COLOR}/image_raw", time_ns, bag.image(header, "rgb8", frame.color))
    if frame.depth is not None:
        depth_ns = frame.depth_timestamp_ns or time_ns
        _write_depth(bag, frame.depth, depth_ns, is_of_color=frame.depth.camera == frame.camera)


def _compressed(bag: _Bag, header: object, picture: bytes) -> Any:  # noqa: ANN401
    kind = "jpeg" if is_jpeg(picture) else "png"
    data = np.frombuffer(picture, np.uint8)
    return bag.make("sensor_msgs/msg/CompressedImage", header, kind, data)


def _write_depth(bag: _Bag, depth: DepthImage, time_ns: int, *, is_of_color: bool) -> None:
    header = bag.header(time_ns, COLOR_FRAME if is_of_color else DEPTH_FRAME)
    steps = steps_from_depth(depth, MILLIMETRE)
    is_exact = np.array_equal(
        depth_from_steps(steps, MILLIMETRE, depth.camera, None).depth_m, known_depth(depth)
    )
    image = ("16UC1", steps) if is_exact else ("32FC1", known_depth(depth))
    bag.write(f"{DEPTH}/camera_info", time_ns, _camera_info(bag, header, depth.camera))
    bag.write(f"{DEPTH}/image_raw", time_ns, bag.image(header, *image))


def _camera_info(bag: _Bag, header: object, camera: CameraModel) -> Any:  # noqa: ANN401
    values = camera.to_dict()
    terms, matrix = np.asarray(values["distortion"], float), camera.matrix
    name = values["distortion_model"]
    if name == "plumb_bob" and len(terms) > 5:
        name = "rational_polynomial"
    projection = np.hstack([matrix, np.zeros((3, 1))]).ravel()
    region = bag.make("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False)
    size = camera.height, camera.width
    arrays = terms, matrix.ravel(), np.eye(3).ravel(), projection
    return bag.make("sensor_msgs/msg/CameraInfo", header, *size, name, *arrays, 0, 0, region)


def _transform(bag: _Bag, time_ns: int, parent: str, child: str, matrix: Float64[np.ndarray, "4 4"]) -> Any:  # noqa: ANN401
    w, x, y, z = wxyz_from_rotation(matrix[:3, :3])
    moved = bag.make("geometry_msgs/msg/Vector3", *(float(value) for value in matrix[:3, 3]))
    turned = bag.make("geometry_msgs/msg/Quaternion", x, y, z, w)
    transform = bag.make("geometry_msgs/msg/Transform", moved, turned)
    stamped = bag.make("geometry_msgs/msg/TransformStamped", bag.header(time_ns, parent), child, transform)
    return bag.make("tf2_msgs/msg/TFMessage", [stamped])


def is_bag(path: Path) -> bool:
    """Whether a path looks like a ROS bag and not like a dataset folder."""
    return path.suffix.lower() == BAG_SUFFIX or (path / BAG_METADATA).is_file()


def import_bag(path: Path, out: Path, track: Track) -> Copied:
    """Writes a bag as a recording: its colour camera, the depth of the same moments, and poses in `/tf`.

    Poses are transforms that lead straight from `world` or `map` to the colour camera's frame.

    Raises:
        DeltalightError: rosbags is missing, the bag is broken or has no or several colour cameras, or `out` is taken.
    """
    require_recording_name(out)
    with closing(_BagReader(path)) as bag, appearing(out) as temporary:
        described = bag.description
        extrinsics = Extrinsics.from_dict(described.extrinsics, str(path))
        if extrinsics.depth_from_rgb is None:
            extrinsics = replace(extrinsics, depth_from_rgb=bag.depth_from_rgb())
        count, frames = 0, bag.frames()
        with RecordingWriter(
            temporary,
            board=described.board,
            extrinsics=extrinsics,
            scene=described.scene,
            depth_scale=described.depth_scale,
        ) as writer:
            for _ in track(range(bag.count)):
                frame = next(frames, None)
                if frame is None:
                    break
                writer.add(frame)
                count += 1
    if count == 0:
        raise DeltalightError(f"{path} has no colour pictures with a camera_info; record these topics too.")
    return Copied(out, count)


@dataclass(frozen=True)
class _Waiting:
    """A colour message that waits for what belongs to it."""

    message: Any
    time_ns: int


class _BagReader:
    """The frames of a bag, in order of time; nothing but a few messages is held."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._bag = _opened(path)
        topics = {name: info for name, info in self._bag.topics.items() if not name.startswith(OWN)}
        compressed = [
            name for name, info in topics.items() if info.msgtype == "sensor_msgs/msg/CompressedImage"
        ]
        raw = [name for name, info in topics.items() if info.msgtype == "sensor_msgs/msg/Image"]
        self._depth = next((name for name in raw if "depth" in name), None)
        colors = [name for name in (*compressed, *raw) if "depth" not in name]
        namespaces = {_namespace(name) for name in colors}
        if len(namespaces) != 1:
            names = ", ".join(sorted(namespaces)) or "none"
            raise DeltalightError(
                f"{path} must have one colour camera and has: {names}; cut the others out of it."
            )
        self._color = colors[0]
        self.count = sum(info.msgcount for name, info in topics.items() if name == self._color)
        self.description = self._read_description()
        self._time_ns = 0  # of the newest message, by whoever recorded it
        self._infos: dict[str, Any] = {}
        self._poses: deque[tuple[int, Float64[np.ndarray, "4 4"]]] = deque(maxlen=256)
        self._exposures: deque[tuple[int, float]] = deque(maxlen=256)
        self._depths: deque[tuple[int, Any]] = deque(maxlen=16)
        self._composites: deque[tuple[int, bytes]] = deque(maxlen=16)
        self._fisheye = FisheyeReader(f"of {path}", _rows)

    def close(self) -> None:
        """Closes the bag."""
        self._bag.close()

    def depth_from_rgb(self) -> Float64[np.ndarray, "4 4"] | None:
        """Returns the transform between the cameras' frames, if `/tf_static` has it directly."""
        for _, message in self._messages("/tf_static"):
            for each in message.transforms:
                if "depth" in each.child_frame_id and "depth" not in each.header.frame_id:
                    return np.linalg.inv(_matrix(each.transform))
        return None

    def frames(self) -> Iterator[SensorFrame]:
        """Yields every colour picture whose camera is known, with depth, pose and exposure of its moment."""
        waiting: deque[_Waiting] = deque()
        own = (EXPOSURE, COMPOSITE, *FISHEYE_TOPICS)
        wanted = [self._color, self._depth, "/tf", *own, *self._info_topics()]
        number = 0
        for topic, message in self._messages(*(name for name in wanted if name is not None)):
            time_ns = self._note(topic, message)
            if topic == self._color:
                waiting.append(_Waiting(message, time_ns))
            while waiting and time_ns > waiting[0].time_ns + 2 * TOGETHER_NS:
                yield from self._frame(waiting.popleft(), number)
                number += 1
        for each in waiting:
            yield from self._frame(each, number)
            number += 1

    def _info_topics(self) -> list[str]:
        return [f"{_namespace(name)}/camera_info" for name in (self._color, self._depth) if name is not None]

    def _note(self, topic: str, message: Any) -> int:  # noqa: ANN401
        """Keeps what a message says for the frames of its moment; returns its time."""
        if topic == "/tf":
            return self._note_poses(message.transforms)
        if topic == EXPOSURE:
            self._exposures.append((self._time_ns, float(message.data)))
            return self._time_ns
        if topic in FISHEYE_TOPICS:
            self._fisheye.add(topic, message, self._time_ns)
            return self._time_ns
        time_ns = _stamp_ns(message.header)
        if topic == self._depth:
            self._depths.append((time_ns, message))
        elif topic == COMPOSITE:
            self._composites.append((time_ns, bytes(message.data)))
        elif topic != self._color:
            self._infos[topic] = message
        return time_ns

    def _note_poses(self, transforms: Sequence[Any]) -> int:
        for each in transforms:
            if each.header.frame_id in WORLDS:
                self._poses.append((_stamp_ns(each.header), _matrix(each.transform)))
        return _stamp_ns(transforms[0].header) if transforms else 0

    def _frame(self, color: _Waiting, number: int) -> Iterator[SensorFrame]:
        """Yields the frame of a colour message; none while its camera is unknown."""
        time_ns = color.time_ns
        info = self._infos.get(f"{_namespace(self._color)}/camera_info")
        if info is None:
            return
        camera = _camera(info)
        picture, jpeg = self._picture(color.message)
        depth = _nearest(self._depths, time_ns)
        response = self.description.response
        yield SensorFrame(
            frame_id=number,
            timestamp_ns=time_ns,
            color=picture,
            camera=camera,
            response=None if response is None else np.asarray(response, np.float32),
            exposure_s=None if (found := _nearest(self._exposures, time_ns)) is None else found[1],
            depth=None if depth is None else self._depth_image(depth[1], camera),
            depth_timestamp_ns=None if depth is None else depth[0],
            world_from_camera=None if (pose := _nearest(self._poses, time_ns)) is None else pose[1],
            color_jpeg=jpeg,
            fisheye=self._fisheye.at(time_ns),
            composite=None if (relit := _nearest(self._composites, time_ns)) is None else relit[1],
        )

    def _picture(self, message: Any) -> tuple[np.ndarray, bytes | None]:  # noqa: ANN401
        name = f"on {self._color} of {self.path}"
        if message.__msgtype__ == "sensor_msgs/msg/CompressedImage":
            data = bytes(message.data)
            return decode_rgb(data, name), data if is_jpeg(data) else None
        if message.encoding not in ("rgb8", "bgr8"):
            raise DeltalightError(f"The picture {name} is {message.encoding}; record rgb8, bgr8 or JPEG.")
        picture = _rows(message, np.dtype(np.uint8), 3, name)
        return np.ascontiguousarray(picture if message.encoding == "rgb8" else picture[..., ::-1]), None

    def _depth_image(self, message: Any, color_camera: CameraModel) -> DepthImage:  # noqa: ANN401
        name = f"on {self._depth} of {self.path}"
        info = self._infos.get(f"{_namespace(cast(str, self._depth))}/camera_info")
        camera = color_camera if info is None else _camera(info)
        noise = self.description.noise_sigma_m
        order = ">" if message.is_bigendian else "<"
        if message.encoding in ("16UC1", "mono16"):
            steps = _rows(message, np.dtype(f"{order}u2"), 1, name)[..., 0].astype(np.uint16)
            return depth_from_steps(steps, MILLIMETRE, camera, noise)
        if message.encoding != "32FC1":
            raise DeltalightError(f"The depth {name} is {message.encoding}; record 16UC1 or 32FC1.")
        metres = _rows(message, np.dtype(f"{order}f4"), 1, name)[..., 0].astype(np.float32)
        valid = np.isfinite(metres) & (metres > 0)
        return DepthImage(np.where(valid, metres, np.float32(0)), valid, camera, noise)

    def _read_description(self) -> Description:
        for _, message in self._messages(DESCRIPTION):
            return validate(Description, json.loads(message.data), f"{DESCRIPTION} of {self.path}")
        return Description()

    def _messages(self, *topics: str) -> Iterator[tuple[str, Any]]:
        """Yields (topic, message) in order of time."""
        connections = [each for each in self._bag.connections if each.topic in topics]
        if not connections:
            return
        for connection, time_ns, data in self._bag.messages(connections):
            self._time_ns = time_ns
            yield connection.topic, self._bag.deserialize(data, connection.msgtype)


def _opened(path: Path) -> "AnyReader":
    if not path.exists():
        raise DeltalightError(f"{path} does not exist; give a .bag file or the folder of a ROS 2 bag.")
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError as fault:
        raise DeltalightError(NO_ROSBAGS) from fault
    try:
        with _named_for_rosbags(path) as named:
            # ROS 2 before 2023 stores no definitions of messages.
            bag = AnyReader([named], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
            bag.open()
    except Exception as fault:  # a damaged bag can make the reader fail in any way
        raise DeltalightError(f"{path} cannot be read as a ROS bag ({fault}); record it again.") from fault
    return bag


@contextmanager
def _named_for_rosbags(path: Path) -> Iterator[Path]:
    """Yields a path by which rosbags knows a ROS 1 bag while it opens it: it asks for `.bag` in small letters."""
    if path.suffix == BAG_SUFFIX or path.suffix.lower() != BAG_SUFFIX:
        yield path
        return
    with TemporaryDirectory(prefix="deltalight-") as folder:
        link = Path(folder) / f"{path.stem}{BAG_SUFFIX}"
        link.symlink_to(path.absolute())
        yield link


def _namespace(topic: str) -> str:
    """Returns a camera's namespace: /camera/color of /camera/color/image_raw/compressed."""
    return topic.removesuffix("/compressed").rpartition("/")[0]


def _stamp_ns(header: Any) -> int:  # noqa: ANN401
    return int(header.stamp.sec) * 10**9 + int(header.stamp.nanosec)


def _nearest(of: deque[tuple[int, Any]], time_ns: int) -> tuple[int, Any] | None:
    """Returns what is nearest in time, if it is of the same frame."""
    found = min(of, key=lambda each: abs(each[0] - time_ns), default=None)
    return found if found is not None and abs(found[0] - time_ns) <= TOGETHER_NS else None


def _matrix(transform: Any) -> Float64[np.ndarray, "4 4"]:  # noqa: ANN401
    moved, turned = transform.translation, transform.rotation
    rotation = rotation_from_wxyz((turned.w, turned.x, turned.y, turned.z))
    return rigid_matrix(rotation, (moved.x, moved.y, moved.z))


def _camera(info: Any) -> CameraModel:  # noqa: ANN401
    """Returns the camera of a camera_info; ROS 1 writes its matrices in capitals."""
    matrix, terms = (info.K, info.D) if hasattr(info, "K") else (info.k, info.d)
    name = "equidistant" if info.distortion_model == "equidistant" else "plumb_bob"
    values = {"width": info.width, "height": info.height, "distortion_model": name}
    return CameraModel.from_dict({**values, "matrix": list(matrix), "distortion": list(terms)})


def _rows(message: Any, kind: "np.dtype[Any]", channels: int, name: str) -> np.ndarray:  # noqa: ANN401
    """Returns the pixels of an image message; its rows may be padded."""
    width_bytes = message.width * channels * kind.itemsize
    data = np.asarray(message.data, np.uint8)
    if message.step < width_bytes or data.size < message.step * message.height:
        raise DeltalightError(f"The picture {name} is shorter than its header says; record it again.")
    rows = data[: message.step * message.height].reshape(message.height, message.step)[:, :width_bytes]
    return np.ascontiguousarray(rows).view(kind).reshape(message.height, message.width, channels)
