"""A relief, path traced, beside flat plates whose material was made of its pictures: a PTM and an ABTF.

    python -m deltalight.benchmarks.relief_materials OUT

Columns: lamps between those of the stack's pictures (39 and 69 degrees from the normal), one from another side, and a
sky. Rows: Mitsuba, the polynomials, the stack.
"""

import sys
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np
import trimesh
import typer
from jaxtyping import Float32, Float64

from deltalight.benchmarks.ground_truth.assembly import environment_light
from deltalight.benchmarks.ground_truth.render import choose_variant
from deltalight.benchmarks.measured_materials import (
    FOCAL,
    SIDE,
    agreement,
    codes_of,
    drawn_picture,
    lamps_of,
    write_plate,
)
from deltalight.protocol.files import write_png
from deltalight.render_server.scene.material_file import write_material
from deltalight.render_server.scene.polynomial_texture import PolynomialTexture, polynomial_terms
from deltalight.render_server.scene.texture_stack import TextureStack, stack_of

ANGLES_DEG = np.arange(0, 85, 6.0)  # 15 pictures, as [D] 4.3.3 has them, with the light from the right
FITTED = 48  # directions of a PTM's lamps
LOWEST = 0.2  # cosine of those
LAMPS_DEG = ((39.0, 0.0), (69.0, 0.0), (45.0, 90.0))  # from the normal, and around it from the right
EDGE = SIDE / FOCAL  # m
CELLS, STUDS = 200, 5
COLORS = np.array([[0.75, 0.55, 0.25], [0.2, 0.3, 0.45]])  # of studs and ground
SAMPLES = 64  # paths a pixel
TRUTH_SEED = 0  # of what the materials are compared with, and of none that they are made of


def direction(from_normal_deg: float, around_deg: float) -> Float64[np.ndarray, "3"]:
    """Returns the unit direction to a lamp."""
    theta, phi = np.radians([from_normal_deg, around_deg])
    return np.array([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)])


def stud_heights(x: Float64[np.ndarray, "*n"], y: Float64[np.ndarray, "*n"]) -> Float64[np.ndarray, "*n"]:
    """Returns the studs' height over the ground at places 0..1, in edges of the plate; y may be flipped."""
    row = np.floor(y * STUDS)
    u, v = (x * STUDS + 0.5 * (row % 2)) % 1 - 0.5, y * STUDS % 1 - 0.5
    return np.asarray(0.7 / STUDS * np.sqrt(np.maximum(0.38**2 - u**2 - v**2, 0)))


def write_relief(path: Path) -> None:
    """Writes studs on a ground as a mesh with texture coordinates."""
    place = np.linspace(0, 1, CELLS + 1)
    x, y = np.meshgrid(place, place)
    points = np.stack([x - 0.5, y - 0.5, stud_heights(x, y)], axis=-1).reshape(-1, 3) * EDGE
    corner = (np.arange(CELLS)[:, None] * (CELLS + 1) + np.arange(CELLS)).ravel()
    lower = np.stack([corner, corner + 1, corner + CELLS + 2], axis=1)
    upper = np.stack([corner, corner + CELLS + 2, corner + CELLS + 1], axis=1)
    mesh = trimesh.Trimesh(points, np.concatenate([lower, upper]), process=False)
    mesh.visual = trimesh.visual.TextureVisuals(uv=np.stack([x, y], axis=-1).reshape(-1, 2))
    mesh.export(path)


def stud_colors() -> Float32[np.ndarray, "h w 3"]:
    """Returns the reflectance of studs and ground as a texture."""
    place = (np.arange(4 * CELLS) + 0.5) / (4 * CELLS)
    is_stud = stud_heights(*np.meshgrid(place, place)) > 0
    return np.asarray(COLORS[np.where(is_stud, 0, 1)], np.float32)


def sky(d: Float64[np.ndarray, "h w 3"]) -> Float32[np.ndarray, "h w 3"]:
    """A wide bright part over a dim ground."""
    bright = np.exp(4 * (d @ np.array([0.7, 0.3, 0.648]) - 1))[..., None]
    return np.asarray(1.2 * bright + (0.15 + 0.1 * d[..., 2:]) * np.array([0.7, 0.85, 1.0]), np.float32)


def latitude_longitude() -> Float64[np.ndarray, "128 256 3"]:
    """Directions of a map whose middle looks along +x and has +y to its left."""
    v, u = (np.mgrid[:128, :256] + 0.5) / np.reshape((128, 256), (2, 1, 1))
    azimuth, elevation = np.pi * (1 - 2 * u), np.pi * (0.5 - v)
    level = np.cos(elevation)
    return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=-1)


def path_traced(relief: Path, light: dict[str, Any], seed: int) -> Float32[np.ndarray, "h w 3"]:
    """Returns the relief from straight above; pictures of different seeds have independent noise."""
    import mitsuba as mi

    above = mi.ScalarTransform4f().look_at(origin=[0, 0, 1], target=[0, 0, 0], up=[0, 1, 0])
    sensor = {
        "type": "orthographic",
        "to_world": above @ mi.ScalarTransform4f().scale([EDGE / 2, EDGE / 2, 1]),
        "film": {"type": "hdrfilm", "width": SIDE, "height": SIDE, "rfilter": {"type": "box"}},
        "sampler": {"type": "independent", "sample_count": SAMPLES},
    }
    color = {"type": "bitmap", "bitmap": mi.Bitmap(stud_colors()), "raw": True}
    diffuse = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": color}}
    scene = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 8, "hide_emitters": True},
        "sensor": sensor,
    }
    scene["relief"] = {"type": "obj", "filename": str(relief), "face_normals": True, "bsdf": diffuse}
    return np.asarray(mi.render(mi.load_dict({**scene, "light": light}), seed=seed))[..., :3]


def lamp(towards: Float64[np.ndarray, "3"]) -> dict[str, Any]:
    """Returns light under which a white Lambertian that faces it has the radiance 1."""
    return {
        "type": "directional",
        "direction": list(-towards),
        "irradiance": {"type": "rgb", "value": [np.pi] * 3},
    }


def stack_of_relief(relief: Path) -> TextureStack:
    """Returns the ABTF of pictures with the light from the right."""
    pictures = [
        path_traced(relief, lamp(direction(angle, 0)), seed) for seed, angle in enumerate(ANGLES_DEG, 1)
    ]
    return TextureStack(stack_of(np.stack(pictures), np.cos(np.radians(ANGLES_DEG))))


def polynomials_of_relief(relief: Path) -> PolynomialTexture:
    """Returns the PTM that fits pictures with lights from everywhere best (Malzbender et al. 2001, 3)."""
    k = np.arange(FITTED)
    z, turn = 1 - (1 - LOWEST) * (k + 0.5) / FITTED, k * np.pi * (3 - np.sqrt(5))
    level = np.sqrt(1 - z * z)
    lamps = np.stack([level * np.cos(turn), level * np.sin(turn), z], axis=1)
    pictures = (path_traced(relief, lamp(each), seed) for seed, each in enumerate(lamps, 1))
    codes = np.stack([codes_of(picture.astype(np.float64)) for picture in pictures]) / 255
    fitted = np.linalg.lstsq(polynomial_terms(lamps), codes.reshape(FITTED, -1))[0]
    return PolynomialTexture(fitted.reshape(-1, *codes.shape[1:]).astype(np.float16))


def lightings(folder: Path) -> Iterator[tuple[str, dict[str, Any], dict[str, Any], str]]:
    """Yields name, light for Mitsuba, lights and shading for Deltalight."""
    for angles in LAMPS_DEG:
        towards = direction(*angles)
        lights = lamps_of([((-towards[0], -towards[1], -towards[2]), np.pi, 0.0)])
        yield (
            f"lamp {angles[0]:g} degrees from the normal, {angles[1]:g} around",
            lamp(towards),
            lights,
            "auto",
        )
    radiance = sky(latitude_longitude())
    cv2.imwrite(str(folder / "sky.hdr"), np.ascontiguousarray(radiance[..., ::-1]))
    lights = {
        "mode": "environment",
        "environment": {"map": str(folder / "sky.hdr")},
        "registration": [1, 1, 1],
    }
    yield "sky, image-based", environment_light(radiance), lights, "image_based"


def main(out: Path) -> None:
    """Writes the picture; prints how far the rows agree with the first."""
    choose_variant()
    with TemporaryDirectory() as name:
        folder = Path(name)
        write_relief(folder / "relief.obj")
        write_plate(folder / "plate.obj")
        write_material(folder / "PTM.dlmat", polynomials_of_relief(folder / "relief.obj"))
        write_material(folder / "ABTF.dlmat", stack_of_relief(folder / "relief.obj"))
        columns = []
        for title, light, lights, shading in lightings(folder):
            rows = [codes_of(path_traced(folder / "relief.obj", light, TRUTH_SEED).astype(np.float64))]
            for kind in ("PTM", "ABTF"):
                rows.append(
                    codes_of(drawn_picture(folder / "plate.obj", folder / f"{kind}.dlmat", lights, shading))
                )
                typer.echo(agreement(f"{kind}, {title}", rows[0], rows[-1]))
            columns.append(np.vstack(rows))
    write_png(out, np.hstack(columns))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
