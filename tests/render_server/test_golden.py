"""Composites against stored ones, made on the software renderer.

`DELTALIGHT_REGENERATE_GOLDENS=1 pytest tests/render_server/test_golden.py` writes them anew: look at the pictures,
and at what changed, before they are committed.
"""

import json
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from deltalight.protocol.frames import ViewFrame
from deltalight.protocol.scene import SceneDocument
from deltalight.render_server.gpu.context import GpuContext
from tests.render_server.scenes import (
    Stage,
    ambient,
    ball,
    checkered,
    composite,
    cube,
    depth_image,
    directional,
    everyday,
    floor_depth,
    frame,
    look_at,
    plain,
    psnr_db,
)

pytestmark = pytest.mark.usefixtures("clean_gl")
FOLDER = Path(__file__).with_name("goldens")
MADE_WITH = FOLDER / "made_with.json"
REGENERATE = os.environ.get("DELTALIGHT_REGENERATE_GOLDENS") == "1"
LEAST_PSNR_DB = 50.0  # another CPU class changes the last bits


def on_given_model(stage: Stage) -> tuple[SceneDocument, ViewFrame]:
    return everyday(stage), frame(plain())


def on_depth(stage: Stage) -> tuple[SceneDocument, ViewFrame]:
    """A metal ball and a cube on a chequered floor under a low sun; the depth map has a hole."""
    metal = {"metallic": 1.0, "roughness": 0.3}
    objects = [
        stage.virtual(ball(0.08, (-0.05, 0, 0.08)), (0.9, 0.8, 0.6), metal, id="ball"),
        stage.virtual(cube(0.1, (0.14, 0.02, 0)), (0.15, 0.3, 0.8), id="cube"),
    ]
    lights = [directional((-0.6, 0.5, -0.8), 1.5, 2.0), ambient(0.2)]
    depth = floor_depth(look_at())
    depth[70:85, 30:60] = 0
    return stage.document(objects, lights, volume_edge_m=0.7), frame(checkered(), depth=depth_image(depth))


SCENES: dict[str, Callable[[Stage], tuple[SceneDocument, ViewFrame]]] = {
    "given_model": on_given_model,
    "depth": on_depth,
}


@pytest.mark.parametrize("name", SCENES)
def test_composite_is_the_stored_one(gpu: GpuContext, tmp_path: Path, name: str) -> None:
    if "llvmpipe" not in gpu.renderer_name:
        pytest.skip(f"the goldens are llvmpipe's, this is {gpu.renderer_name}")
    picture = composite(gpu, *SCENES[name](Stage(tmp_path)))
    path = FOLDER / f"{name}.png"
    if REGENERATE:
        FOLDER.mkdir(exist_ok=True)
        Image.fromarray(picture).save(path, optimize=True)
        made_with = {"renderer": gpu.renderer_name, "version": gpu.version}
        MADE_WITH.write_text(json.dumps(made_with, indent=2) + "\n")
    golden = np.asarray(Image.open(path))
    found = psnr_db(picture, golden)
    changed = (picture != golden).any(axis=-1)
    made_with = json.loads(MADE_WITH.read_text())
    assert found > LEAST_PSNR_DB, (
        f"{found:.1f} dB, {np.count_nonzero(changed)} pixels differ; "
        f"the golden is of {made_with}, this is {gpu.version}"
    )


def test_goldens_are_small_and_say_what_made_them() -> None:
    pictures = [path for path in FOLDER.glob("*.png") if not path.name.startswith("protected_")]
    assert {path.stem for path in pictures} == set(SCENES)
    assert all(path.stat().st_size < 50_000 for path in pictures)
    assert set(json.loads(MADE_WITH.read_text())) == {"renderer", "version"}
