"""Pictures and depth of a Mitsuba scene through a `CameraModel`, in camera units and metres."""

import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any, Literal

import cv2
import numpy as np
from jaxtyping import Float32, Float64

from deltalight.benchmarks.ground_truth import energy_keeping
from deltalight.benchmarks.ground_truth.fisheye import fisheye_sensor
from deltalight.benchmarks.ground_truth.parts import Matrix
from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.errors import DeltalightError

LLVM_LIBRARY = "libLLVM.so.19.1"
"""Dr.Jit aborts the whole process with the older LLVM that comes with Mesa, so the version is pinned."""

LLVM_PROBE = """
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")
mi.render(mi.load_dict(mi.cornell_box()), spp=1).numpy()
"""

MAX_DEPTH = 8
"""Longest light path in segments: every bounce between matt surfaces that is visible in an 8-bit picture."""

NEAR_CLIP_M = 0.01


def integrators(max_depth: int) -> dict[str, dict[str, Any]]:
    """Returns Mitsuba's integrators for paths of so many segments; truth is found again by a hash of them."""
    return {
        "color": {"type": "path", "max_depth": max_depth},
        "cover": {"type": "path", "max_depth": 1},  # directly visible light only
        "distance": {"type": "aov", "aovs": "distance:depth"},
    }


SUBPIXELS = 2
"""Supersampling of colour per axis, filtered here.

Mitsuba's own filter mixes samples of several pixels: the order of its threads changes the last digits, so the same
seed would not give the same picture.
"""
SOFTNESS_PX = 0.5
"""Standard deviation of the lens's blur, as of Mitsuba's default filter; a subpixel's own area is part of it."""
LEAST_STRATIFIED = 64
"""Samples from which on Mitsuba's stratified sampler is used; with fewer it is biased.

Its permutations of few strata seem to depend on each other between dimensions. Measured in `two_lights`: with 4
samples a pass the room is 3.1 % too dark and objects add 1.2 times the light, with 16 it is 0.2 % too dark; 64 and
256 are 0.1 % off independent samples, which is noise.
"""
WAVEFRONT = 20_000_000
"""Samples drawn at once; with Mitsuba's LLVM variant that takes less than half a GB."""
MAX_PASSES = 4096
"""Distance of seeds, so that no two pictures share a pass's seed."""


def choose_variant() -> str:
    """Sets and returns the fastest Mitsuba variant that works here: `llvm_ad_rgb`, else `scalar_rgb`.

    The LLVM variant is tried in a child process because a wrong library aborts instead of raising.

    Raises:
        DeltalightError: Mitsuba is not installed.
    """
    os.environ.setdefault("DRJIT_LIBLLVM_PATH", LLVM_LIBRARY)
    try:
        import mitsuba as mi
    except ImportError as error:
        raise DeltalightError(
            "Mitsuba is needed to render ground truth; install the project with its dev extra."
        ) from error
    variant = "llvm_ad_rgb" if _llvm_works() else "scalar_rgb"
    mi.set_variant(variant)
    energy_keeping.register()
    return variant


@cache
def _llvm_works() -> bool:
    return (
        subprocess.run([sys.executable, "-P", "-c", LLVM_PROBE], capture_output=True, check=False).returncode
        == 0
    )


def passes(spp: int, pixels: int) -> tuple[int, ...]:
    """Splits `spp` samples per pixel (rounded up to whole subpixels) into passes of some samples per subpixel.

    They are powers of 4, as the stratified sampler requires, and no pass exceeds `WAVEFRONT`.
    """
    area = SUBPIXELS**2
    left, taken = -(-spp // area), []
    while left:
        size = 4 ** ((left.bit_length() - 1) // 2)
        while size > 1 and size * area * pixels > WAVEFRONT:
            size //= 4
        taken.append(size)
        left -= size
    return tuple(taken)


@dataclass(frozen=True, eq=False)
class GuidedPicture:
    """Linear radiance in camera units, with what guides a denoiser: albedo 0..1 and unit normals in the world."""

    color: Float32[np.ndarray, "h w 3"]
    albedo: Float32[np.ndarray, "h w 3"]
    normal: Float32[np.ndarray, "h w 3"]


def _ignore() -> None:
    """Does nothing: nobody counts the passes."""


class RoomRenderer:
    """Renders one Mitsuba scene from any pose; the variant must be set (`choose_variant`).

    With Mitsuba's LLVM variant the same seed gives the same picture, bit for bit.
    """

    def __init__(self, scene: dict[str, Any], camera: CameraModel, *, max_depth: int = MAX_DEPTH) -> None:
        import mitsuba as mi

        self._camera = camera
        self._fine = camera.resized(SUBPIXELS * camera.width, SUBPIXELS * camera.height)
        self._scene = mi.load_dict(scene)
        known = integrators(max_depth)
        features = {"type": "aov", "aovs": "albedo:albedo,normal:sh_normal"}
        known["guided"] = {**features, "path": known["color"]}
        self._integrators = {name: mi.load_dict(what) for name, what in known.items()}

    def color(
        self, world_from_camera: Matrix, *, spp: int, seed: int, advance: Callable[[], None] = _ignore
    ) -> Float32[np.ndarray, "h w 3"]:
        """Renders linear radiance in camera units; calls `advance` after each of the `passes`."""
        return self._mean("color", world_from_camera, spp, seed, advance)

    def guided(self, world_from_camera: Matrix, *, spp: int, seed: int) -> GuidedPicture:
        """Renders with any number of samples a pixel, each in its own pixel, which denoisers expect.

        What `color` has of the lens's blur is missing: `softened` adds it.
        """
        channels = self._render("guided", _sensor(self._camera, world_from_camera, "independent"), spp, seed)
        return GuidedPicture(channels[..., :3], channels[..., 3:6], channels[..., 6:9])

    def cover(
        self, world_from_camera: Matrix, *, spp: int, seed: int, advance: Callable[[], None] = _ignore
    ) -> Float32[np.ndarray, "h w"]:
        """Renders the fraction of each pixel, 0..1, covered by shapes with radiance 1; nothing else may emit light.

        The same seed places the samples as in `color`.
        """
        return np.ascontiguousarray(self._mean("cover", world_from_camera, spp, seed, advance)[..., 0])

    def depth(self, world_from_camera: Matrix, *, spp: int, seed: int) -> Float32[np.ndarray, "h w"]:
        """Renders metres along the optical axis, mean over each pixel; 0 where nothing is hit.

        Mitsuba gives the distance along the ray from the near plane; rays() has (x/z, y/z), hence the cosine.
        """
        sensor = _sensor(self._camera, world_from_camera, "independent")
        distance = self._render("distance", sensor, spp, seed)[..., 0]
        x, y = np.moveaxis(self._camera.rays(), -1, 0)
        depth = distance / np.sqrt(1 + x * x + y * y) + NEAR_CLIP_M
        return np.where(distance > 0, depth, 0).astype(np.float32)

    def is_free(self, start: Float64[np.ndarray, "3"], end: Float64[np.ndarray, "3"]) -> bool:
        """Whether the line between two points (m, world) is unobstructed."""
        import mitsuba as mi

        offset = end - start
        length = float(np.linalg.norm(offset))
        origin, direction = mi.Point3f(*start.tolist()), mi.Vector3f(*(offset / length).tolist())
        hit = self._scene.ray_intersect_preliminary(mi.Ray3f(origin, direction))
        return float(np.array(hit.t).ravel()[0]) >= length

    def _mean(
        self,
        kind: Literal["color", "cover"],
        world_from_camera: Matrix,
        spp: int,
        seed: int,
        advance: Callable[[], None],
    ) -> Float32[np.ndarray, "h w 3"]:
        total = np.zeros((self._fine.height, self._fine.width, 3), np.float32)
        plan = passes(spp, self._camera.width * self._camera.height)
        for number, samples in enumerate(plan):
            sensor = _sensor(self._fine, world_from_camera, _sampler(samples))
            total += samples * self._render(kind, sensor, samples, seed * MAX_PASSES + number)[..., :3]
            advance()
        return filtered(total / np.float32(sum(plan)))

    def _render(self, kind: str, sensor: dict[str, Any], spp: int, seed: int) -> Float32[np.ndarray, "h w c"]:
        import mitsuba as mi

        camera, integrator = mi.load_dict(sensor), self._integrators[kind]
        return np.array(mi.render(self._scene, sensor=camera, integrator=integrator, spp=spp, seed=seed))


def filtered(fine: Float32[np.ndarray, "hs ws 3"]) -> Float32[np.ndarray, "h w 3"]:
    """Blurs a picture of subpixels by the lens and samples it at the pixels' centres; renormalised at borders."""
    taps = 4 * SUBPIXELS  # 2 px to either side: 4 standard deviations
    offset_px = (np.arange(taps) - (taps - 1) / 2) / SUBPIXELS
    variance = SOFTNESS_PX**2 - 1 / (12 * SUBPIXELS**2)
    kernel = np.exp(-(offset_px**2) / (2 * variance)).astype(np.float32)
    anchor = (taps - SUBPIXELS) // 2  # taps before a pixel's first subpixel

    def blurred(picture: Float32[np.ndarray, "hs ws 3"]) -> Float32[np.ndarray, "h w 3"]:
        soft = cv2.sepFilter2D(
            picture, -1, kernel, kernel, anchor=(anchor, anchor), borderType=cv2.BORDER_CONSTANT
        )
        return np.asarray(soft[::SUBPIXELS, ::SUBPIXELS])

    return np.asarray(blurred(fine) / blurred(np.ones_like(fine)))


def softened(picture: Float32[np.ndarray, "h w 3"]) -> Float32[np.ndarray, "h w 3"]:
    """Blurs a picture of whole pixels by the lens: by the variance that their own area does not have."""
    side = (SOFTNESS_PX**2 - 1 / 12) / 2
    kernel = np.array([side, 1 - 2 * side, side], np.float32)
    return np.asarray(cv2.sepFilter2D(picture, -1, kernel, kernel, borderType=cv2.BORDER_REPLICATE))


def _sampler(samples: int) -> str:
    """Returns the sampler with the least noise that is right in the mean."""
    return "stratified" if samples >= LEAST_STRATIFIED else "independent"


def _sensor(camera: CameraModel, world_from_camera: Matrix, sampler: str) -> dict[str, Any]:
    """Returns Mitsuba's sensor of a camera, with a film on which every sample stays in its pixel."""
    fisheye = camera.distortion_model == "equidistant"
    lens = (fisheye_sensor if fisheye else _pinhole)(camera, world_from_camera)
    film = {
        "type": "hdrfilm",
        "width": camera.width,
        "height": camera.height,
        "rfilter": {"type": "box"},
        "component_format": "float32",
    }
    return {**lens, "film": film, "sampler": {"type": sampler}}


def _pinhole(camera: CameraModel, world_from_camera: Matrix) -> dict[str, Any]:
    """Returns a camera without distortion; pixel centres are at integers here, at halves in Mitsuba."""
    import mitsuba as mi

    fx, fy, cx, cy = camera.matrix[[0, 1, 0, 1], [0, 1, 2, 2]]
    if camera.has_distortion:
        raise DeltalightError("Mitsuba's pinhole has no lens distortion; give a camera model without it.")
    if not np.isclose(fx, fy):
        raise DeltalightError(
            "Mitsuba's pinhole has square pixels; give a picture size of the camera's own aspect."
        )
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
    }
