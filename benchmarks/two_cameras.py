"""One room as two cameras see it: the synthetic scene from two sides, with the demo's object in its light.

python -m deltalight.benchmarks.two_cameras --out docs/images/two_cameras.jpg
"""

import argparse
import math
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from deltalight.benchmarks.speed.measure import opened, rendering
from deltalight.protocol.files import write_bytes
from deltalight.protocol.frames import ViewFrame
from deltalight.protocol.scene import SceneDocument
from deltalight.sensor_node.cameras.synthetic import FRAMES_PER_ROUND, SyntheticCamera
from deltalight.sensor_node.cameras.synthetic_scene import AMBIENT_IRRADIANCE, LAMP_IRRADIANCE, TO_LAMP
from deltalight.sensor_node.view_frames import ViewFrameBuilder
from deltalight.services.demo import demo_scene

STEPS = (
    FRAMES_PER_ROUND // 4,
    3 * FRAMES_PER_ROUND // 4,
)  # of the camera's way: its two ends, 57 degrees apart
PLACE_M = (0.28, 0.05, 0.0)
LAMP = {"type": "directional", "direction": [float(-each) for each in TO_LAMP], "irradiance": LAMP_IRRADIANCE}
AMBIENT = {"type": "ambient", "radiance": AMBIENT_IRRADIANCE / math.pi}
QUALITY = 88
GAP_PX = 8


def room() -> tuple[SceneDocument, list[ViewFrame]]:
    """Returns the scene document, and a frame of each camera."""
    camera = SyntheticCamera()
    build = ViewFrameBuilder(camera)
    demo = demo_scene("dvct")
    thing = demo.objects[0]
    moved = thing.replaced(pose=thing.pose.replaced(translation_m=PLACE_M))
    scene = demo.replaced(objects=(moved,), lights={"mode": "manual", "manual": [LAMP, AMBIENT]})
    return scene, [build(camera.frame_at(step)) for step in STEPS]


def pictures() -> list[UInt8[np.ndarray, "h w 3"]]:
    """Renders the pictures of both cameras by one call, once for what is learnt of the light and once to show."""
    scene, frames = room()
    with opened(None) as gpu, rendering(gpu, scene) as renderer:
        renderer.render_views(frames)
        return [each.color for each in renderer.render_views(frames)]


def main() -> None:
    """Writes the picture."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="File to write, NAME.jpg.")
    out: Path = parser.parse_args().out
    left, right = pictures()
    gap = np.full((left.shape[0], GAP_PX, 3), 255, np.uint8)
    joined = np.hstack([left, gap, right])[..., ::-1]
    write_bytes(out, cv2.imencode(".jpg", joined, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1].tobytes())


if __name__ == "__main__":
    main()
