"""The lights of the scene document (docs/formats.md 3); radiometry in camera units (docs/method.md 1)."""

from collections.abc import Mapping
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import ConfigDict, Discriminator, Field, Tag, model_validator

from deltalight.protocol.documents import StrictModel
from deltalight.protocol.scene_fields import (
    ASSET_TEXT,
    Asset,
    Direction,
    Fraction,
    LightCount,
    NonNegative,
    PeakThreshold,
    Point,
    Radiance,
    SmoothingTime,
    SplitKind,
)

DEFAULT_LIGHT_TYPE = "sphere"
# Without `type` a light is a sphere; the other kinds require the key, so that a document matches one kind only.
NEEDS_TYPE = ConfigDict(json_schema_extra={"required": ["type"]})
Factor = Annotated[float, Field(gt=0, le=1e6)]


class _Light(StrictModel):
    color_linear: Radiance = Field(
        default=(1.0, 1.0, 1.0), description="Linear RGB colour that multiplies the strength."
    )


class DirectionalLight(_Light):
    """A distant light such as the sun."""

    model_config = NEEDS_TYPE

    type: Literal["directional"] = "directional"
    direction: Direction = Field(
        default=(0.0, 0.0, -1.0), description="Direction in which the light travels, world axes; normalised."
    )
    irradiance: NonNegative = Field(
        default=1.0, description="Irradiance perpendicular to the beam, camera units."
    )
    angular_radius_deg: float = Field(
        default=0.5, ge=0, le=90, description="Angular radius of the light, degrees (the sun's is 0.27)."
    )


class SphereLight(_Light):
    """A lamp that shines equally in all directions."""

    type: Literal["sphere"] = "sphere"
    position_m: Point = Field(default=(0.0, 0.0, 1.0), description="Centre, world, metres.")
    intensity: NonNegative = Field(
        default=1.0, description="Intensity, camera units times square metres: E = I cos/d^2."
    )
    radius_m: float = Field(
        default=0.05, ge=0, le=100, description="Radius of the lamp, metres; 0 = a point light."
    )


class SpotLight(_Light):
    """A lamp that shines into a cone: evenly inside, then falling linearly with the angle from the axis to zero."""

    model_config = NEEDS_TYPE

    type: Literal["spot"] = "spot"
    position_m: Point = Field(default=(0.0, 0.0, 1.0), description="Centre, world, metres.")
    intensity: NonNegative = Field(
        default=1.0, description="Intensity on the axis, camera units times square metres."
    )
    radius_m: float = Field(
        default=0.05, ge=0, le=100, description="Radius of the lamp, metres; 0 = a point light."
    )
    direction: Direction = Field(
        default=(0.0, 0.0, -1.0),
        description="Axis of the cone, in the direction in which the light travels; normalised.",
    )
    angle_deg: float = Field(
        default=60.0,
        gt=0,
        lt=180,
        description="Full opening angle of the cone, degrees; there is no light outside.",
    )
    blend: Fraction = Field(
        default=0.15,
        description="Fraction of the half angle, at its outer end, over which the light falls to zero, 0..1.",
    )


class RectangleLight(_Light):
    """A diffuse area light around position_m; it shines to the side of axis_u x axis_v alone."""

    model_config = NEEDS_TYPE

    type: Literal["rectangle"] = "rectangle"
    position_m: Point = Field(default=(0.0, 0.0, 1.0), description="Centre, world, metres.")
    axis_u_m: Point = Field(
        default=(0.5, 0.0, 0.0), description="First edge at full length, world axes, metres."
    )
    axis_v_m: Point = Field(
        default=(0.0, -0.5, 0.0), description="Second edge at full length, world axes, metres."
    )
    radiance: NonNegative = Field(default=1.0, description="Radiance of the emitting side, camera units.")

    @model_validator(mode="after")
    def _check(self) -> Self:
        if np.linalg.norm(np.cross(self.axis_u_m, self.axis_v_m)) < 1e-9:
            raise ValueError("axis_u_m and axis_v_m must span an area")
        return self


class AmbientLight(_Light):
    """The same radiance from every direction."""

    model_config = NEEDS_TYPE

    type: Literal["ambient"] = "ambient"
    radiance: NonNegative = Field(default=0.1, description="Radiance from every direction, camera units.")


def _light_type(value: Any) -> Any:  # noqa: ANN401 - whatever the document holds
    if isinstance(value, Mapping):
        return value.get("type", DEFAULT_LIGHT_TYPE)
    return getattr(value, "type", DEFAULT_LIGHT_TYPE)


LIGHT_TYPES: dict[str, type[StrictModel]] = {
    "directional": DirectionalLight,
    "sphere": SphereLight,
    "spot": SpotLight,
    "rectangle": RectangleLight,
    "ambient": AmbientLight,
}
ManualLight = Annotated[
    Annotated[DirectionalLight, Tag("directional")]
    | Annotated[SphereLight, Tag("sphere")]
    | Annotated[SpotLight, Tag("spot")]
    | Annotated[RectangleLight, Tag("rectangle")]
    | Annotated[AmbientLight, Tag("ambient")],
    Discriminator(_light_type),
]


def _registration_kind(value: Any) -> str:  # noqa: ANN401 - whatever the document holds
    return "auto" if isinstance(value, str) else "factors"


Registration = Annotated[
    Annotated[Literal["auto"], Tag("auto")] | Annotated[tuple[Factor, Factor, Factor], Tag("factors")],
    Discriminator(_registration_kind),
]


def _distance_kind(value: Any) -> str:  # noqa: ANN401 - whatever the document holds
    return "word" if isinstance(value, str) else "metres"


Distance = Annotated[
    Annotated[Literal["auto", "far"], Tag("word")] | Annotated[float, Field(gt=0, le=1000), Tag("metres")],
    Discriminator(_distance_kind),
]


class LightCut(StrictModel):
    """How a map of radiance is cut into lights, and how fast they follow it (docs/method.md 2)."""

    count: LightCount = Field(default=4, description="Number of lights.")
    split: SplitKind = Field(
        default="peaks",
        description="Extract only lights that outshine their surroundings, or (as in the papers) split the whole "
        "map into lights.",
    )
    threshold: PeakThreshold = Field(
        default=4.0,
        description="Luminance above which a light is extracted, as a multiple of the map's mean (split peaks).",
    )
    smoothing_s: SmoothingTime = Field(
        default=0.5,
        description="Time constant with which lights follow the fish-eye picture, seconds; 0 = at once.",
    )


class FisheyeLights(LightCut):
    """How lights are taken from the fish-eye picture (docs/method.md 2); environment maps are split alike."""

    distance_m: Distance = Field(
        default="auto",
        description="Distance of the lights from the fish-eye camera, metres; `far` = distant like the sun; "
        "`auto` = from the falloff of light over the board's paper and from shading and shadows, which may tell "
        "each lamp's own; far if neither tells.",
    )

    @property
    def cut(self) -> LightCut:
        """The settings that a sensor node has, too."""
        return LightCut(**self.model_dump(exclude={"distance_m"}))


class TrackedLamp(_Light):
    """A lamp with a marker on it: a sphere light that moves with the marker."""

    marker: int = Field(ge=0, description="Id of the lamp's marker, one of the `lamp_markers` in board.yaml.")
    offset_m: Point = Field(
        default=(0.0, 0.0, 0.0),
        description="Position of the bulb in the marker's frame, metres: +x right, +y up the marker, +z out of "
        "it.",
    )
    intensity: NonNegative = Field(
        default=1.0, description="Intensity, camera units times square metres: E = I cos/d^2."
    )
    radius_m: float = Field(
        default=0.05, ge=0, le=100, description="Radius of the lamp, metres; 0 = a point light."
    )


class EnvironmentLights(StrictModel):
    """A given environment map (latitude-longitude, linear)."""

    map: Asset | None = Field(default=None, description=f"Radiance map: {ASSET_TEXT}")
    up: Direction = Field(default=(0.0, 0.0, 1.0), description="The map's up axis in world axes; normalised.")
    rotation_deg: float = Field(
        default=0.0, ge=-360, le=360, description="Rotation of the map about its up axis, degrees."
    )
    intensity: NonNegative = Field(default=1.0, description="Factor that multiplies the map's radiance.")


class Lights(StrictModel):
    """Where light comes from."""

    mode: Literal["fisheye", "tracked", "manual", "environment"] = "manual"
    manual: tuple[ManualLight, ...] = Field(
        default=(), max_length=64, fail_fast=True, description="Lights of mode `manual`."
    )
    fisheye: FisheyeLights = Field(default_factory=FisheyeLights)
    tracked: tuple[TrackedLamp, ...] = Field(
        default=(), max_length=16, fail_fast=True, description="Lamps of mode `tracked`."
    )
    environment: EnvironmentLights = Field(default_factory=EnvironmentLights)
    registration: Registration | None = Field(
        default=None,
        description="RGB factor on all lights, or `auto` = estimated from the picture; null = auto for fisheye "
        "and environment, 1 1 1 for manual and tracked.",
    )
    surroundings: Literal["auto", "none"] = Field(
        default="auto",
        description="Modes manual and tracked: light from surroundings that are neither in the picture nor set as "
        "lights. `auto` continues walls, table and floor beyond the picture and fills the rest with "
        "the mean of the visible ground and, above the horizon, of what is visible there; its "
        "strength comes from the board's paper if board.yaml gives white_albedo. `none` = no such "
        "light.",
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.mode == "environment" and self.environment.map is None:
            raise ValueError("mode environment needs environment.map, the asset of a radiance map")
        if self.mode == "tracked" and not self.tracked:
            raise ValueError("mode tracked needs tracked, a list of lamps with the markers that they carry")
        markers = [lamp.marker for lamp in self.tracked]
        if len(set(markers)) < len(markers):
            raise ValueError("tracked names a marker twice; each lamp needs a marker of its own")
        return self

    @property
    def resolved_registration(self) -> Literal["auto"] | tuple[float, float, float]:
        """Registration as given, or the default of the mode."""
        if self.registration is not None:
            return self.registration
        return "auto" if self.mode in ("fisheye", "environment") else (1.0, 1.0, 1.0)


def default_lights() -> Lights:
    """Returns the default lights: one from above and weak ambient light."""
    above = DirectionalLight(direction=(0.3, 0.2, -1.0), irradiance=1.5, angular_radius_deg=5.0)
    return Lights(manual=(above, AmbientLight(radiance=0.2)))
