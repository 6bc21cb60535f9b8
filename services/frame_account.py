"""What one frame ran, kept, took and holds: a small built-in scene, rendered while its camera turns by a degree."""

import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.frames import BoardPose, ViewFrame
from deltalight.protocol.method_names import with_method
from deltalight.protocol.scene import SceneDocument, parse_scene
from deltalight.render_server.gpu.context import GpuContext, create_context
from deltalight.render_server.graph_report import SourceReport, StageReport
from deltalight.render_server.renderer import SceneRenderer

SIZE = (320, 240)
FOCAL_PX = 300.0
TURN_DEG = 1.0
GREY = 140  # code of the picture
EYE, TARGET = (0.2, -0.8, 0.5), (0.0, 0.0, 0.05)
# A floor and two walls.
ROOM = """
v -1 -1 0
v 1 -1 0
v 1 1 0
v -1 1 0
v -1 1 2
v 1 1 2
v -1 -1 2
f 1 2 3 4
f 4 3 6 5
f 1 4 5 7
"""
PYRAMID = """
v -0.1 -0.1 0
v 0.1 -0.1 0
v 0.1 0.1 0
v -0.1 0.1 0
v 0 0 0.15
f 4 3 2 1
f 1 2 5
f 2 3 5
f 3 4 5
f 4 1 5
"""


@dataclass(frozen=True)
class FrameAccount:
    """The graph of a frame as it was left; `size` is the picture's, in pixels."""

    method: str
    renderer: str
    size: tuple[int, int]
    sources: list[SourceReport]
    stages: list[StageReport]

    @property
    def title(self) -> str:
        """What was rendered, on what."""
        width, height = self.size
        return (
            f"{self.method}: a frame after the camera turned by a degree ({width}x{height}, {self.renderer})"
        )

    @property
    def sections(self) -> dict[str, list[StageReport]]:
        """The stages by section."""
        names = dict.fromkeys(stage.section for stage in self.stages)
        return {name: [stage for stage in self.stages if stage.section == name] for name in names}

    @property
    def summary(self) -> str:
        """A sentence on what the frame cost and holds."""
        ran = [stage for stage in self.stages if stage.ran]
        time_ms = sum(stage.time_ms or 0 for stage in ran)
        size = (
            sum([each.size_bytes for each in self.sources] + [each.size_bytes for each in self.stages]) / 1e6
        )
        return f"{len(ran)} of {len(self.stages)} stages ran, {time_ms:.1f} ms; {size:.1f} MB on the GPU."

    def as_dict(self) -> dict[str, Any]:
        """The account as plain data."""
        return asdict(self)


def account_frame(method: str, watch: Callable[[str], None]) -> FrameAccount:
    """Renders a given model whose camera turns by a degree; `watch` is told what is being done.

    The first of three frames compiles, the second runs everything, so that times are those of passes alone; the third
    is the one that is accounted for.

    Raises:
        DeltalightError: no OpenGL.
    """
    gpu = create_context()
    try:
        with TemporaryDirectory(prefix="deltalight-graph-") as folder:
            renderer = SceneRenderer(gpu, room_scene(method, Path(folder)))
            try:
                return _account(gpu, renderer, method, watch)
            finally:
                renderer.release()
    finally:
        gpu.release()


def room_scene(method: str, folder: Path) -> SceneDocument:
    """A metal pyramid under a lamp in a room that is given as a model; nothing of the light is estimated."""
    room, pyramid = folder / "room.obj", folder / "pyramid.obj"
    room.write_text(ROOM, encoding="utf-8")
    pyramid.write_text(PYRAMID, encoding="utf-8")
    metal = {"base_color": [0.9, 0.8, 0.6], "metallic": 1, "roughness": 0.2}
    lamp = {"type": "sphere", "position_m": [0.5, -0.4, 1], "intensity": 2, "radius_m": 0.05}
    scene = parse_scene(
        {
            "real": {"geometry": {"model": str(room)}, "unseen_albedo": 0.5},
            "objects": [{"id": "pyramid", "asset": str(pyramid), "material": metal, "rigid": True}],
            "lights": {
                "manual": [lamp, {"type": "ambient", "radiance": 0.2}],
                "surroundings": "none",
                "registration": [1, 1, 1],
            },
        }
    )
    return with_method(scene, method)


def _account(
    gpu: GpuContext, renderer: SceneRenderer, method: str, watch: Callable[[str], None]
) -> FrameAccount:
    def compiled(label: str, _sources: Mapping[str, str]) -> None:
        watch(f"compiling {label}")

    first = turned_frame(0, 0.0)
    gpu.compile_watchers.append(compiled)
    renderer.render(first)
    gpu.compile_watchers.remove(compiled)
    watch("rendering")
    graph = renderer.graph
    assert graph is not None
    assert graph.timers is not None
    graph.invalidate()
    renderer.render(replace(first, frame_id=1))
    renderer.render(turned_frame(2, TURN_DEG))
    graph.timers.wait()
    return FrameAccount(method, gpu.renderer_name, SIZE, graph.report_sources(), graph.report())


def turned_frame(number: int, turn_deg: float) -> ViewFrame:
    """A grey picture by a camera that stands before the object, turned aside."""
    width, height = SIZE
    matrix = np.array([[FOCAL_PX, 0, (width - 1) / 2], [0, FOCAL_PX, (height - 1) / 2], [0, 0, 1]])
    camera = CameraModel(width, height, matrix, "plumb_bob", np.zeros(5))
    color = np.full((height, width, 3), GREY, np.uint8)
    return ViewFrame(number, 0, color, camera, pose=BoardPose(_turned_pose(turn_deg)))


def _turned_pose(turn_deg: float) -> np.ndarray:
    """world_from_camera (4, 4) of a camera that looks at TARGET, then turns about its own Y axis."""
    z = np.subtract(TARGET, EYE) / math.dist(TARGET, EYE)
    x = np.cross(z, (0, 0, 1))
    x /= np.linalg.norm(x)
    angle = math.radians(turn_deg)
    turn = np.array(
        [[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]]
    )
    pose = np.eye(4)
    pose[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1) @ turn
    pose[:3, 3] = EYE
    return pose
