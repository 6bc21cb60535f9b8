"""The newest fish-eye picture, and the positions of a composite's lights in it."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float64
from pydantic import BaseModel, ConfigDict, Field

from deltalight.protocol.fisheye_lens import calibration_of
from deltalight.protocol.messages import Message, RadianceMessage

if TYPE_CHECKING:
    from deltalight.render_server.lights.light_models import IncidentLight

PICTURE_PART = 2  # of a radiance message (SPEC.md, section 3)
OUTLINE_POINTS = 16
ENVIRONMENT = "environment"  # the light without a direction


@dataclass
class FisheyeView:
    """The newest radiance message and its picture for display (JPEG), if any arrived."""

    newest: tuple[RadianceMessage, bytes] | None = None

    def note(self, message: Message, parts: Sequence[memoryview]) -> None:
        """Stores the picture of a message that has just arrived."""
        assert isinstance(message, RadianceMessage)
        self.newest = message, bytes(parts[PICTURE_PART])


class FisheyeLight(BaseModel):
    """A light of the newest composite, as the fish-eye camera sees it."""

    model_config = ConfigDict(allow_inf_nan=False)

    x: float = Field(description="Position of its centre, in pixels of the picture.")
    y: float
    radius_px: float = Field(description="Greatest distance of its outline from its centre, pixels.")
    color_linear: tuple[float, float, float] = Field(description="Linear RGB; the largest component is 1.")
    irradiance: tuple[float, float, float] = Field(
        description="Irradiance on a surface facing it, camera units."
    )
    type: str = Field(description="As in the scene document.", examples=["sphere"])
    id: int | None = Field(description="Id of a light that is tracked over time; else null.")


def lights_in_picture(message: RadianceMessage, described: Sequence[Mapping[str, Any]]) -> list[FisheyeLight]:
    """Returns the lights that the picture of `message` shows; `described` are those of a composite.

    What no render server describes so is left out: other processes can send composites too.

    Raises:
        DeltalightError: the calibration is invalid.
    """
    found = []
    for each in described:
        with suppress(KeyError, TypeError, ValueError, ArithmeticError), np.errstate(all="ignore"):
            found += _shown(message, each)
    return found


def _shown(message: RadianceMessage, described: Mapping[str, Any]) -> list[FisheyeLight]:
    """Returns a light, or nothing where the picture does not show it."""
    from deltalight.render_server.lights.light_models import LIGHT_TYPES, incident_light

    if described.get("type") == ENVIRONMENT:
        return []
    viewpoint = np.array(message.world_from_fisheye)[:3, 3]
    seen = incident_light(LIGHT_TYPES[described["type"]].from_values(described), viewpoint)
    pixels = _pixels(message, np.vstack([seen.to_light, _outline(seen)]))
    return [_marked(described, seen, pixels)] if np.isfinite(pixels[0]).all() else []


def _marked(
    described: Mapping[str, Any], seen: "IncidentLight", pixels: Float64[np.ndarray, "n 2"]
) -> FisheyeLight:
    """Describes a light; `pixels` begin with its middle, and are NaN where the picture does not show its outline."""
    distances = np.linalg.norm(pixels - pixels[0], axis=1)
    red, green, blue = (float(value) for value in seen.irradiance)
    peak = max(red, green, blue, 1e-12)
    return FisheyeLight(
        x=float(pixels[0, 0]),
        y=float(pixels[0, 1]),
        radius_px=float(np.nanmax(distances)),
        color_linear=(red / peak, green / peak, blue / peak),
        irradiance=(red, green, blue),
        type=str(described["type"]),
        id=described.get("id"),
    )


def _pixels(message: RadianceMessage, directions: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 2"]:
    """Projects directions in the world to pixels of the (scaled-down) picture; NaN outside it."""
    lens = calibration_of(message.camera, None).lens
    height, width = message.picture_shape[:2]
    stretch = np.array([width / lens.width, height / lens.height])
    rotation = np.array(message.world_from_fisheye)[:3, :3]
    return np.asarray((lens.project(directions @ rotation) + 0.5) * stretch - 0.5)


def _outline(seen: "IncidentLight") -> Float64[np.ndarray, "n 3"]:
    """Returns directions around a light, at its angular radius."""
    direction = seen.to_light
    side = np.cross(direction, (0.0, 0.0, 1.0) if abs(direction[2]) < 0.9 else (1.0, 0.0, 0.0))
    side /= np.linalg.norm(side)
    turn = np.linspace(0, 2 * np.pi, OUTLINE_POINTS, endpoint=False)[:, None]
    around = np.cos(turn) * side + np.sin(turn) * np.cross(direction, side)
    angle = seen.angular_radius_rad
    return np.asarray(np.cos(angle) * direction + np.sin(angle) * around)
