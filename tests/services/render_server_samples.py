"""A stand-in for the render server's control socket: notes what is asked, writes what snapshots want."""

import threading
from pathlib import Path

import cv2
import numpy as np

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.messages import ControlRequest
from deltalight.protocol.request import ReplyServer
from deltalight.services import ports

NOWHERE = {"kind": "nothing", "object": None, "point_m": None, "normal": None, "distance_m": None}


class Recorder:
    """Answers as the render server does; `asked` holds (op, payload) in their order.

    Where `gate` is closed, what changes or shows the picture waits, as for a slow renderer; `is_busy` tells that it
    does.
    """

    def __init__(self, control_port: int) -> None:
        self.asked: list[tuple[str, dict[str, object]]] = []
        self.fault: str | None = None
        self.scene_id: str | None = None
        self.revision = 1
        self.gate = threading.Event()
        self.gate.set()
        self.is_busy = threading.Event()
        self._server = ReplyServer(ports.endpoint(control_port), self._execute)

    def close(self) -> None:
        self.gate.set()
        self._server.close()

    def payloads(self, op: str) -> list[dict[str, object]]:
        return [payload for asked, payload in self.asked if asked == op]

    def _execute(self, request: ControlRequest) -> dict[str, object]:
        self.asked.append((request.op, dict(request.payload)))
        match request.op:
            case "ping":
                return {"scene_id": self.scene_id, "revision": self.revision, "instance": "stand-in"}
            case "set_scene":
                self._wait_at_gate()
                self.scene_id, self.revision = request.scene_id, request.revision or self.revision + 1
            case "pick":
                self._wait_at_gate()
                return {"frame_id": 1, **NOWHERE}
            case "snapshot":
                return self._snapshot(request.payload)
        return {}

    def _wait_at_gate(self) -> None:
        self.is_busy.set()
        self.gate.wait()
        self.is_busy.clear()

    def _snapshot(self, order: dict[str, object]) -> dict[str, object]:
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
