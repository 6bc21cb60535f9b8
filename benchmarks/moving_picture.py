"""The moving picture of README: the demo's recording, with and without the object, divided by a line that moves.

python -m deltalight.benchmarks.moving_picture --out docs/images/demo.webp
"""

import argparse
import math
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8
from PIL import Image

import deltalight as dl
from deltalight.services.before_after import divided
from deltalight.services.demo import RECORDING

WIDTH, HEIGHT = 480, 360
PICTURES = 36
PERIOD_MS = 90
QUALITY = 70


def moving_picture(pictures: int) -> list[UInt8[np.ndarray, "h w 3"]]:
    """Renders pictures from the whole recording; the line goes across and back once."""
    take = dl.open(RECORDING)
    assert isinstance(take, dl.Take)
    scene = take.scene
    assert scene is not None
    numbers = np.linspace(0, len(take) - 1, pictures // 2).round().astype(int)
    numbers = np.concatenate([numbers, numbers[::-1]])  # so that it can be repeated without a jump
    shown: dict[int, UInt8[np.ndarray, "h w 3"]] = {}
    made = []
    with dl.Renderer() as renderer:
        for step, number in enumerate(numbers.tolist()):
            frame = take[number]
            if number not in shown:
                shown[number] = renderer.render(frame, scene).color
            divide = 0.5 + 0.42 * math.cos(2 * math.pi * step / len(numbers))
            made.append(divided(_small(frame.color), _small(shown[number]), divide))
    return made


def _small(picture: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h2 w2 3"]:
    return np.asarray(cv2.resize(picture, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA))


def main() -> None:
    """Writes the picture."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="File to write, NAME.webp.")
    parser.add_argument("--pictures", type=int, default=PICTURES, help="How many pictures it has.")
    arguments = parser.parse_args()
    first, *rest = [Image.fromarray(picture) for picture in moving_picture(arguments.pictures)]
    first.save(
        arguments.out,
        save_all=True,
        append_images=rest,
        duration=PERIOD_MS,
        loop=0,
        quality=QUALITY,
        method=6,
    )


if __name__ == "__main__":
    main()
