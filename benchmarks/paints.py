"""Balls of measured paints, as their samples say and as Deltalight draws the fit, under two lamps in a black room.

    python -m deltalight.benchmarks.paints FOLDER OUT

Between samples, the measurements are interpolated as Pharr and Humphreys do (Physically Based Rendering, second
edition, 8.6.2): by Gaussian weights in (sin sin, azimuth / pi, cos cos).
"""

import sys
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import trimesh
from jaxtyping import Float64
from scipy.spatial import cKDTree

from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.files import write_png
from deltalight.protocol.frames import BoardPose, DepthImage, ViewFrame
from deltalight.protocol.scene import parse_scene
from deltalight.render_server.gpu.context import create_context
from deltalight.render_server.renderer import SceneRenderer
from deltalight.render_server.scene.brdf_fit import fit_brdf
from deltalight.render_server.scene.brdf_measurements import BRDF_SUFFIX, BrdfMeasurements, read_brdf
from deltalight.render_server.scene.material_file import write_material

SIDE, FOCAL = 200, 380.0  # pixels
EYE, RADIUS = np.array([0.0, 0.0, 1.0]), 0.22  # m
LAMPS = (((0.45, 0.35, -0.8), 9.0), ((-0.75, 0.1, -0.35), 5.0))  # ways of the light, irradiance
LAMP_RADIUS_DEG = 3.0
FAR_M = 5.0
_DISC = 12  # directions that stand for a lamp
_NEIGHBOURS = 8
_SHARPNESS = 100.0
_GRAZING = 0.17  # cosine to viewer or lamp, below which nothing was measured


class Interpolated:
    """A measured BRDF between its samples."""

    def __init__(self, samples: BrdfMeasurements) -> None:
        self._values = samples.values
        self._tree = cKDTree(_place(samples.light, samples.view))

    def evaluate(
        self, light: Float64[np.ndarray, "n 3"], view: Float64[np.ndarray, "n 3"]
    ) -> Float64[np.ndarray, "n 3"]:
        """Returns the BRDF, 1/sr, for unit directions about the normal z."""
        distance, nearest = self._tree.query(_place(light, view), k=_NEIGHBOURS)
        weights = np.exp(-_SHARPNESS * (distance**2 - distance[:, :1] ** 2))
        total = (weights[..., None] * self._values[nearest]).sum(axis=1)
        return np.asarray(total / weights.sum(axis=1, keepdims=True))


def _place(light: Float64[np.ndarray, "n 3"], view: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
    sines = np.linalg.norm(light[:, :2], axis=1) * np.linalg.norm(view[:, :2], axis=1)
    across = light[:, 0] * view[:, 1] - light[:, 1] * view[:, 0]
    turn = np.abs(np.arctan2(across, (light[:, :2] * view[:, :2]).sum(axis=1)))
    return np.stack([sines, turn / np.pi, light[:, 2] * view[:, 2]], axis=1)


def _camera() -> CameraModel:
    middle = (SIDE - 1) / 2
    return CameraModel(
        SIDE, SIDE, np.array([[FOCAL, 0, middle], [0, FOCAL, middle], [0, 0, 1]]), "plumb_bob", np.zeros(5)
    )


def _surface() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns which pixels show the ball (h, w), and normals and directions to the eye there."""
    rays = np.dstack([_camera().rays(), np.ones((SIDE, SIDE))]).reshape(-1, 3) * (1, -1, -1)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    b, c = rays @ EYE, EYE @ EYE - RADIUS**2
    hits = b * b > c
    distance = -b[hits] - np.sqrt(b[hits] ** 2 - c)
    normals = (EYE + distance[:, None] * rays[hits]) / RADIUS
    return hits.reshape(SIDE, SIDE), normals, -rays[hits]


def _disc() -> Iterator[tuple[np.ndarray, float]]:
    """Yields directions to the lamps and the irradiance from there."""
    for way, irradiance in LAMPS:
        axis = -np.array(way) / np.linalg.norm(way)
        aside = np.cross(axis, (0, 0, 1))
        aside /= np.linalg.norm(aside)
        for k in range(_DISC):
            off, turn = np.radians(LAMP_RADIUS_DEG) * np.sqrt((k + 0.5) / _DISC), 2.39996 * k
            towards = axis + off * (np.cos(turn) * aside + np.sin(turn) * np.cross(axis, aside))
            yield towards / np.linalg.norm(towards), irradiance / _DISC


def measured_picture(brdf: Interpolated) -> Float64[np.ndarray, "h w 3"]:
    """Returns the radiance of the ball as the samples say."""
    shown, normals, views = _surface()
    aside = np.cross(normals, (0.3, 0.9, 0.2))
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    axes = np.stack([aside, np.cross(normals, aside), normals], axis=1)
    view = np.einsum("nij,nj->ni", axes, views)
    radiance = np.zeros_like(normals)
    for towards, irradiance in _disc():
        light = axes @ towards
        lit = light[:, 2] > 1e-3
        radiance[lit] += irradiance * light[lit, 2:] * brdf.evaluate(light[lit], view[lit])
    picture = np.zeros((SIDE, SIDE, 3))
    picture[shown] = radiance
    return picture


def drawn_picture(material: Path, folder: Path) -> Float64[np.ndarray, "h w 3"]:
    """Returns the ball as Deltalight draws it."""
    trimesh.creation.icosphere(5, RADIUS).export(folder / "ball.ply", vertex_normal=True)
    lamps = [
        {
            "type": "directional",
            "direction": way,
            "irradiance": strength,
            "angular_radius_deg": LAMP_RADIUS_DEG,
        }
        for way, strength in LAMPS
    ]
    document = {
        "objects": [{"asset": str(folder / "ball.ply"), "material": {"precomputed": str(material)}}],
        "lights": {"manual": lamps, "surroundings": "none"},
        "method": {"name": "none"},
    }
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[:3, 3] = EYE
    depth = np.full((SIDE, SIDE), FAR_M, np.float32)
    view = ViewFrame(
        color=np.zeros((SIDE, SIDE, 3), np.uint8),
        frame_id=0,
        timestamp_ns=0,
        camera=_camera(),
        pose=BoardPose(pose),
        depth=DepthImage(depth, depth > 0, _camera(), 0.001),
    )
    renderer = SceneRenderer(create_context(), parse_scene(document), with_linear=True)
    try:
        linear = renderer.render(view).linear
    finally:
        renderer.release()
    assert linear is not None
    return linear


def main(folder: Path, out: Path) -> None:
    """Writes the picture: above as measured, below as drawn; prints how far they agree."""
    columns = []
    shown, normals, views = _surface()
    facing = (normals * views).sum(axis=1) > _GRAZING
    for path in sorted(folder.glob(f"*{BRDF_SUFFIX}")):
        samples = read_brdf(path)
        with TemporaryDirectory() as name:
            write_material(Path(name) / "paint.dlmat", fit_brdf(samples))
            drawn = drawn_picture(Path(name) / "paint.dlmat", Path(name))
        measured = measured_picture(Interpolated(samples))
        codes = [
            np.clip(255 * np.clip(each, 0, 1) ** (1 / 2.2) + 0.5, 0, 255).astype(np.uint8)
            for each in (measured, drawn)
        ]
        difference = codes[0][shown][facing].astype(float) - codes[1][shown][facing]
        print(f"{path.stem}: {10 * np.log10(255**2 / (difference**2).mean()):.1f} dB")
        columns.append(np.vstack(codes))
    write_png(out, np.hstack(columns))


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
