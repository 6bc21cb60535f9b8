"""Nerfstudio's dataset: transforms.json with pictures, depth and points (docs.nerf.studio, "Data conventions")."""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.pictures import encode_png, steps_from_depth
from deltalight.services.exports.posed_views import PIXEL_CORNER, PointCloud, PosedView, lens_terms

DEPTH_STEP_M = 0.001  # Nerfstudio's own unless it is told otherwise
POINTS_FILE = "points.ply"
# Nerfstudio's camera looks along -z with y up (OpenGL), ours along +z with y down.
OPTICAL_FROM_GL = np.diag([1.0, -1.0, -1.0, 1.0])


def write_nerfstudio(folder: Path, views: Iterable[PosedView]) -> int:
    """Writes `transforms.json`, `images/`, `depth/` and the points into a folder; returns the number of frames.

    Raises:
        DeltalightError: Nerfstudio has no model of the camera's lens.
    """
    folder.mkdir()
    for name in ("images", "depth"):
        (folder / name).mkdir()
    frames: list[dict[str, Any]] = []
    cloud, camera = PointCloud(), None
    for view in views:
        camera = camera or camera_values(view.frame.camera)
        frames.append(_frame(folder, view))
        cloud.add(view)
    document = {**(camera or {}), "ply_file_path": POINTS_FILE, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(document, indent=1), encoding="utf-8")
    _write_points(folder / POINTS_FILE, cloud)
    return len(frames)


def camera_values(camera: CameraModel) -> dict[str, Any]:
    """Returns the camera's keys; Nerfstudio's pixels begin at their corner.

    Raises:
        DeltalightError: Nerfstudio has no model of its lens.
    """
    matrix = camera.matrix.tolist()
    values = {
        "w": camera.width,
        "h": camera.height,
        "fl_x": matrix[0][0],
        "fl_y": matrix[1][1],
        "cx": matrix[0][2] + PIXEL_CORNER,
        "cy": matrix[1][2] + PIXEL_CORNER,
    }
    names: tuple[str, ...]
    if camera.distortion_model == "equidistant":
        names, model = ("k1", "k2", "k3", "k4"), "OPENCV_FISHEYE"
    else:
        names, model = ("k1", "k2", "p1", "p2", "k3"), "OPENCV"
    terms = lens_terms(camera, len(names), "Nerfstudio")
    return {"camera_model": model, **values, **dict(zip(names, terms, strict=True))}


def _frame(folder: Path, view: PosedView) -> dict[str, Any]:
    name = view.write(folder / "images")
    pose = view.world_from_camera @ OPTICAL_FROM_GL
    frame: dict[str, Any] = {"file_path": f"images/{name}", "transform_matrix": pose.tolist()}
    if view.frame.depth is not None:
        path = f"depth/{Path(name).stem}.png"
        (folder / path).write_bytes(encode_png(steps_from_depth(view.frame.depth, DEPTH_STEP_M)))
        frame["depth_file_path"] = path
    return frame


def _write_points(path: Path, cloud: PointCloud) -> None:
    """Writes points with colours as binary PLY."""
    positions, colors = cloud.arrays()
    names = [
        *((f"float {axis}", "<f4") for axis in "xyz"),
        *((f"uchar {c}", "u1") for c in ("red", "green", "blue")),
    ]
    rows = np.zeros(len(positions), [(name.split()[1], kind) for name, kind in names])
    for column, (name, _) in enumerate(names):
        rows[name.split()[1]] = positions[:, column] if column < 3 else colors[:, column - 3]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    header += [f"property {name}" for name, _ in names] + ["end_header", ""]
    path.write_bytes("\n".join(header).encode() + rows.tobytes())
