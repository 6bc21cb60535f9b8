"""Plates of glTF files as a camera above sees them."""

from typing import Any

import numpy as np

from deltalight.benchmarks.gltf_plate import Plate
from deltalight.protocol.frames import ViewFrame
from tests.render_server.scenes import FOCAL, HEIGHT, WIDTH, depth_image, frame, look_at, noisy

PIXEL = 1.0 / FOCAL  # m that a pixel spans at 1 m
WIDE, HIGH = 80, 64  # pixels of the plates
INSIDE = np.s_[HEIGHT // 2 - 24 : HEIGHT // 2 + 24, WIDTH // 2 - 32 : WIDTH // 2 + 32]
CENTRE = np.s_[HEIGHT // 2 - 16 : HEIGHT // 2 + 16, WIDTH // 2 - 16 : WIDTH // 2 + 16]
LEFT, RIGHT = np.s_[40:80, 50:70], np.s_[40:80, 90:110]
UPPER, LOWER = np.s_[35:50, 50:110], np.s_[70:85, 50:110]


def seen_from_above() -> ViewFrame:
    """A camera 1 m above the origin that looks down on a floor far below."""
    depth = depth_image(np.full((HEIGHT, WIDTH), 3.0, np.float32))
    return frame(noisy(), pose=look_at((0.0, 0.0, 1.0), (0.0, 0.0, 0.0)), depth=depth)


def plate(**options: Any) -> Plate:  # noqa: ANN401
    return Plate(WIDE * PIXEL, HIGH * PIXEL, **options)
