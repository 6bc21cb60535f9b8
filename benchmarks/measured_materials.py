"""Measured materials as their data say, and as Deltalight draws what it makes of them, in a black room.

    python -m deltalight.benchmarks.measured_materials FOLDER OUT

Balls of paint (`.brdf`) stand under two lamps, a plate with a polynomial texture map under one of three.

Between samples, the measurements are interpolated as Pharr and Humphreys do (Physically Based Rendering, second
edition, 8.6.2): by Gaussian weights in (sin sin, azimuth / pi, cos cos).
"""

import sys
from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np
import trimesh
import typer
from jaxtyping import Float64, UInt8
from scipy.spatial import cKDTree

from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.files import write_png
from deltalight.protocol.frames import BoardPose, DepthImage, ViewFrame, decode_lut
from deltalight.protocol.scene import parse_scene
from deltalight.render_server.gpu.context import GpuContext, create_context
from deltalight.render_server.renderer import SceneRenderer
from deltalight.render_server.scene.brdf_fit import fit_brdf
from deltalight.render_server.scene.brdf_measurements import BRDF_SUFFIX, BrdfMeasurements, read_brdf
from deltalight.render_server.scene.material_file import write_material
from deltalight.render_server.scene.texture_folder import INFO_NAME
from deltalight.render_server.scene.textures_by_light import read_texture_by_light

SIDE, FOCAL = 200, 380.0  # pixels
EYE, RADIUS = np.array([0.0, 0.0, 1.0]), 0.22  # m
Lamp = tuple[tuple[float, float, float], float, float]  # way of the light, irradiance, half-angle (degrees)
PAINT_LAMPS: tuple[Lamp, ...] = (((0.45, 0.35, -0.8), 9.0, 3.0), ((-0.75, 0.1, -0.35), 5.0, 3.0))
MAP_LAMPS = ((-0.7, 0.0, -0.7), (0.0, -0.7, -0.7), (0.4, 0.3, -0.87))
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
        found = self._tree.query(_place(light, view), k=_NEIGHBOURS)
        distance, nearest = np.asarray(found[0]), np.asarray(found[1])
        weights = np.exp(-_SHARPNESS * (distance**2 - distance[:, :1] ** 2))
        total = (weights[..., None] * self._values[nearest]).sum(axis=1)
        return np.asarray(total / weights.sum(axis=1, keepdims=True))


def _place(light: Float64[np.ndarray, "n 3"], view: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
    sines = np.linalg.norm(light[:, :2], axis=1) * np.linalg.norm(view[:, :2], axis=1)
    across = light[:, 0] * view[:, 1] - light[:, 1] * view[:, 0]
    turn = np.abs(np.arctan2(across, (light[:, :2] * view[:, :2]).sum(axis=1)))
    return np.stack([sines, turn / np.pi, light[:, 2] * view[:, 2]], axis=1)


def _camera(side: int = SIDE) -> CameraModel:
    middle, focal = (side - 1) / 2, FOCAL * side / SIDE
    return CameraModel(
        side, side, np.array([[focal, 0, middle], [0, focal, middle], [0, 0, 1]]), "plumb_bob", np.zeros(5)
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
    for way, irradiance, radius_deg in PAINT_LAMPS:
        axis = -np.array(way) / np.linalg.norm(way)
        aside = np.cross(axis, (0, 0, 1))
        aside /= np.linalg.norm(aside)
        for k in range(_DISC):
            off, turn = np.radians(radius_deg) * np.sqrt((k + 0.5) / _DISC), 2.39996 * k
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


def lamps_of(lamps: Sequence[Lamp]) -> dict[str, Any]:
    """Returns the `lights` of a scene document."""
    manual = [
        {"type": "directional", "direction": way, "irradiance": strength, "angular_radius_deg": radius_deg}
        for way, strength, radius_deg in lamps
    ]
    return {"manual": manual, "surroundings": "none"}


@cache
def _gpu() -> GpuContext:
    return create_context()


def drawn_picture(
    asset: Path, material: Path | None, lights: dict[str, Any], shading: str = "auto"
) -> Float64[np.ndarray, "h w 3"]:
    """Returns the object as Deltalight draws it; without `material`, as its file has it."""
    given = {} if material is None else {"material": {"precomputed": str(material)}}
    thing = {"asset": str(asset), "up_axis": "z", **given}
    document = {"objects": [thing], "lights": lights, "shading": {"name": shading}}
    return drawn_document(document, np.zeros((SIDE, SIDE, 3), np.uint8))


def drawn_document(
    document: dict[str, Any], ground: UInt8[np.ndarray, "side side 3"]
) -> Float64[np.ndarray, "side side 3"]:
    """Returns a scene document's objects before a picture `FAR_M` away, in linear light.

    The camera is at `EYE`, looks along -z and has +y above.

    Raises:
        DeltalightError: an object cannot be loaded.
    """
    side = len(ground)
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[:3, 3] = EYE
    depth = np.full((side, side), FAR_M, np.float32)
    view = ViewFrame(
        color=ground,
        frame_id=0,
        timestamp_ns=0,
        camera=_camera(side),
        pose=BoardPose(pose),
        depth=DepthImage(depth, depth > 0, _camera(side), 0.001),
    )
    scene = parse_scene({"method": {"name": "none"}, **document})
    renderer = SceneRenderer(_gpu(), scene, with_linear=True)
    try:
        linear = renderer.render(view).linear
    finally:
        renderer.release()
    assert linear is not None
    return linear


def codes_of(linear: Float64[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    """Returns the sRGB codes of a radiance whose white is 1."""
    return np.asarray(np.searchsorted(decode_lut(None)[:, 0], np.clip(linear, 0, 1)), np.uint8)


def agreement(name: str, one: UInt8[np.ndarray, "..."], other: UInt8[np.ndarray, "..."]) -> str:
    """Returns the PSNR of two pictures as a line."""
    error = np.mean((one.astype(float) - other) ** 2)
    return f"{name}: {10 * np.log10(255**2 / error):.1f} dB"


def draw_paint(path: Path, folder: Path) -> UInt8[np.ndarray, "h w 3"]:
    """Returns a ball of a `.brdf` file, above as measured, below as drawn; prints how far they agree."""
    shown, normals, views = _surface()
    samples = read_brdf(path)
    write_material(folder / "paint.dlmat", fit_brdf(samples))
    trimesh.creation.icosphere(5, RADIUS).export(folder / "ball.ply", vertex_normal=True)
    codes = [
        codes_of(measured_picture(Interpolated(samples))),
        codes_of(drawn_picture(folder / "ball.ply", folder / "paint.dlmat", lamps_of(PAINT_LAMPS))),
    ]
    facing = (normals * views).sum(axis=1) > _GRAZING
    typer.echo(agreement(path.stem, codes[0][shown][facing], codes[1][shown][facing]))
    return np.vstack(codes)


def write_plate(path: Path) -> None:
    """Writes a plate that fills the picture, with texture coordinates."""
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * SIDE / FOCAL / 2
    plate = trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]])
    plate.visual = trimesh.visual.TextureVisuals(uv=[[0, 0], [1, 0], [1, 1], [0, 1]])
    plate.export(path)


def draw_map(source: Path, folder: Path) -> list[UInt8[np.ndarray, "h w 3"]]:
    """Returns plates with a polynomial texture map under lamps, above as the polynomials have it, below as drawn."""
    texture = read_texture_by_light(source)
    write_material(folder / "map.dlmat", texture)
    write_plate(folder / "plate.obj")
    columns = []
    for way in MAP_LAMPS:
        shown = texture.under(-np.array(way) / np.linalg.norm(way))
        codes = [
            codes_of(cv2.resize(shown, (SIDE, SIDE), interpolation=cv2.INTER_AREA).astype(np.float64)),
            codes_of(
                drawn_picture(folder / "plate.obj", folder / "map.dlmat", lamps_of([(way, np.pi, 0.0)]))
            ),
        ]
        typer.echo(agreement(f"{source.name}, light along {way}", *codes))
        columns.append(np.vstack(codes))
    return columns


def main(source: Path, out: Path) -> None:
    """Writes the picture of a folder of `.brdf` files, or of a folder with a polynomial texture map."""
    with TemporaryDirectory() as name:
        if (source / INFO_NAME).is_file():
            columns = draw_map(source, Path(name))
        else:
            columns = [draw_paint(path, Path(name)) for path in sorted(source.glob(f"*{BRDF_SUFFIX}"))]
    if not columns:
        raise DeltalightError(f"{source} has no {BRDF_SUFFIX} file and no {INFO_NAME}; give another folder.")
    write_png(out, np.hstack(columns))


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
