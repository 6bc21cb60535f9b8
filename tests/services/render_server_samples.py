"""Stand-ins for the render server's control socket, and for the renderer in it."""

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np

from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import ViewFrame
from deltalight.protocol.messages import ControlRequest
from deltalight.protocol.request import ReplyServer
from deltalight.protocol.scene import SceneDocument
from deltalight.protocol.scene_fields import ShownView
from deltalight.render_server.camera_frames import CameraFrame
from deltalight.render_server.frame_budget import Level
from deltalight.render_server.renderer import OtherView
from deltalight.render_server.room_mesh import RoomMesh
from deltalight.services import ports

NOWHERE = {"kind": "nothing", "object": None, "point_m": None, "normal": None, "distance_m": None}


class Recorder:
    """Answers as the render server does; `asked` holds (op, payload) in their order.

    Where `gate` is closed, what changes or shows the picture waits, as for a slow renderer; `is_busy` tells that it
    does.
    """

    def __init__(self, control_port: int, epoch: int | None = None) -> None:
        self.epoch = epoch
        self.asked: list[tuple[str, dict[str, object]]] = []
        self.fault: str | None = None
        self.refusal: str | None = None  # of scenes
        self.scene_id: str | None = None
        self.revision, self.instance = 1, "stand-in"
        self.gate = threading.Event()
        self.gate.set()
        self.is_busy = threading.Event()
        self._server = ReplyServer(ports.endpoint(control_port), self._execute)

    def close(self) -> None:
        self.gate.set()
        self._server.close()

    def payloads(self, op: str) -> list[dict[str, Any]]:
        return [payload for asked, payload in self.asked if asked == op]

    def watched(self) -> list[ShownView]:
        """The views that are ordered."""
        orders = self.payloads("watch")
        return list(orders[-1]["views"]) if orders else []

    def _execute(self, request: ControlRequest) -> dict[str, object]:
        self.asked.append((request.op, dict(request.payload)))
        match request.op:
            case "ping":
                return {
                    "scene_id": self.scene_id,
                    "revision": self.revision,
                    "instance": self.instance,
                    "epoch": self.epoch,
                }
            case "set_scene":
                self._wait_at_gate()
                if self.refusal is not None:
                    raise DeltalightError(self.refusal)
                self.scene_id, self.revision = request.scene_id, request.revision or self.revision + 1
            case "pick":
                self._wait_at_gate()
                return {"frame_id": 1, **NOWHERE}
            case "snapshot":
                return self._snapshot(request.payload)
            case "room" if self.fault is None:
                Path(str(request.payload["file"])).write_bytes(b"glTF")
        return {}

    def _wait_at_gate(self) -> None:
        self.is_busy.set()
        self.gate.wait()
        self.is_busy.clear()

    def _snapshot(self, order: dict[str, object]) -> dict[str, object]:
        self._wait_at_gate()
        if self.fault is not None:
            raise DeltalightError(self.fault)
        folder, files, errors = Path(str(order["folder"])), [], {}
        for picture in order["pictures"]:  # type: ignore[attr-defined]
            if picture["view"] == "rsm":
                errors[picture["name"]] = "this scene has no shadow maps; choose another view."
                continue
            files.append(f"{picture['name']}.png")
            cv2.imwrite(str(folder / files[-1]), np.full((4, 6, 3), len(files), np.uint8))
        return {"frame_id": 17, "capture_ns": 1_763_700_000_000_000_000, "files": files, "errors": errors}


@dataclass
class Picture:
    color: np.ndarray
    status: Literal["ok", "no_pose"]
    camera: CameraModel
    world_from_camera: np.ndarray | None
    pass_times_ms: dict[str, float] = field(default_factory=lambda: {"linearize": 1.5})
    reused_pass_times_ms: dict[str, float] = field(default_factory=lambda: {"voxelize": 4.0})
    lights: list[dict[str, Any]] = field(default_factory=list)
    linear: np.ndarray | None = None
    level: Level | None = field(default_factory=lambda: Level("live", 0.5))
    others: tuple[OtherView, ...] = ()


@dataclass
class Picked:
    frame_id: int
    pixel: tuple[float, float]

    def as_dict(self) -> dict[str, object]:
        return {"frame_id": self.frame_id, "kind": "nothing", "pixel": list(self.pixel)}


@dataclass
class Started:
    finish: Callable[[], Picture]
    immediate: bool


class InvertingRenderer:
    """Inverts the picture; fails where the test says so."""

    def __init__(self) -> None:
        self.fails_at: set[int] = set()
        self.immediate = True
        self.notices: list[str] = []
        self.scenes: list[SceneDocument] = []
        self.sources_begun = 0
        self.newest: dict[str, ViewFrame] = {}
        self.rooms: list[list[tuple[str, int, bool]]] = []  # camera, frame, and whether it was to be shown
        self.ignored: str | None = None
        self.unfinished: list[int] = []
        self.compiled_ahead = 0

    def submit_cameras(
        self,
        taken: Sequence[CameraFrame],
        *,
        with_linear: bool = False,
        full_size: bool = False,  # noqa: ARG002
        others: Sequence[ShownView] = (),
    ) -> list[Started]:
        self.rooms.append([(each.camera, each.frame.frame_id, each.is_shown) for each in taken])
        self.newest = {each.camera: each.frame for each in taken}
        return [self._start(each.frame, others, with_linear=with_linear) for each in taken if each.is_shown]

    def _start(self, frame: ViewFrame, others: Sequence[ShownView], *, with_linear: bool) -> Started:
        if frame.frame_id in self.fails_at:
            raise RuntimeError("the volume fell over")
        pose = None if frame.pose is None else frame.pose.world_from_camera
        picture = Picture(255 - frame.color, "no_pose" if pose is None else "ok", frame.camera, pose)
        picture.others = tuple(OtherView(view, frame.color, None) for view in others)
        if with_linear:
            picture.linear = picture.color.astype(np.float32) / 255
        self.unfinished.append(frame.frame_id)

        def finish() -> Picture:
            assert self.unfinished.pop(0) == frame.frame_id, "frames are finished in the order of their start"
            return picture

        return Started(finish, self.immediate)

    def sized(self, frame: ViewFrame) -> ViewFrame:
        return frame

    def pick(self, x: float, y: float, ignore: str | None = None, camera: str | None = None) -> Picked:
        seen = next(iter(self.newest.values()), None) if camera is None else self.newest.get(camera)
        if seen is None:
            raise DeltalightError("Nothing has been rendered yet; ask again when there is a picture.")
        self.ignored = ignore
        return Picked(seen.frame_id, (x, y))

    def room(self) -> RoomMesh:
        raise DeltalightError("No surface of the room is known yet; ask again when depth shows some.")

    def compile_ahead(self) -> None:
        assert not self.unfinished, "pictures come first"
        self.compiled_ahead += 1

    def forget_frames(self) -> None:
        self.sources_begun += 1
        self.newest = {}

    def set_scene(self, scene: SceneDocument) -> None:
        if scene.name == "refused":
            raise DeltalightError("This scene cannot be shown; take another.")
        self.scenes.append(scene)
