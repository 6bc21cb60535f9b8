"""The scenes whose pictures protect the renderer: every method on every kind of real geometry, in several ways.

A case renders three frames: the first, one of a camera turned by a degree a twentieth of a second later, and the
first again. So they hold what is made once, what follows the camera, and what is kept in between.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from deltalight.protocol.board import BoardSpec
from deltalight.protocol.frames import BoardPose, ViewFrame
from deltalight.protocol.scene import SceneDocument, parse_scene
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Dispatch, watched
from deltalight.render_server.methods import registry
from deltalight.render_server.methods.method import SOFTWARE_DEFAULTS
from deltalight.render_server.renderer import SceneRenderer
from tests.render_server.gltf_samples import QUARTER_TURN, bent_bar
from tests.render_server.scenes import (
    HEIGHT,
    WIDTH,
    Stage,
    ambient,
    ball,
    checkered,
    cube,
    depth_image,
    directional,
    floor,
    floor_depth,
    frame,
    look_at,
    sphere_light,
)

FOLDER = Path(__file__).with_name("goldens")
LEAST_PSNR_DB = 60.0  # of pictures by another machine than the one that recorded them
SHOWN = 1  # the frame that the sheets of goldens show: the turned one

PICTURE = {"width": 96, "height": 72}
LATER_NS = 50_000_000
EYE, TARGET = (0.25, -0.9, 0.65), (0.0, 0.0, 0.06)
TURNED = (0.016, 0.0, 0.06)  # a degree aside from TARGET

VOXELS: dict[str, Any] = {"volume_size": 32, "rsm_size": 128, "cone_scale": 2}
CELLS: dict[str, Any] = {"volume_size": 16, "rsm_size": 128, "query_scale": 2}
METHODS: dict[str, dict[str, Any]] = {
    "none": {"name": "none"},
    "exact": {"name": "dvct", **VOXELS},
    "paper": {"name": "dvct", "operator": "paper", **VOXELS},
    "differential": {"name": "differential", **VOXELS},
    "dlpv": {"name": "dlpv", **CELLS},
    "dlpv-paper": {"name": "dlpv", "operator": "paper", **CELLS},
    "aroof": {"name": "aroof", "resolution": 12, "rays": 64, "rsm_size": 128, "shading_scale": 2},
}
GEOMETRIES = ("depth", "fused", "model")
BOARD = BoardSpec(
    type="aruco_grid",
    dictionary="DICT_4X4_50",
    marker_length_m=0.12,
    separation_m=0.15,
    rows=2,
    columns=3,
    first_id=0,
    white_albedo=0.7,
)
MIRROR = {
    "region": {"plane": {"point_m": [0, 0, 0], "normal": [0, 0, 1], "tolerance_m": 0.003}},
    "metallic": 1.0,
    "albedo": [0.9, 0.9, 0.9],
    "roughness": 0.05,
}


@dataclass(frozen=True)
class Case:
    """A method, the kind of real geometry, and what is special about the scene."""

    method: str
    geometry: str
    kind: str

    def __str__(self) -> str:
        return f"{self.method}-{self.geometry}-{self.kind}"


Changes = dict[str, Any]


def _objects(stage: Stage) -> list[dict[str, Any]]:
    metal = {"metallic": 1.0, "roughness": 0.15}
    things = [
        stage.virtual(ball(0.08, (-0.05, 0, 0.08)), (0.9, 0.8, 0.6), metal, id="ball"),
        stage.virtual(cube(0.1, (0.14, 0.02, 0)), (0.15, 0.3, 0.8), id="cube"),
    ]
    return [{**thing, "rigid": True} for thing in things]


def _plain(stage: Stage) -> Changes:  # noqa: ARG001
    return {}


def _antialiased(stage: Stage) -> Changes:  # noqa: ARG001
    return {"output": {**PICTURE, "antialiasing": True}}


def _mirror(stage: Stage) -> Changes:  # noqa: ARG001
    return {"surfaces": [MIRROR]}


def _animated(stage: Stage) -> Changes:
    """The bar's asset changes its shape, which `aroof` refuses: there a rigid thing stands in its place."""
    bar = {
        "id": "bar",
        "asset": str(bent_bar(stage.folder, QUARTER_TURN)),
        "animation": {},
        "pose": {"translation_m": [-0.2, -0.15, 0], "scale": 0.15},
        "material": {"base_color": (0.3, 0.7, 0.3), "roughness": 0.6},
    }
    return {"more_objects": [bar]}


def _lights(stage: Stage) -> Changes:  # noqa: ARG001
    spot = {
        "type": "spot",
        "position_m": [-0.5, -0.3, 0.9],
        "direction": [0.5, 0.3, -0.9],
        "intensity": 1.2,
        "radius_m": 0.02,
        "angle_deg": 50,
        "blend": 0.3,
    }
    panel = {
        "type": "rectangle",
        "position_m": [0.3, 0.6, 0.7],
        "axis_u_m": [0.3, 0, 0],
        "axis_v_m": [0, 0.2, 0.2],
        "radiance": 2.0,
    }
    return {"lights": [spot, panel, sphere_light((0.5, -0.4, 1.0), 0.8, 0.05), directional(), ambient(0.15)]}


def _estimated(stage: Stage) -> Changes:  # noqa: ARG001
    """What is out of sight is found on the board's paper, albedo from the pictures."""
    lights = [directional((-0.6, 0.5, -0.8), 0.3, 2.0), ambient(0.05)]
    return {"surroundings": "auto", "unseen_albedo": None, "board": BOARD, "lights": lights}


def _registered(stage: Stage) -> Changes:  # noqa: ARG001
    return {"registration": "auto", "unseen_albedo": None, "board": BOARD}


KINDS: dict[str, Callable[[Stage], Changes]] = {
    "plain": _plain,
    "antialiased": _antialiased,
    "mirror": _mirror,
    "animated": _animated,
    "lights": _lights,
    "estimated": _estimated,
    "registered": _registered,
}


def cases() -> Iterator[Case]:
    """All of them; `aroof` refuses objects that change their shape."""
    for method in METHODS:
        for geometry in GEOMETRIES:
            for kind in KINDS:
                if (method, kind) != ("aroof", "animated"):
                    yield Case(method, geometry, kind)


def scene_of(case: Case, stage: Stage) -> SceneDocument:
    """The case's document; its assets are written into the stage's folder."""
    changes = KINDS[case.kind](stage)
    geometry: Any = {"model": stage.asset(floor())} if case.geometry == "model" else case.geometry
    lights = changes.get("lights", [directional((-0.6, 0.5, -0.8), 1.5, 2.0), ambient(0.2)])
    return parse_scene(
        {
            "real": {
                "geometry": geometry,
                "surfaces": changes.get("surfaces", []),
                "unseen_albedo": changes.get("unseen_albedo", 0.5),
            },
            "objects": [*_objects(stage), *changes.get("more_objects", [])],
            "lights": {
                "manual": lights,
                "surroundings": changes.get("surroundings", "none"),
                "registration": changes.get("registration", [1.0, 1.0, 1.0]),
            },
            "method": METHODS[case.method],
            "output": changes.get("output", PICTURE),
        }
    )


def frames_of(case: Case) -> list[ViewFrame]:
    """The three frames; depth is noisy and has a hole, where there is any."""
    board = KINDS[case.kind](Stage(Path())).get("board") if case.kind in ("estimated", "registered") else None
    first = _frame(case, 0, look_at(EYE, TARGET), board)
    turned = _frame(case, 1, look_at(EYE, TURNED), board)
    again = _frame(case, 2, look_at(EYE, TARGET), board)
    return [first, turned, again]


def _frame(case: Case, number: int, pose: BoardPose, board: BoardSpec | None) -> ViewFrame:
    more: dict[str, Any] = {"frame_id": number, "timestamp_ns": number * LATER_NS, "board": board}
    if case.geometry != "model":
        depth = floor_depth(pose)
        noise = 0.001 * np.random.default_rng(number).standard_normal((HEIGHT, WIDTH))
        depth = np.where(depth > 0, depth + noise * depth**2, 0).astype(np.float32)
        depth[70:85, 30:60] = 0
        more["depth"] = depth_image(depth)
    return frame(checkered(), pose=pose, **more)


def pictures_of(
    gpu: GpuContext, case: Case, folder: Path, *, checks: bool = False
) -> tuple[list[np.ndarray], list[list[Dispatch]]]:
    """The composites (72, 96, 3; uint8) of the case's frames, and what was dispatched for each.

    `checks` is the graph's. What a scene leaves open is as in software on every device: with more triangles, a fused
    scene is another one.
    """
    pictures: list[np.ndarray] = []
    dispatches: list[list[Dispatch]] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(registry, "GPU_DEFAULTS", SOFTWARE_DEFAULTS)
        renderer = SceneRenderer(gpu, scene_of(case, Stage(folder)), checks=checks)
        try:
            for one in frames_of(case):
                trace: list[Dispatch] = []
                with watched(gpu, trace.append):
                    pictures.append(renderer.render(one).color)
                dispatches.append(trace)
        finally:
            renderer.release()
    return pictures, dispatches


def sheet_path(method: str) -> Path:
    return FOLDER / f"protected_{method}.png"


def tile(case: Case) -> tuple[slice, slice]:
    """Where a sheet shows the case."""
    row, column = GEOMETRIES.index(case.geometry), list(KINDS).index(case.kind)
    width, height = PICTURE["width"], PICTURE["height"]
    return np.s_[row * height : (row + 1) * height, column * width : (column + 1) * width]


def golden_of(case: Case) -> np.ndarray:
    """The recorded picture (72, 96, 3; uint8) of the case's frame SHOWN.

    Raises:
        FileNotFoundError: the method's sheet is missing.
    """
    encoded = np.fromfile(sheet_path(case.method), np.uint8)
    sheet = cv2.imdecode(encoded, cv2.IMREAD_COLOR)
    assert sheet is not None
    return np.asarray(sheet[..., ::-1][tile(case)])
