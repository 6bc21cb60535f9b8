"""Objects under a smooth sky by precomputed transfer, beside Mitsuba's path tracer."""

import importlib.util
import os
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh
from jaxtyping import Float32

from deltalight.benchmarks.ground_truth.assembly import environment_light
from deltalight.benchmarks.ground_truth.render import choose_variant
from deltalight.benchmarks.relief_materials import latitude_longitude
from deltalight.protocol.frames import BoardPose
from deltalight.protocol.scene import SceneDocument
from deltalight.protocol.scene_lights import EnvironmentLights, Lights
from deltalight.protocol.scene_method import NoneMethod
from deltalight.protocol.scene_output import Shading
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.renderer import SceneRenderer
from deltalight.render_server.scene.mesh_loading import load_mesh
from tests.render_server.scenes import (
    COARSE,
    Stage,
    Vector,
    array_of,
    ball,
    camera,
    floor,
    frame,
    look_at,
    shifted,
    with_neighbours,
)

pytestmark = [pytest.mark.slow(seconds=22), pytest.mark.usefixtures("clean_gl")]
if importlib.util.find_spec("mitsuba") is None:
    pytest.skip("Mitsuba is not installed", allow_module_level=True)
WIDTH, HEIGHT, FOCAL = 160, 120, 210.0
SHADINGS: dict[str, dict[str, Any]] = {
    "image_based": {"name": "image_based"},
    "9 coefficients": {"name": "precomputed"},
    "16 coefficients": {"name": "precomputed", "coefficients": 16},
    "without bounces": {"name": "precomputed", "bounces": 0},
}
COLOR = (0.75, 0.35, 0.2)


def sky(d: np.ndarray) -> Float32[np.ndarray, "a b 3"]:
    """A bright side, some 20 degrees wide, over a ground that is darker than the rest."""
    bright = np.exp(12 * (d @ np.array([-0.6, -0.3, 0.742]) - 1))[..., None]
    even = (0.25 + 0.15 * d[..., 2:]) * np.array([0.7, 0.85, 1.0])
    return np.asarray(bright * (3.0, 2.4, 1.6) + even, np.float32)


def two_walls() -> trimesh.Trimesh:
    parts: list[tuple[Vector, Vector]] = [
        ((0.36, 0.36, 0.02), (0, 0, 0.01)),
        ((0.36, 0.02, 0.22), (0, 0.17, 0.13)),
        ((0.02, 0.32, 0.22), (0.17, 0, 0.13)),
    ]
    boxes = [shifted(trimesh.creation.box(size), *at) for size, at in parts]
    return trimesh.util.concatenate([*boxes, ball(0.07, (-0.02, 0.02, 0.09), 4)])


def under_the_sky(folder: Path) -> SceneDocument:
    cv2.imwrite(str(folder / "sky.hdr"), np.ascontiguousarray(sky(latitude_longitude())[..., ::-1]))
    stage = Stage(folder, COARSE)
    document = stage.document([stage.virtual(two_walls(), COLOR)], [], floor())
    given = EnvironmentLights(map=str(folder / "sky.hdr"))
    lights = Lights(mode="environment", environment=given, registration=(1.0, 1.0, 1.0))
    return document.replaced(lights=lights, method=NoneMethod())


def path_traced(document: SceneDocument, pose: BoardPose, folder: Path) -> Float32[np.ndarray, "h w 3"]:
    choose_variant()
    import mitsuba as mi

    (loaded,) = load_mesh(Path(document.objects[0].asset))
    given = trimesh.Trimesh(loaded.positions, loaded.triangles, vertex_normals=loaded.normals, process=False)
    given.export(folder / "object.ply", vertex_normal=True)
    diffuse = {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(COLOR)}}
    sensor = {
        "type": "perspective",
        "fov": float(np.degrees(2 * np.arctan(WIDTH / 2 / FOCAL))),
        "to_world": mi.ScalarTransform4f(pose.world_from_camera @ np.diag([-1.0, -1.0, 1.0, 1.0])),
        "film": {"type": "hdrfilm", "width": WIDTH, "height": HEIGHT, "rfilter": {"type": "box"}},
        "sampler": {"type": "independent", "sample_count": 256},
    }
    scene = {"type": "scene", "integrator": {"type": "path", "max_depth": 12}, "sensor": sensor}
    scene["sky"] = environment_light(sky(latitude_longitude()))
    scene["object"] = {"type": "ply", "filename": str(folder / "object.ply"), "bsdf": diffuse}
    return np.asarray(mi.render(mi.load_dict(scene)))[..., :3]


def shaded(gpu: GpuContext, document: SceneDocument, pose: BoardPose) -> tuple[np.ndarray, np.ndarray]:
    """Radiance, and which pixels show the object alone."""
    view = frame(np.full((HEIGHT, WIDTH, 3), 150, np.uint8), pose=pose, camera=camera(WIDTH, HEIGHT, FOCAL))
    renderer = SceneRenderer(gpu, document)
    renderer.render(view)
    graph = renderer.graph
    assert graph is not None
    name = "image-based radiance" if document.shading.is_image_based else "precomputed radiance"
    radiance = array_of(graph[name])[..., :3]
    pixels = array_of(graph["object surface"].coverage.texture)[..., 0] == 1
    renderer.release()
    return radiance, pixels & with_neighbours(with_neighbours(pixels))


def test_two_walls_and_a_ball_are_lit_as_by_a_path_tracer(gpu: GpuContext, tmp_path: Path) -> None:
    """With DELTALIGHT_SCREENSHOTS, a picture too: the truth, image_based, precomputed with 16 coefficients."""
    document, pose = under_the_sky(tmp_path), look_at((-0.5, -0.7, 0.6), (0.0, 0.0, 0.12))
    truth, error, shown = path_traced(document, pose, tmp_path), {}, []
    for name, settings in SHADINGS.items():
        radiance, pixels = shaded(gpu, document.replaced(shading=Shading(**settings)), pose)
        off = (radiance - truth)[pixels] / truth[pixels].mean()
        error[name] = np.sqrt((off**2).mean())
        shown.append(radiance * pixels[..., None])
        print(f"{name}: r.m.s. {error[name]:.1%}, mean {off.mean():+.1%}")
    if folder := os.environ.get("DELTALIGHT_SCREENSHOTS"):
        row = (
            np.hstack([truth * pixels[..., None], shown[0], shown[2]])
            * 0.9
            / np.percentile(truth[pixels], 99)
        )
        coded = np.round(255 * np.clip(row, 0, 1) ** (1 / 2.2)).astype(np.uint8)
        cv2.imwrite(f"{folder}/precomputed.png", np.ascontiguousarray(coded[..., ::-1]))
    assert error["16 coefficients"] < error["9 coefficients"] < 0.13
    assert error["9 coefficients"] < 0.4 * min(error["image_based"], error["without bounces"])
