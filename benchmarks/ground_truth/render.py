"""Pictures and depth of a Mitsuba scene through a `CameraModel`, in camera units and metres."""

import os
import subprocess
import sys
from typing import Any

import numpy as np
from jaxtyping import Float, Float32

from protocol.camera_model import CameraModel
from protocol.errors import DeltalightError

LLVM_LIBRARY = "libLLVM.so.19.1"
"""Dr.Jit aborts the whole process with the older LLVM that Mesa brings along, so the version is pinned."""

MAX_DEPTH = 8
"""Longest light path in segments: every bounce that an 8-bit picture can show."""

NEAR_CLIP_M = 0.01


def choose_variant() -> str:
    """Set and return the fastest Mitsuba variant that works here: `llvm_ad_rgb`, else `scalar_rgb`.

    The LLVM variant is tried in a child process because a wrong library aborts instead of raising.
    Raises DeltalightError where Mitsuba is not installed.
    """
    os.environ.setdefault("DRJIT_LIBLLVM_PATH", LLVM_LIBRARY)
    try:
        import mitsuba as mi
    except ImportError as error:
        raise DeltalightError(
            "Mitsuba is needed to render ground truth; install the project with its dev extra."
        ) from error
    probe = "import mitsuba as mi; mi.set_variant('llvm_ad_rgb'); mi.render(mi.load_dict(mi.cornell_box()), spp=1)"
    probe += ".numpy()"
    tried = subprocess.run([sys.executable, "-c", probe], capture_output=True, check=False)
    variant = "llvm_ad_rgb" if tried.returncode == 0 else "scalar_rgb"
    mi.set_variant(variant)
    return variant


class RoomRenderer:
    """Renders one Mitsuba scene from any pose; the variant must be set (`choose_variant`)."""

    def __init__(self, scene: dict[str, Any], camera: CameraModel) -> None:
        import mitsuba as mi

        self._mi = mi
        self._camera = camera
        self._scene = mi.load_dict(scene)
        self._color = mi.load_dict({"type": "path", "max_depth": MAX_DEPTH})
        self._distance = mi.load_dict({"type": "aov", "aovs": "distance:depth"})

    def color(
        self, world_from_camera: Float[np.ndarray, "4 4"], *, spp: int, seed: int
    ) -> Float32[np.ndarray, "h w 3"]:
        """Linear radiance in camera units, box-filtered over each pixel."""
        return self._render(self._color, world_from_camera, spp, seed)[..., :3]

    def depth(
        self, world_from_camera: Float[np.ndarray, "4 4"], *, spp: int, seed: int
    ) -> Float32[np.ndarray, "h w"]:
        """Metres along the optical axis, mean over each pixel; 0 where nothing is hit.

        Mitsuba gives the distance along the ray from the near plane; rays() has (x/z, y/z), hence the cosine.
        """
        distance = self._render(self._distance, world_from_camera, spp, seed)[..., 0]
        x, y = np.moveaxis(self._camera.rays(), -1, 0)
        depth = distance / np.sqrt(1 + x * x + y * y) + NEAR_CLIP_M
        return np.where(distance > 0, depth, 0).astype(np.float32)

    def _render(
        self, integrator: Any, world_from_camera: Float[np.ndarray, "4 4"], spp: int, seed: int
    ) -> Float32[np.ndarray, "h w c"]:
        sensor = self._mi.load_dict(_sensor(self._mi, self._camera, world_from_camera))
        picture = self._mi.render(self._scene, sensor=sensor, integrator=integrator, spp=spp, seed=seed)
        return np.array(picture, np.float32)


def _sensor(mi: Any, camera: CameraModel, world_from_camera: Float[np.ndarray, "4 4"]) -> dict[str, Any]:
    """Mitsuba's pinhole of a camera without distortion; pixel centres at integers there, at halves here."""
    if camera.has_distortion:
        raise DeltalightError("Mitsuba's pinhole has no lens distortion; give a camera model without it.")
    fx, cx, cy = camera.matrix[0, 0], camera.matrix[0, 2], camera.matrix[1, 2]
    # Mitsuba looks along +z with +x to the left and +y up.
    turned = world_from_camera @ np.diag([-1.0, -1.0, 1.0, 1.0])
    return {
        "type": "perspective",
        "fov": float(np.degrees(2 * np.arctan(camera.width / (2 * fx)))),
        "fov_axis": "x",
        "principal_point_offset_x": float((cx + 0.5) / camera.width - 0.5),
        "principal_point_offset_y": float((cy + 0.5) / camera.height - 0.5),
        "near_clip": NEAR_CLIP_M,
        "far_clip": 100.0,
        "to_world": mi.ScalarTransform4f(turned),
        "film": {
            "type": "hdrfilm",
            "width": camera.width,
            "height": camera.height,
            "rfilter": {"type": "box"},
            "component_format": "float32",
        },
        "sampler": {"type": "independent"},
    }
