"""Pictures and depth of a Mitsuba scene through a `CameraModel`, in camera units and metres."""

import os
import subprocess
import sys
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Float32

from protocol.camera_model import CameraModel
from protocol.errors import DeltalightError

LLVM_LIBRARY = "libLLVM.so.19.1"
"""Dr.Jit aborts the whole process with the older LLVM that Mesa brings along, so the version is pinned."""

LLVM_PROBE = """
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")
mi.render(mi.load_dict(mi.cornell_box()), spp=1).numpy()
"""

MAX_DEPTH = 8
"""Longest light path in segments: every bounce that an 8-bit picture can show."""

NEAR_CLIP_M = 0.01

INTEGRATORS: dict[str, dict[str, Any]] = {
    "color": {"type": "path", "max_depth": MAX_DEPTH},
    "distance": {"type": "aov", "aovs": "distance:depth"},
}
PIXEL_FILTERS = {"color": "gaussian", "distance": "box"}
"""Colour is as soft as a lens makes it (half a pixel); distances may only be averaged within their pixel."""


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
    tried = subprocess.run([sys.executable, "-c", LLVM_PROBE], capture_output=True, check=False)
    variant = "llvm_ad_rgb" if tried.returncode == 0 else "scalar_rgb"
    mi.set_variant(variant)
    return variant


class RoomRenderer:
    """Renders one Mitsuba scene from any pose; the variant must be set (`choose_variant`)."""

    def __init__(self, scene: dict[str, Any], camera: CameraModel) -> None:
        import mitsuba as mi

        self._camera = camera
        self._scene = mi.load_dict(scene)
        self._integrators = {name: mi.load_dict(what) for name, what in INTEGRATORS.items()}

    def color(
        self, world_from_camera: Float[np.ndarray, "4 4"], *, spp: int, seed: int
    ) -> Float32[np.ndarray, "h w 3"]:
        """Linear radiance in camera units."""
        return self._render("color", world_from_camera, spp, seed)[..., :3]

    def depth(
        self, world_from_camera: Float[np.ndarray, "4 4"], *, spp: int, seed: int
    ) -> Float32[np.ndarray, "h w"]:
        """Metres along the optical axis, mean over each pixel; 0 where nothing is hit.

        Mitsuba gives the distance along the ray from the near plane; rays() has (x/z, y/z), hence the cosine.
        """
        distance = self._render("distance", world_from_camera, spp, seed)[..., 0]
        x, y = np.moveaxis(self._camera.rays(), -1, 0)
        depth = distance / np.sqrt(1 + x * x + y * y) + NEAR_CLIP_M
        return np.where(distance > 0, depth, 0).astype(np.float32)

    def _render(
        self,
        kind: Literal["color", "distance"],
        world_from_camera: Float[np.ndarray, "4 4"],
        spp: int,
        seed: int,
    ) -> Float32[np.ndarray, "h w c"]:
        import mitsuba as mi

        sensor = mi.load_dict(_sensor(self._camera, world_from_camera, PIXEL_FILTERS[kind]))
        integrator = self._integrators[kind]
        return np.array(mi.render(self._scene, sensor=sensor, integrator=integrator, spp=spp, seed=seed))


def _sensor(
    camera: CameraModel, world_from_camera: Float[np.ndarray, "4 4"], pixel_filter: str
) -> dict[str, Any]:
    """Mitsuba's pinhole of a camera without distortion; pixel centres at integers here, at halves there."""
    import mitsuba as mi

    if camera.has_distortion:
        raise DeltalightError("Mitsuba's pinhole has no lens distortion; give a camera model without it.")
    fx, cx, cy = camera.matrix[0, 0], camera.matrix[0, 2], camera.matrix[1, 2]
    # Mitsuba looks along +z with +x to the left and +y up.
    turned = world_from_camera @ np.diag([-1.0, -1.0, 1.0, 1.0])
    return {
        "type": "perspective",
        "fov": float(np.degrees(2 * np.arctan(camera.width / (2 * fx)))),
        "fov_axis": "x",
        "principal_point_offset_x": float(0.5 - (cx + 0.5) / camera.width),
        "principal_point_offset_y": float(0.5 - (cy + 0.5) / camera.height),
        "near_clip": NEAR_CLIP_M,
        "far_clip": 100.0,
        "to_world": mi.ScalarTransform4f(turned),
        "film": {
            "type": "hdrfilm",
            "width": camera.width,
            "height": camera.height,
            "rfilter": {"type": pixel_filter},
            "component_format": "float32",
        },
        "sampler": {"type": "independent"},
    }
