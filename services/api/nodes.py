"""Routes of the processes and cameras: nodes and render servers that are heard, cameras of this host."""

from typing import Literal

from fastapi import APIRouter
from pydantic import Field

from services.api.camera_finder import CamerasAnswer
from services.api.context import Shared
from services.api.live_hub import LiveFrame
from services.api.models import ProcessAnswer
from services.api.problems import responses
from services.api.process_watch import Report

RENDER_SERVER = "render-server"  # its name unless its settings say another

router = APIRouter(tags=["nodes"])


class NodeAnswer(ProcessAnswer):
    """A node or render server, with its clock and its delays."""

    kind: Literal["node", "render_server"]
    clock_offset_ms: float = Field(description="What is added to its times to have the render server's.")
    delays_ms: dict[str, float] = Field(
        description="`report`: its newest report's way here. Of a render server also, of the newest picture: "
        "`capture_to_server`, `rendering` (waiting included), `server_to_api`."
    )


@router.get("/nodes")
def list_nodes(shared: Shared) -> list[NodeAnswer]:
    """List the nodes and render servers that are heard: state, rates, losses, clock, delays."""
    frame = shared.live.newest
    return [_node(report, frame) for report in shared.watch.reports()]


@router.get("/cameras", responses=responses(503))
def list_cameras(shared: Shared) -> CamerasAnswer:
    """List the cameras that are attached to this host, and what keeps others from being found."""
    return shared.cameras.find()


def _node(report: Report, frame: LiveFrame | None) -> NodeAnswer:
    message = report.message
    renders = message.node == (RENDER_SERVER if frame is None else frame.message.node)
    delays_ms = {"report": report.delay_ms, **(_picture_delays_ms(frame) if frame and renders else {})}
    return NodeAnswer(
        **ProcessAnswer.of(report).model_dump(),
        kind="render_server" if renders else "node",
        clock_offset_ms=message.clock_offset_ns / 1e6,
        delays_ms={name: round(value, 3) for name, value in delays_ms.items()},
    )


def _picture_delays_ms(frame: LiveFrame) -> dict[str, float]:
    message = frame.message
    return {
        "capture_to_server": (message.received_ns - message.capture_ns - message.clock_offset_ns) / 1e6,
        "rendering": (message.rendered_ns - message.received_ns) / 1e6,
        "server_to_api": (frame.arrived_ns - message.rendered_ns) / 1e6,
    }
