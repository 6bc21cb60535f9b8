"""Things with known mattes before a background, hair and a hand, as a colour camera and a depth camera see them."""

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from deltalight.protocol.frames import DepthImage, ViewFrame, decode_lut
from deltalight.sensor_node.depth import DepthSettings, clean_depth
from tests.render_server.scenes import HEIGHT, WIDTH, depth_image, frame

OVERSAMPLING = 8
NEAR_M, FAR_M = 0.5, 3.0  # of the thing and the background; objects stand between
SENSOR_NOISE = 0.004  # of sensor white
RIM_PX = 4  # within which stereo gives no depth
HAIR, SKIN = (0.10, 0.06, 0.035), (0.45, 0.27, 0.19)
PATTERNS = ("plain", "wood", "checks")


@dataclass(frozen=True)
class Thing:
    """`alpha` (h, w): the thing's true fraction; `front`, `back` (h, w, 3): linear colours of thing and background.

    `color` (h, w, 3; uint8) is the camera's picture, `depth` what the node makes of a depth camera that sees no hair,
    an outline that is off by a pixel (r.m.s.), and nothing within four pixels of it.
    """

    alpha: np.ndarray
    front: np.ndarray
    back: np.ndarray
    color: np.ndarray
    depth: DepthImage

    def view(self, **changes: Any) -> ViewFrame:  # noqa: ANN401
        return frame(self.color, depth=self.depth, **changes)

    def again(self, seed: int) -> "Thing":
        """The next picture: the colour camera has other noise; depth is as it was."""
        linear = self.alpha[..., None] * self.front + (1 - self.alpha[..., None]) * self.back
        return replace(self, color=_exposed(linear, np.random.default_rng(seed)))

    @property
    def by_depth(self) -> np.ndarray:
        """Where depth shows the thing."""
        return np.asarray(self.depth.valid & (self.depth.depth_m < (NEAR_M + FAR_M) / 2))

    def band(self, reach_px: int) -> np.ndarray:
        """Pixels within reach of the thing by depth, but for those well inside of it."""
        near = cv2.dilate(self.by_depth.astype(np.uint8), np.ones((2 * reach_px + 1,) * 2))
        inside = cv2.erode(self.by_depth.astype(np.uint8), np.ones((5, 5)))
        return (near > 0) & (inside == 0)


def hairy_head(pattern: str, seed: int = 0) -> Thing:
    """A head with 100 hairs, 0.3 to 1.6 pixels wide and up to 10 long beyond its outline, before `pattern`."""
    random = np.random.default_rng(seed)
    return _before(pattern, _head(random), HAIR, random)


def hand(pattern: str, seed: int = 0, aside_px: int = 0) -> Thing:
    """A hand whose four fingers are 9 pixels wide, with gaps of 6, before `pattern`, moved to the right."""
    picture = np.zeros((HEIGHT * OVERSAMPLING, WIDTH * OVERSAMPLING), np.uint8)
    left, top, right, bottom = np.array([50 + aside_px, 75, 106 + aside_px, HEIGHT]) * OVERSAMPLING
    picture[top:bottom, left : right + 1] = 255
    for finger in range(4):
        root, tip = 55 + 15 * finger + aside_px, 53 + 17 * finger + aside_px
        ends = np.array([[root, 80], [tip, 30 + 5 * abs(finger - 1)]])
        cv2.polylines(picture, [ends * OVERSAMPLING], False, 255, 9 * OVERSAMPLING)
    return _before(pattern, _averaged(picture), SKIN, np.random.default_rng(seed))


def _before(
    pattern: str, alpha: np.ndarray, color_linear: tuple[float, float, float], random: np.random.Generator
) -> Thing:
    front = np.array(color_linear) * (1 + _smooth(random, 2.0, 0.25))[..., None]
    back = _background(pattern, random)
    linear = alpha[..., None] * front + (1 - alpha[..., None]) * back
    color = _exposed(linear, random)
    depth = clean_depth(depth_image(_depth(alpha, random)), color, DepthSettings())
    return Thing(alpha, front, back, color, depth)


def _exposed(linear: np.ndarray, random: np.random.Generator) -> np.ndarray:
    linear = np.clip(linear + SENSOR_NOISE * random.standard_normal(linear.shape), 0, 1)
    lut = decode_lut(None)[:, 0]
    return np.searchsorted((lut[1:] + lut[:-1]) / 2, linear).astype(np.uint8)


def _head(random: np.random.Generator) -> np.ndarray:
    picture = np.zeros((HEIGHT * OVERSAMPLING, WIDTH * OVERSAMPLING), np.uint8)
    middle, radius = np.array([80.0, 68.0]), 34.0
    _draw_disc(picture, middle, radius)
    for _ in range(100):
        angle = random.uniform(-np.pi, 0)
        outward, lean = np.array([np.cos(angle), np.sin(angle)]), random.normal(0, 0.5)
        turned = np.array([np.cos(angle + lean), np.sin(angle + lean)])
        root = middle + 0.95 * radius * outward
        ends = np.stack([root, root + random.uniform(4, 12) * turned])
        places = np.rint(ends * OVERSAMPLING).astype(np.int32)
        cv2.polylines(picture, [places], False, 255, max(1, round(random.uniform(0.3, 1.6) * OVERSAMPLING)))
    return _averaged(picture)


def _averaged(picture: np.ndarray) -> np.ndarray:
    return cv2.resize(picture.astype(np.float32) / 255, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)


def _draw_disc(picture: np.ndarray, middle: np.ndarray, radius: float) -> None:
    x, y = (int(value) for value in np.rint(middle * OVERSAMPLING))
    cv2.circle(picture, (x, y), round(radius * OVERSAMPLING), 255, -1)


def _smooth(random: np.random.Generator, sigma_px: float, deviation: float) -> np.ndarray:
    noise = cv2.GaussianBlur(random.standard_normal((HEIGHT, WIDTH)), (0, 0), sigma_px)
    return np.asarray(deviation * noise / noise.std())


def _background(pattern: str, random: np.random.Generator) -> np.ndarray:
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    if pattern == "plain":
        return np.tile([0.45, 0.42, 0.35], (HEIGHT, WIDTH, 1))
    if pattern == "wood":
        grain = 0.25 * np.sin(x / 3.1 + _smooth(random, 6.0, 1.0)) + _smooth(random, 1.5, 0.1)
        return np.asarray(np.array([0.40, 0.26, 0.14]) * (1 + grain)[..., None])
    light = (x // 9 + y // 9) % 2 > 0
    squares = np.where(light[..., None], [0.6, 0.58, 0.5], [0.2, 0.25, 0.4])
    return np.asarray(squares * (1 + _smooth(random, 1.0, 0.05))[..., None])


def _depth(alpha: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """An opening takes the hair off, as the windows of stereo do."""
    ellipse = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (7, 7))
    seen = cv2.morphologyEx((alpha > 0.5).astype(np.uint8), cv2.MORPH_OPEN, ellipse)
    inside = cv2.distanceTransform(seen, cv2.DIST_L2, 5) - cv2.distanceTransform(1 - seen, cv2.DIST_L2, 5)
    off = inside + _smooth(random, 2.0, 1.0)
    depth = np.where(off > 0.5, NEAR_M, FAR_M)
    depth = depth + 0.001 * depth**2 * random.standard_normal(depth.shape)
    return np.where(np.abs(off) < RIM_PX, 0, depth).astype(np.float32)
