"""A smooth table with a carton on it before a wall, traced by hand: what a camera and its depth show of it."""

from dataclasses import dataclass

import cv2
import numpy as np

from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.frames import DepthImage, ViewFrame, srgb_code
from deltalight.protocol.scene_objects import PlaneRegion, Region, Surface
from deltalight.render_server.view import CameraView, PosedFrame
from tests.render_server.scenes import camera, look_at

EYE = np.array([0.25, -0.9, 0.65])
WALL_Y, CARTON_Y, CARTON_X, CARTON_Z = 0.5, 0.12, 0.1, 0.2
WALL, CARTON = np.array([0.55, 0.50, 0.45]), np.array([0.08, 0.20, 0.45])
DEPTH_NOISE, NOISE = 0.001, 0.004
TABLE = Region(plane=PlaneRegion(point_m=(0, 0, 0), normal=(0, 0, 1), tolerance_m=0.006))
SILVER = Surface(region=TABLE, metallic=1.0, albedo=(0.9, 0.9, 0.9), roughness=0.02)
VARNISH = Surface(region=TABLE, roughness=0.1)


@dataclass(frozen=True)
class Sheet:
    """A sheet on the table: middle, size (m), turn (degrees), and what it sends back."""

    radiance: tuple[float, float, float] = (0.2, 0.3, 0.4)
    middle: tuple[float, float] = (0.0, 0.0)
    size: tuple[float, float] = (0.34, 0.2)
    turn_deg: float = 20.0

    @property
    def corners(self) -> np.ndarray:
        turn, half = np.radians(self.turn_deg), np.array(self.size) / 2
        axes = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
        signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
        return np.column_stack([np.array(self.middle) + (signs * half) @ axes, np.zeros(4)])


def lens(scale: int = 1) -> CameraModel:
    return camera(320 * scale, 240 * scale, 300.0 * scale)


def standing(origin: np.ndarray, rays: np.ndarray, *, has_carton: bool) -> tuple[np.ndarray, np.ndarray]:
    """Radiance of what stands on the table along rays, and how far it is (infinite: nothing)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        to_wall, to_carton = ((y - origin[..., 1]) / rays[..., 1] for y in (WALL_Y, CARTON_Y))
    wall = np.where(to_wall > 0, to_wall, np.inf)
    at = origin + rays * np.where(np.isfinite(to_carton), to_carton, 0)[..., None]
    on_carton = (to_carton > 0) & (np.abs(at[..., 0]) < CARTON_X) & (at[..., 2] < CARTON_Z) & (at[..., 2] > 0)
    on_carton &= has_carton
    return np.where(on_carton[..., None], CARTON, WALL), np.where(on_carton, to_carton, wall)


def seen(
    surface: Surface = SILVER,
    sheet: Sheet | None = None,
    *,
    diffuse: float | np.ndarray = 0.0,
    has_carton: bool = True,
    timestamp_ns: int = 0,
) -> PosedFrame:
    """A frame of the table; `diffuse` is what it sends back beside its reflection (of TEXTURE_SIZE or one)."""
    pose, fine = look_at(tuple(EYE)).world_from_camera, lens(2)
    rays = np.dstack([fine.rays(), np.ones((fine.height, fine.width))]) @ pose[:3, :3].T
    radiance, away = standing(EYE, rays, has_carton=has_carton)
    with np.errstate(divide="ignore"):
        to_table = np.where(rays[..., 2] < 0, -EYE[2] / rays[..., 2], np.inf)
    on_table = to_table < away
    at = EYE + rays * np.where(on_table, to_table, 0)[..., None]
    mirrored, _ = standing(at, rays * (1, 1, -1), has_carton=has_carton)
    cosine = np.abs(rays[..., 2:]) / np.linalg.norm(rays, axis=2, keepdims=True)
    f0 = np.array(surface.albedo) if surface.metallic else np.full(3, 0.08 * surface.specular)
    table = (f0 + (1 - f0) * (1 - cosine) ** 5) * mirrored + np.broadcast_to(diffuse, mirrored.shape)
    radiance = np.where(on_table[..., None], table, radiance)
    if sheet is not None:
        local = (sheet.corners - EYE) @ pose[:3, :3]
        mask = np.zeros(on_table.shape, np.uint8)
        cv2.fillConvexPoly(mask, np.rint(fine.project(local)).astype(np.int32), 1)
        radiance[(mask > 0) & on_table] = sheet.radiance
    return _taken(radiance, np.minimum(to_table, away), timestamp_ns)


def _taken(radiance: np.ndarray, depth: np.ndarray, timestamp_ns: int) -> PosedFrame:
    random, size = np.random.default_rng(5), (320, 240)
    linear = cv2.resize(radiance, size, interpolation=cv2.INTER_AREA)
    linear = linear + NOISE * random.standard_normal(linear.shape)
    z = depth[::2, ::2].astype(np.float32)
    z = (z + DEPTH_NOISE * z**2 * random.standard_normal(z.shape)).astype(np.float32)
    pose = look_at(tuple(EYE))
    view = ViewFrame(
        0,
        timestamp_ns,
        np.rint(255 * srgb_code(linear)).astype(np.uint8),
        lens(),
        pose=pose,
        depth=DepthImage(z, np.isfinite(z), lens(), DEPTH_NOISE),
    )
    return PosedFrame(view, CameraView(lens(), pose.world_from_camera))
