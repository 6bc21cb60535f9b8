"""COLMAP's sparse model as text: cameras.txt, images.txt, points3D.txt (colmap.github.io/format.html)."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.poses import wxyz_from_rotation
from deltalight.services.exports.posed_views import PIXEL_CORNER, PointCloud, PosedView, lens_terms

CAMERA_ID = 1


def write_colmap(folder: Path, views: Iterable[PosedView]) -> int:
    """Writes `images/` and `sparse/0/` into a folder; returns the number of frames.

    Raises:
        DeltalightError: COLMAP has no model of the camera's lens.
    """
    model, images = folder / "sparse" / "0", folder / "images"
    for made in (model, images):
        made.mkdir(parents=True)
    lines, cloud, camera = [], PointCloud(), None
    for number, view in enumerate(views, start=1):
        if camera is None:
            camera = camera_line(view.frame.camera)
        lines += [_image_line(number, view.world_from_camera, view.write(images)), ""]
        cloud.add(view)
    _write(model / "cameras.txt", "CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]", [camera or ""])
    _write(model / "images.txt", "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then its points", lines)
    positions, colors = cloud.arrays()
    points = (
        f"{number} {_words(position)} {_words(color)} 0"
        for number, (position, color) in enumerate(
            zip(positions.tolist(), colors.tolist(), strict=True), start=1
        )
    )
    _write(model / "points3D.txt", "POINT3D_ID X Y Z R G B ERROR TRACK[]", points)
    return len(lines) // 2


def camera_line(camera: CameraModel) -> str:
    """Returns a camera's line; COLMAP's pixels begin at their corner.

    Raises:
        DeltalightError: COLMAP has no model of its lens.
    """
    matrix = camera.matrix
    pinhole = [matrix[0, 0], matrix[1, 1], matrix[0, 2] + PIXEL_CORNER, matrix[1, 2] + PIXEL_CORNER]
    if camera.distortion_model == "equidistant":
        name, terms = "OPENCV_FISHEYE", lens_terms(camera, 4, "COLMAP")
    else:
        terms = lens_terms(camera, 8, "COLMAP")
        name = "FULL_OPENCV" if any(terms[4:]) else "OPENCV" if any(terms) else "PINHOLE"
        terms = terms[: {"FULL_OPENCV": 8, "OPENCV": 4, "PINHOLE": 0}[name]]
    return f"{CAMERA_ID} {name} {camera.width} {camera.height} {_words([*pinhole, *terms])}"


def _image_line(number: int, world_from_camera: Float64[np.ndarray, "4 4"], name: str) -> str:
    """Returns an image's line: rotation and translation from the world to the camera."""
    pose = np.linalg.inv(world_from_camera)
    return f"{number} {_words([*wxyz_from_rotation(pose[:3, :3]), *pose[:3, 3]])} {CAMERA_ID} {name}"


def _words(values: Iterable[float]) -> str:
    return " ".join(repr(value.item() if isinstance(value, np.generic) else value) for value in values)


def _write(path: Path, columns: str, lines: Iterable[str]) -> None:
    path.write_text("\n".join([f"# {columns}", *lines]) + "\n", encoding="utf-8")
