"""The noise-free pictures of a benchmark scene: without and with objects, cover, depth, fish-eye."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float32

from deltalight.benchmarks.ground_truth import fisheye
from deltalight.benchmarks.ground_truth.assembly import Assembly
from deltalight.benchmarks.ground_truth.parts import Matrix
from deltalight.benchmarks.ground_truth.point_lamps import with_point_lamps
from deltalight.benchmarks.ground_truth.render import RoomRenderer, passes
from deltalight.benchmarks.ground_truth.sensors import srgb_coded
from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.equidistant_lens import EquidistantLens

SEED = 3000
DEPTH_SAMPLES = 16
FISHEYE_SAMPLES = 64
PROBE_HEIGHT_M = 0.05
"""Height of the fish-eye lens above the object's base: at its position, clear of what it stands on."""

Halves = Float32[np.ndarray, "2 h w 3"]
"""A picture twice, each with half of the samples and seeds of its own, in the stored precision."""


@dataclass(frozen=True, eq=False)
class FramePictures:
    """Truth of a frame, in linear camera units and metres; colour in two halves."""

    without: Halves
    with_objects: Halves
    cover: Float32[np.ndarray, "h w"]
    depth_m: Float32[np.ndarray, "h w"]


@dataclass(frozen=True, eq=False)
class RoomPictures:
    """The room without objects from one pose."""

    color: Halves
    depth_m: Float32[np.ndarray, "h w"]


@dataclass
class TruthRenderer:
    """Renders frame after frame; `advance` is called after each step of `step_count`."""

    assembly: Assembly
    camera: CameraModel
    spp: int
    advance: Callable[[], None]
    _rooms: dict[bytes, RoomPictures] = field(default_factory=dict)

    @property
    def step_count(self) -> int:
        """Number of renderings of the whole take: each pass, a depth picture per pose, the fish-eye picture."""
        scene = self.assembly.scene
        poses = len({pose.tobytes() for pose in scene.world_from_camera})
        half = len(passes(self.spp // 2, self.camera.width * self.camera.height))
        lens = len(passes(FISHEYE_SAMPLES, fisheye.CAMERA.width * fisheye.CAMERA.height))
        return 2 * half * (poses + 2 * scene.frame_count) + poses + lens

    def frame(self, index: int) -> FramePictures:
        """Renders one frame. Seeds are the same in all frames, so what does not change in truth is exactly still."""
        pose = self.assembly.scene.world_from_camera[index]
        room = self._room(pose)
        with_objects = self._traced(self.assembly.with_objects(index), self.camera)
        mask = RoomRenderer(self.assembly.mask(index), self.camera)
        color = self._color(with_objects, pose)
        covers = [mask.cover(pose, **self._half(half)) for half in (0, 1)]
        cover = np.asarray((covers[0] + covers[1]) / 2)
        return FramePictures(room.color, color, cover, room.depth_m)

    def fisheye(self) -> Float32[np.ndarray, "h w 3"]:
        """Renders the empty room as the fish-eye camera sees it, with point lamps blurred by its lens."""
        room = self._traced(self.assembly.without(), fisheye.CAMERA)
        pose = world_from_fisheye(self.assembly)
        picture = room.color(pose, spp=FISHEYE_SAMPLES, seed=SEED, advance=self.advance)
        return with_point_lamps(
            picture, self.assembly.scene.lamps, room, EquidistantLens(fisheye.CAMERA), pose
        )

    def _traced(self, scene: dict[str, Any], camera: CameraModel) -> RoomRenderer:
        return RoomRenderer(scene, camera, max_depth=self.assembly.scene.max_depth)

    def _room(self, pose: Matrix) -> RoomPictures:
        """Renders the room from a pose once: cameras on a tripod see the same room in every frame."""
        key = pose.tobytes()
        if key not in self._rooms:
            room = self._traced(self.assembly.without(), self.camera)
            color = self._color(room, pose)
            self._rooms[key] = RoomPictures(color, room.depth(pose, spp=DEPTH_SAMPLES, seed=SEED))
            self.advance()
        return self._rooms[key]

    def _color(self, room: RoomRenderer, pose: Matrix) -> Halves:
        halves = np.stack([room.color(pose, **self._half(half)) for half in (0, 1)])
        return halves.astype(np.float16).astype(np.float32)  # so that sensors see what is stored

    def _half(self, half: int) -> Any:  # noqa: ANN401 - keywords of RoomRenderer
        """Returns how to draw a half; its seeds are the same in every picture."""
        return {"spp": self.spp // 2, "seed": SEED + half, "advance": self.advance}


def world_from_fisheye(assembly: Assembly) -> Matrix:
    """Returns the pose of the fish-eye camera: above the middle of the first object's underside, looking up.

    Its axes are the world's: it looks along +z, +x is to the right in its picture and +y down.
    """
    pose = np.eye(4)
    pose[:3, 3] = np.add(assembly.base_m(), (0.0, 0.0, PROBE_HEIGHT_M))
    return pose


def coded_psnr(a: Float32[np.ndarray, "h w 3"], b: Float32[np.ndarray, "h w 3"]) -> float:
    """Returns the PSNR (dB) of two linear pictures in sRGB code of range 255; infinite if they are equal."""
    error = np.mean(np.square(srgb_coded(a) - srgb_coded(b), dtype=np.float64))
    return float(20 * np.log10(255) - 10 * np.log10(error)) if error > 0 else float("inf")
