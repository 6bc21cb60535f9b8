"""A stand-in for the render server's control socket: notes what is asked, writes what snapshots want."""

from pathlib import Path

import cv2
import numpy as np

from protocol.errors import DeltalightError
from protocol.messages import ControlRequest
from protocol.transport import ReplyServer
from services import ports


class Recorder:
    """Answers as the render server does; `asked` holds (op, payload) in their order."""

    def __init__(self, control_port: int) -> None:
        self.asked: list[tuple[str, dict[str, object]]] = []
        self.fault: str | None = None
        self._server = ReplyServer(ports.endpoint(control_port), self._carry_out)

    def close(self) -> None:
        self._server.close()

    def payloads(self, op: str) -> list[dict[str, object]]:
        return [payload for asked, payload in self.asked if asked == op]

    def _carry_out(self, request: ControlRequest) -> dict[str, object]:
        self.asked.append((request.op, dict(request.payload)))
        match request.op:
            case "ping":
                return {"revision": 1}
            case "snapshot":
                return self._snapshot(request.payload)
        return {}

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
