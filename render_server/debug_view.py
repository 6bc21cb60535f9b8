"""Debug view `lights`: lights drawn over the fish-eye picture, or over the camera's if there is none."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float64, Int32, UInt8

from deltalight.protocol.frames import LUMINANCE, RadianceMap, ViewFrame
from deltalight.protocol.hemisphere import hemisphere_direction
from deltalight.protocol.sky_lights import Region
from deltalight.render_server.lights.light_models import IncidentLight, incident_light
from deltalight.render_server.lights.lights import LightSet
from deltalight.render_server.lights.octahedral import solid_angle_mean

OUTLINE_POINTS = 24  # per edge of a region: a lens bends straight lines
MIN_RADIUS_RAD = float(np.radians(1.0))  # smaller lights are drawn at this radius, to stay visible
MIN_STRENGTH = 0.35  # brightness of the weakest light, so that it stays visible
REGION_COLOR = (255, 210, 60)
TEXT_COLOR = (255, 255, 255)
SHIFT = 4  # fractional bits of cv2's fixed-point coordinates
FAR_PX = 20000.0  # such coordinates overflow beyond this

Project = Callable[[Float64[np.ndarray, "n 3"]], Float64[np.ndarray, "n 2"]]


@dataclass(frozen=True, eq=False)
class _Canvas:
    """A picture to draw on.

    `project` maps directions (world) from `viewpoint` to pixels, NaN where they are not visible.
    """

    picture: UInt8[np.ndarray, "h w 3"]
    viewpoint: Float64[np.ndarray, "3"]
    project: Project

    @property
    def unit(self) -> float:
        """Scale of text and lines: 1 for a picture 480 pixels high."""
        return max(0.5, float(self.picture.shape[0] / 480))

    def line(
        self, directions: Float64[np.ndarray, "n 3"], color: tuple[int, ...], width: float, *, closed: bool
    ) -> None:
        """Draws a polyline through directions, with gaps where they leave the picture."""
        pixels = self.project(directions)
        if closed:
            pixels = np.concatenate([pixels, pixels[:1]])
        shown = np.isfinite(pixels).all(axis=1) & (np.abs(np.nan_to_num(pixels)) < FAR_PX).all(axis=1)
        pieces = np.split(np.arange(len(pixels)), np.flatnonzero(np.diff(shown.astype(int))) + 1)
        lines = [_fixed(pixels[piece]) for piece in pieces if shown[piece[0]] and len(piece) > 1]
        thickness = max(1, round(width * self.unit))
        cv2.polylines(self.picture, lines, False, color, thickness, cv2.LINE_AA, SHIFT)

    def text(self, words: str, at: tuple[int, int], color: tuple[int, ...] = TEXT_COLOR) -> None:
        """Writes text with its lower left corner at a pixel, outlined in black to stay readable."""
        scale, thickness = 0.45 * self.unit, max(1, round(self.unit))
        places = [(at[0] + x, at[1] + y) for x in (-1, 1) for y in (-1, 1)]
        for place, ink in [*((place, (0, 0, 0)) for place in places), (at, color)]:
            cv2.putText(
                self.picture, words, place, cv2.FONT_HERSHEY_SIMPLEX, scale, ink, thickness, cv2.LINE_AA
            )


def draw_lights(frame: ViewFrame, lights: LightSet, regions: Sequence[Region]) -> UInt8[np.ndarray, "h w 3"]:
    """Draws lights as discs of their size and colour, with number and irradiance, at the frame's size.

    Draws on the frame's fish-eye picture if it has one, letterboxed, with the outlines of the `regions` of
    its map.
    """
    fisheye = frame.radiance_map
    canvas = _camera_canvas(frame) if fisheye is None else _fisheye_canvas(frame, fisheye)
    seen = [incident_light(light, canvas.viewpoint) for light in lights.lights]
    strongest = max((float(light.irradiance.max()) for light in seen), default=1.0)
    colors = [_color(light, strongest) for light in seen]
    for light, color in zip(seen, colors, strict=True):
        _draw_disc(canvas, light, color)
    if fisheye is not None:
        for region in regions:
            canvas.line(_outline(region, fisheye), REGION_COLOR, 1, closed=True)
    names = lights.identities or tuple(range(1, len(seen) + 1))
    for row, (light, name, color) in enumerate(zip(seen, names, colors, strict=True), start=1):
        where = "" if _draw_centre(canvas, light, f"{name}", color) else ", out of view"
        words = f"{name}: irradiance {float(light.irradiance @ LUMINANCE):.2f}{where}"
        canvas.text(words, (round(8 * canvas.unit), round(18 * row * canvas.unit)), color)
    words = f"elsewhere: mean radiance {float(solid_angle_mean(lights.environment) @ LUMINANCE):.2g}"
    if fisheye is not None and fisheye.clipped_share > 0:
        words += f"; {100 * fisheye.clipped_share:.1f} % clipped"
    canvas.text(words, (round(8 * canvas.unit), canvas.picture.shape[0] - round(8 * canvas.unit)))
    return canvas.picture


def _color(light: IncidentLight, strongest: float) -> tuple[int, ...]:
    """Returns the light's colour, darker for weaker lights."""
    peak = max(float(light.irradiance.max()), 1e-12)
    strength = MIN_STRENGTH + (1 - MIN_STRENGTH) * min(peak / max(strongest, 1e-12), 1.0)
    return tuple(
        int(v) for v in np.rint(255 * strength * np.clip(light.irradiance / peak, 0, 1) ** (1 / 2.2))
    )


def _draw_disc(canvas: _Canvas, light: IncidentLight, color: tuple[int, ...]) -> None:
    circle = _circle(light.to_light, max(float(light.angular_radius_rad), MIN_RADIUS_RAD))
    canvas.line(circle, (0, 0, 0), 4, closed=True)
    canvas.line(circle, color, 2, closed=True)


def _draw_centre(canvas: _Canvas, light: IncidentLight, name: str, color: tuple[int, ...]) -> bool:
    """Marks the centre of a light; returns whether it is inside the picture."""
    centre = canvas.project(light.to_light[None])[0]
    height, width = canvas.picture.shape[:2]
    if not (np.isfinite(centre).all() and (centre >= 0).all() and (centre < (width, height)).all()):
        return False
    arm, (x, y) = round(7 * canvas.unit), (round(float(v)) for v in centre)
    for ink, thickness in ((0, 0, 0), 3), (color, 1):
        cv2.drawMarker(
            canvas.picture, (x, y), ink, cv2.MARKER_CROSS, arm, round(thickness * canvas.unit) or 1
        )
    canvas.text(name, (x + arm // 2, y - arm // 2), TEXT_COLOR)
    return True


def _fisheye_canvas(frame: ViewFrame, seen: RadianceMap) -> _Canvas:
    """Fits the fish-eye picture into the frame's size, on black."""
    width, height = frame.camera.width, frame.camera.height
    rows, columns = seen.picture.shape[:2]
    scale = min(width / columns, height / rows)
    size = (round(columns * scale), round(rows * scale))
    left, top = (width - size[0]) // 2, (height - size[1]) // 2
    picture = np.zeros((height, width, 3), np.uint8)
    method = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    picture[top : top + size[1], left : left + size[0]] = cv2.resize(seen.picture, size, interpolation=method)
    lens = seen.calibration.lens
    stretch = np.array([size[0] / lens.width, size[1] / lens.height])
    rotation = seen.world_from_fisheye[:3, :3]

    def project(directions: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 2"]:
        return np.asarray((lens.project(directions @ rotation) + 0.5) * stretch - 0.5 + (left, top))

    return _Canvas(picture, np.asarray(seen.world_from_fisheye[:3, 3]), project)


def _camera_canvas(frame: ViewFrame) -> _Canvas:
    assert frame.pose is not None  # the renderer passes frames without a pose through
    matrix = frame.pose.world_from_camera
    return _Canvas(
        frame.color.copy(),
        np.asarray(matrix[:3, 3]),
        lambda directions: frame.camera.project(directions @ matrix[:3, :3]),
    )


def _outline(region: Region, seen: RadianceMap) -> Float64[np.ndarray, "n 3"]:
    """Returns directions (world) along the edges of a region."""
    size = len(seen.radiance)
    low, high = np.array([region.left, region.top]) / size, np.array([region.right, region.bottom]) / size
    corners = np.array([low, (high[0], low[1]), high, (low[0], high[1])])
    along = np.linspace(0, 1, OUTLINE_POINTS, endpoint=False)[:, None]
    edges = [
        start + along * (end - start)
        for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True)
    ]
    return np.asarray(hemisphere_direction(np.concatenate(edges)) @ seen.world_from_fisheye[:3, :3].T)


def _circle(to_light: Float64[np.ndarray, "3"], radius_rad: float) -> Float64[np.ndarray, "n 3"]:
    """Returns directions on a circle of that angular radius around a light."""
    side = np.cross(to_light, (0.0, 0.0, 1.0) if abs(to_light[2]) < 0.9 else (1.0, 0.0, 0.0))
    side /= np.linalg.norm(side)
    turn = np.linspace(0, 2 * np.pi, 4 * OUTLINE_POINTS, endpoint=False)[:, None]
    around = np.cos(turn) * side + np.sin(turn) * np.cross(to_light, side)
    return np.asarray(np.cos(radius_rad) * to_light + np.sin(radius_rad) * around)


def _fixed(pixels: Float64[np.ndarray, "n 2"]) -> Int32[np.ndarray, "n 2"]:
    return np.asarray(np.rint(pixels * (1 << SHIFT)), np.int32)
