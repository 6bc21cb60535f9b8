"""Building blocks of Mitsuba scenes: placed shapes, materials, textures, meshes."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import trimesh
from jaxtyping import Float, Float32

from deltalight.benchmarks.ground_truth.board_texture import board_texture
from deltalight.protocol.board import BoardSpec

Triple = tuple[float, float, float]
Matrix = Float[np.ndarray, "4 4"]
IDENTITY: Matrix = np.eye(4)


@dataclass(frozen=True)
class MeshFolder:
    """The folder of meshes for Mitsuba; names must be unique within a scene."""

    path: Path

    def ply(self, name: str, mesh: trimesh.Trimesh) -> str:
        """Writes a mesh with its normals and returns the file's name."""
        file = self.path / f"{name}.ply"
        mesh.export(file, vertex_normal=True)
        return str(file)


def shape(kind: str, place: Matrix, **parts: object) -> dict[str, Any]:
    """Returns a shape of Mitsuba's kind at `place` (world from shape, 4x4)."""
    import mitsuba as mi

    return {"type": kind, "to_world": mi.ScalarTransform4f(place), **parts}


def mesh_shape(
    name: str, mesh: trimesh.Trimesh, place: Matrix, folder: MeshFolder, bsdf: dict[str, Any]
) -> dict[str, Any]:
    """Returns a double-sided triangle mesh."""
    return shape("ply", place, filename=folder.ply(name, mesh), bsdf=two_sided(bsdf))


def placed(translation_m: Triple, turn: Matrix = IDENTITY, scale: Triple = (1.0, 1.0, 1.0)) -> Matrix:
    """Returns world from shape: scaled, then rotated, then moved."""
    translation = trimesh.transformations.translation_matrix(translation_m)
    return np.asarray(translation @ turn @ np.diag([*scale, 1.0]))


def turned(axis: Literal["x", "y", "z"], angle_deg: float) -> Matrix:
    """Returns the rotation about a world axis, right-handed."""
    direction = [float(axis == name) for name in "xyz"]
    return np.asarray(trimesh.transformations.rotation_matrix(np.radians(angle_deg), direction))


def box(center_m: Triple, half_m: Triple, turn_deg: float, color: Triple) -> dict[str, Any]:
    """Returns an upright diffuse box, rotated about z."""
    return shape("cube", placed(center_m, turned("z", turn_deg), half_m), bsdf=diffuse(rgb(color)))


def rectangle(place: Matrix, albedo: Float32[np.ndarray, "h w 3"] | Triple) -> dict[str, Any]:
    """Returns a diffuse rectangle spanning [-1, 1]^2, of one colour or with a texture whose first row is at v = 1."""
    reflectance = rgb(albedo) if isinstance(albedo, tuple) else texture(albedo)
    return shape("rectangle", place, bsdf=two_sided(diffuse(reflectance)))


def texture(albedo: Float32[np.ndarray, "h w 3"]) -> dict[str, Any]:
    """Returns linear colours as a texture."""
    import mitsuba as mi

    picture = mi.Bitmap(np.ascontiguousarray(albedo[::-1], np.float32))
    return {"type": "bitmap", "bitmap": picture, "raw": True, "wrap_mode": "clamp"}


def sheet(board: BoardSpec) -> dict[str, Any]:
    """Returns the printed marker board on z = 0."""
    paper = board_texture(board)
    center, half = (paper.min_m + paper.max_m) / 2, (paper.max_m - paper.min_m) / 2
    place = placed((float(center[0]), float(center[1]), 0.0), scale=(float(half[0]), float(half[1]), 1.0))
    return rectangle(place, np.repeat(paper.albedo[..., None], 3, axis=2))


def sheet_surface(board: BoardSpec) -> dict[str, Any]:
    """Returns the entry of `real.surfaces` that keeps the whole sheet diffuse, with the margin beyond its print."""
    paper = board_texture(board)
    low, high = ([float(v) for v in corner] for corner in (paper.min_m, paper.max_m))
    region = {"box": {"min_m": [*low, -0.003], "max_m": [*high, 0.003]}}
    return {"region": region, "roughness": 1.0, "specular": 0.0}


def two_sided(bsdf: dict[str, Any]) -> dict[str, Any]:
    """Returns a material that is the same on both sides."""
    return {"type": "twosided", "bsdf": bsdf}


def diffuse(reflectance: dict[str, Any]) -> dict[str, Any]:
    """Returns a Lambertian material."""
    return {"type": "diffuse", "reflectance": reflectance}


def rgb(color: Triple | Float[np.ndarray, "3"]) -> dict[str, Any]:
    """Returns a linear R G B colour."""
    return {"type": "rgb", "value": [float(c) for c in color]}


def looking(eye_m: Triple, target_m: Triple) -> Matrix:
    """Returns world from camera (OpenCV axes: x right, y down, z forward) of an upright camera."""
    eye, forward = np.array(eye_m), np.subtract(target_m, eye_m)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(forward, right), forward, eye], axis=1)
    return pose
