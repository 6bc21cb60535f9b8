"""Balls with clear coats and sheens, path traced and as Deltalight draws them.

    python -m deltalight.benchmarks.coated_materials OUT

Columns: a matt ball, a rough metal and cloth, without and with what lies over them. Rows: path traced and drawn,
under two lamps and in a room with a window.
"""

import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np
import trimesh
import typer
from jaxtyping import Float32, Float64

from deltalight.benchmarks.glb_builder import GlbBuilder
from deltalight.benchmarks.ground_truth.assembly import environment_light
from deltalight.benchmarks.ground_truth.render import choose_variant
from deltalight.benchmarks.measured_materials import (
    EYE,
    FOCAL,
    RADIUS,
    SIDE,
    Lamp,
    agreement,
    codes_of,
    drawn_picture,
    lamps_of,
)
from deltalight.benchmarks.relief_materials import latitude_longitude, sky
from deltalight.protocol.files import write_png

SAMPLES = 256  # paths a pixel
LAMPS: tuple[Lamp, ...] = (((0.45, 0.35, -0.8), 3.5, 3.0), ((-0.75, 0.1, -0.35), 2.0, 3.0))


@dataclass(frozen=True)
class Finish:
    """A base, and the extensions' factors of what lies over it."""

    color: tuple[float, float, float]
    metallic: float = 0.0
    roughness: float = 0.6
    coat: tuple[float, float] = (0.0, 0.0)  # and its roughness
    sheen: tuple[float, float, float] = (0.0, 0.0, 0.0)
    sheen_roughness: float = 0.0
    name: str = field(default="", compare=False)

    @property
    def gltf(self) -> dict[str, Any]:
        """The material of a glTF file."""
        return {
            "pbrMetallicRoughness": {
                "baseColorFactor": [*self.color, 1],
                "metallicFactor": self.metallic,
                "roughnessFactor": self.roughness,
            },
            "extensions": {
                "KHR_materials_clearcoat": {
                    "clearcoatFactor": self.coat[0],
                    "clearcoatRoughnessFactor": self.coat[1],
                },
                "KHR_materials_sheen": {
                    "sheenColorFactor": self.sheen,
                    "sheenRoughnessFactor": self.sheen_roughness,
                },
            },
        }


RED, BLUE, CLOTH = (0.55, 0.03, 0.02), (0.1, 0.25, 0.7), (0.06, 0.02, 0.12)
FINISHES = (
    Finish(RED, name="matt"),
    Finish(RED, coat=(1.0, 0.03), name="matt, smooth coat"),
    Finish(RED, coat=(1.0, 0.35), name="matt, rough coat"),
    Finish(BLUE, 1.0, 0.5, name="metal"),
    Finish(BLUE, 1.0, 0.5, coat=(1.0, 0.03), name="metal, smooth coat"),
    Finish(CLOTH, 0.0, 1.0, name="cloth"),
    Finish(CLOTH, 0.0, 1.0, sheen=(0.6, 0.5, 0.9), sheen_roughness=0.35, name="cloth, sheen 0.35"),
    Finish(CLOTH, 0.0, 1.0, sheen=(0.6, 0.5, 0.9), sheen_roughness=0.8, name="cloth, sheen 0.8"),
)


def write_ball(path: Path, finish: Finish) -> None:
    """Writes a ball of that finish."""
    ball, glb = trimesh.creation.icosphere(5, RADIUS), GlbBuilder()
    attributes = {"POSITION": glb.floats(ball.vertices), "NORMAL": glb.floats(ball.vertices / RADIUS)}
    part = {
        "attributes": attributes,
        "indices": glb.array(ball.faces.astype(np.uint32).ravel()),
        "material": 0,
    }
    glb.add("materials", finish.gltf)
    glb.add("nodes", {"mesh": glb.add("meshes", {"primitives": [part]})})
    glb.write(path)


def path_traced(finish: Finish, lights: Mapping[str, Any]) -> Float32[np.ndarray, "h w 3"]:
    """Returns the ball as Mitsuba shows it to the camera of `drawn_picture`."""
    import mitsuba as mi

    from deltalight.benchmarks.ground_truth.coated_bsdf import coated

    above = mi.ScalarTransform4f().look_at(origin=list(EYE), target=[0, 0, 0], up=[0, 1, 0])
    sensor = {
        "type": "perspective",
        "fov": 2 * float(np.degrees(np.arctan(SIDE / 2 / FOCAL))),
        "to_world": above,
        "film": {"type": "hdrfilm", "width": SIDE, "height": SIDE, "rfilter": {"type": "box"}},
        "sampler": {"type": "independent", "sample_count": SAMPLES},
    }
    surface = coated(
        finish.color,
        metallic=finish.metallic,
        roughness=finish.roughness,
        coat=finish.coat,
        sheen=finish.sheen,
        sheen_roughness=finish.sheen_roughness,
    )
    scene = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 3, "hide_emitters": True},
        "sensor": sensor,
        "ball": {"type": "sphere", "radius": RADIUS, "bsdf": surface},
        **lights,
    }
    return np.asarray(mi.render(mi.load_dict(scene), seed=1))[..., :3]


def room(d: Float64[np.ndarray, "h w 3"]) -> Float32[np.ndarray, "h w 3"]:
    """Returns a dim sky and a window of two panes above it."""
    across, along = np.abs(d[..., 0] - 0.35), np.abs(d[..., 1] - 0.3)
    is_pane = (d[..., 2] > 0) & (across < 0.22) & (across > 0.02) & (along < 0.16)
    return np.asarray(sky(d) * 0.7 + 8.0 * is_pane[..., None] * np.array([1.0, 0.95, 0.85]), np.float32)


def far_lamps() -> dict[str, Any]:
    """Returns the lamps for Mitsuba, as balls far away."""
    lamps, distance_m = {}, 100.0
    for number, (way, irradiance, radius_deg) in enumerate(LAMPS):
        centre = -distance_m * np.array(way) / np.linalg.norm(way)
        sine = np.sin(np.radians(radius_deg))
        lamps[f"lamp{number}"] = {
            "type": "sphere",
            "center": centre.tolist(),
            "radius": float(distance_m * sine),
            "emitter": {
                "type": "area",
                "radiance": {"type": "rgb", "value": [irradiance / (np.pi * sine**2)] * 3},
            },
        }
    return lamps


def main(out: Path) -> None:
    """Writes the picture; prints how far its rows agree."""
    choose_variant()
    with TemporaryDirectory() as name:
        folder = Path(name)
        radiance = room(latitude_longitude())
        cv2.imwrite(str(folder / "sky.hdr"), np.ascontiguousarray(radiance[..., ::-1]))
        from_map = {
            "mode": "environment",
            "environment": {"map": str(folder / "sky.hdr")},
            "registration": [1, 1, 1],
        }
        lightings = (
            ("lamps", far_lamps(), lamps_of(LAMPS), "auto"),
            ("window", {"sky": environment_light(radiance)}, from_map, "image_based"),
        )
        columns = []
        for number, finish in enumerate(FINISHES):
            asset, rows = folder / f"ball{number}.glb", []
            write_ball(asset, finish)
            for title, emitters, lights, shading in lightings:
                truth = codes_of(path_traced(finish, emitters).astype(np.float64))
                drawn = codes_of(drawn_picture(asset, None, lights, shading))
                typer.echo(agreement(f"{finish.name}, {title}", truth, drawn))
                rows += [truth, drawn]
            columns.append(np.vstack(rows))
    write_png(out, np.hstack(columns))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
