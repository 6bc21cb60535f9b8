"""Small pictures of meshes and environment maps, drawn on the processor (in the worker)."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float32, Int

from deltalight.protocol.frames import LUMINANCE, srgb_code
from deltalight.protocol.radiance_files import read_linear
from deltalight.render_server.scene.asset_check import check_mesh_file
from deltalight.render_server.scene.bvh import RayCaster
from deltalight.render_server.scene.mesh_loading import load_mesh
from deltalight.render_server.scene.texture_maps import TextureMap
from deltalight.render_server.scene.triangle_mesh import TriangleMesh
from deltalight.services.storage.asset_kinds import Facts

SIZE = 256
SAMPLES = 2  # rays along each edge of a pixel
MARGIN = 1.06
# Three-quarter view: from the front right and above, so far away (in radii of the object) that lines hardly converge.
AZIMUTH_DEG, ELEVATION_DEG, DISTANCE = -55.0, 25.0, 4.0
# In camera axes (right, up, towards the camera): a key light from the upper left, a weaker one from the right, and
# ambient light. White that faces the key light is just not clipped.
KEY, FILL = np.array([-0.5, 0.7, 0.5], np.float32), np.array([0.9, 0.1, 0.4], np.float32)
KEY_LIGHT, FILL_LIGHT, AMBIENT_LIGHT = 0.65, 0.2, 0.15
TEXTURE_EDGE = 2 * SIZE  # a texture in full view is not finer than the rays
MIDDLE_GREY = 0.18  # target of the mean logarithm of a map's luminance (Reinhard et al. 2002)

Pixels = Float32[np.ndarray, "h w 4"]


def draw_mesh(path: Path, out: str) -> Facts:
    """Writes a three-quarter view of a mesh as PNG on a transparent ground.

    Raises:
        DeltalightError: the mesh cannot be loaded.
    """
    is_y_up = check_mesh_file(path) == ".glb"
    meshes = load_mesh(path)
    write_picture(out, reduced(_Shot(meshes, is_y_up=is_y_up).rays(SIZE * SAMPLES)))
    return {}


def draw_map(path: Path, out: str) -> Facts:
    """Writes a latitude-longitude map as PNG, tone-mapped (Reinhard et al. 2002), in the middle of the picture.

    Raises:
        DeltalightError: the map cannot be loaded.
    """
    small = cv2.resize(read_linear(path), (SIZE, SIZE // 2), interpolation=cv2.INTER_AREA)
    luminance = small @ LUMINANCE
    mean = np.exp(np.log(luminance + 1e-4 * luminance.max() + 1e-9).mean())
    scaled = MIDDLE_GREY / mean * luminance
    shown = small * (MIDDLE_GREY / mean / (1 + scaled))[..., None]
    picture = np.zeros((SIZE, SIZE, 4), np.float32)
    picture[SIZE // 4 : SIZE // 4 + SIZE // 2] = np.dstack([shown, np.ones_like(luminance)])
    write_picture(out, picture)
    return {}


class _Shot:
    """Meshes in front of a camera, ready for ray casting; lengths are in radii of the whole."""

    def __init__(self, meshes: list[TriangleMesh], *, is_y_up: bool) -> None:
        self._meshes = meshes
        self._camera_from_file = _camera_axes() @ (_Z_FROM_Y if is_y_up else np.eye(3, dtype=np.float32))
        bounds = np.stack([mesh.bounds() for mesh in meshes])
        low, high = bounds[:, 0].min(axis=0), bounds[:, 1].max(axis=0)
        radius = max(float(np.linalg.norm(high - low)) / 2, 1e-9)
        placed = [
            ((mesh.positions - (low + high) / 2) / radius @ self._camera_from_file.T - [0, 0, DISTANCE])
            for mesh in meshes
        ]
        counts = [0, *np.cumsum([len(mesh.positions) for mesh in meshes])]
        triangles = [mesh.triangles + first for mesh, first in zip(meshes, counts, strict=False)]
        self._positions = np.concatenate(placed).astype(np.float32)
        self._triangles = np.concatenate(triangles).astype(np.int32)
        self._caster = RayCaster(self._positions, self._triangles)

    def rays(self, size: int) -> Pixels:
        """Casts size x size rays around the meshes; returns premultiplied linear colour and coverage."""
        used = self._positions[self._triangles.ravel()]
        seen = used[:, :2] / -used[:, 2:]
        middle = (seen.min(axis=0) + seen.max(axis=0)) / 2
        reach = MARGIN * float(np.ptp(seen, axis=0).max()) / 2
        steps = (2 * (np.arange(size) + 0.5) / size - 1) * reach
        right, up = np.meshgrid(middle[0] + steps, middle[1] - steps)
        directions = np.dstack([right, up, -np.ones_like(right)]).reshape(-1, 3).astype(np.float32)
        hits = self._caster.cast(np.zeros_like(directions), directions)
        pixels, own = np.zeros((size * size, 4), np.float32), hits.triangle
        for mesh in self._meshes:
            rays = np.flatnonzero((own >= 0) & (own < len(mesh.triangles)))
            corners = mesh.triangles[own[rays]]
            own = own - len(mesh.triangles)  # the next mesh begins with its triangle 0
            u, v = hits.u[rays], hits.v[rays]
            weights = np.stack([1 - u - v, u, v], axis=1)
            pixels[rays, :3] = self._shaded(mesh, corners, weights, directions[rays])
            pixels[rays, 3] = 1
        return pixels.reshape(size, size, 4)

    def _shaded(
        self,
        mesh: TriangleMesh,
        corners: Int[np.ndarray, "n 3"],
        weights: Float32[np.ndarray, "n 3"],
        directions: Float32[np.ndarray, "n 3"],
    ) -> Float32[np.ndarray, "n 3"]:
        """Returns the radiance of Lambertian surfaces towards the camera; both sides of a triangle are lit."""
        normals = _mixed(mesh.normals, corners, weights) @ self._camera_from_file.T
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
        normals *= np.where((normals * directions).sum(axis=1, keepdims=True) > 0, -1, 1)
        light = np.full((len(normals), 1), AMBIENT_LIGHT, np.float32)
        for strength, direction in ((KEY_LIGHT, KEY), (FILL_LIGHT, FILL)):
            light += strength * np.maximum(normals @ (direction / np.linalg.norm(direction)), 0)[:, None]
        material, tint = mesh.material, np.ones_like(normals)
        if mesh.colors is not None:
            tint = _mixed(mesh.colors, corners, weights)
        base, glow = (
            _texels(mesh, each, corners, weights) for each in (material.base_color_map, material.emissive_map)
        )
        emission = material.emission * glow * (tint if material.is_unlit else 1)
        return np.asarray(material.base_color * tint * base * light + emission, np.float32)


_Z_FROM_Y = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]], np.float32)


def _camera_axes() -> Float32[np.ndarray, "3 3"]:
    """Returns the rotation from z-up axes to those of the camera: right, up, towards it."""
    azimuth, elevation = np.radians([AZIMUTH_DEG, ELEVATION_DEG])
    back = np.array(
        [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)]
    )
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0])
    return np.stack([right, np.cross(back, right), back]).astype(np.float32)


def _mixed(
    values: Float32[np.ndarray, "k c"], corners: Int[np.ndarray, "n 3"], weights: Float32[np.ndarray, "n 3"]
) -> Float32[np.ndarray, "n c"]:
    return np.asarray(np.einsum("nkc,nk->nc", values[corners], weights), np.float32)


def _texels(
    mesh: TriangleMesh,
    texture: TextureMap | None,
    corners: Int[np.ndarray, "n 3"],
    weights: Float32[np.ndarray, "n 3"],
) -> Float32[np.ndarray, "n 3"]:
    """Returns the nearest colours of a texture, downsampled first if it is finer than the picture; 1 without one."""
    uv = mesh.uv_of(texture)
    if texture is None or uv is None:
        return np.ones((len(corners), 3), np.float32)
    rows, columns = (min(edge, TEXTURE_EDGE) for edge in texture.texels.shape[:2])
    colors = texture.texels[..., :3].astype(np.float32)
    coarse = cv2.resize(colors, (columns, rows), interpolation=cv2.INTER_AREA)
    return replace(texture, texels=coarse).nearest(_mixed(uv, corners, weights))


def reduced(pixels: Pixels) -> Pixels:
    """Averages the rays of each pixel; colour is that of the covered part."""
    mean = cv2.resize(pixels, (SIZE, SIZE), interpolation=cv2.INTER_AREA)
    mean[..., :3] /= np.maximum(mean[..., 3:], 1e-6)
    return np.asarray(mean)


def write_picture(out: str, picture: Pixels) -> None:
    """Writes linear colour and coverage (1 = covered) as PNG in sRGB codes."""
    coded = srgb_code(picture[..., :3])
    codes = np.rint(255 * np.dstack([coded[..., ::-1], picture[..., 3]])).astype(np.uint8)
    Path(out).write_bytes(cv2.imencode(".png", codes)[1].tobytes())
