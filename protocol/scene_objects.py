"""The parts of the scene document that hold geometry and materials: `objects` and `real` (docs/formats.md 3)."""

from functools import lru_cache
from pathlib import PurePosixPath
from typing import Annotated, Any, Literal, Self

import numpy as np
from jaxtyping import Float64
from pydantic import AfterValidator, BeforeValidator, Discriminator, Field, Tag, model_validator

from deltalight.protocol.documents import StrictModel
from deltalight.protocol.poses import rigid_matrix, rotation_from_wxyz
from deltalight.protocol.scene_fields import (
    ASSET_TEXT,
    Asset,
    Colour,
    Coordinate,
    Direction,
    Fraction,
    Point,
    Quaternion,
    Radiance,
    Text,
    without_nul,
)

SheetEdge = Annotated[float, Field(gt=0, le=100)]
GLTF_SUFFIXES = (".gltf", ".glb")
MESH_SUFFIXES = (".glb", ".gltf", ".obj", ".ply", ".stl")
ASSETS_KEPT = 256  # whose names were looked at
# Rotates an asset whose y is up so that its z is up: +90 degrees about x.
Z_UP_FROM_Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])


@lru_cache(maxsize=ASSETS_KEPT)
def _is_gltf(asset: str) -> bool:
    """Whether a file is glTF by its name; a dragged object asks in every frame."""
    return PurePosixPath(asset).suffix.lower() in GLTF_SUFFIXES


class Pose(StrictModel):
    """Place, turn and size: frame_from_object = translation * rotation * scale."""

    translation_m: Point = Field(
        default=(0.0, 0.0, 0.0), description="Position of the object's origin, metres."
    )
    rotation_wxyz: Quaternion = Field(
        default=(1.0, 0.0, 0.0, 0.0),
        description="Rotation as a quaternion w, x, y, z; normalised on loading.",
    )
    scale: float = Field(
        default=1.0, gt=0, le=1e4, description="Uniform scale, a factor (assets are in metres)."
    )

    def matrix(self) -> Float64[np.ndarray, "4 4"]:
        """Returns the 4x4 matrix frame_from_object, scale included."""
        return rigid_matrix(self.scale * rotation_from_wxyz(self.rotation_wxyz), self.translation_m)


class Material(StrictModel):
    """Surface of a virtual object: metallic/roughness workflow of the Disney BRDF, GGX microfacets."""

    base_color: Colour = Field(default=(0.8, 0.8, 0.8), description="Linear RGB reflectance, 0..1.")
    metallic: Fraction = Field(default=0.0, description="0 = dielectric, 1 = metal.")
    roughness: Fraction = Field(
        default=0.5, description="Perceptual roughness (alpha = roughness squared), 0..1."
    )
    specular: Fraction = Field(
        default=0.5, description="F0 = 0.08 specular; 0 with metallic 0 is Lambertian."
    )
    ior: float | None = Field(
        default=None, ge=1, le=4, description="Index of refraction; overrides specular. null = from specular."
    )
    emission: Radiance = Field(
        default=(0.0, 0.0, 0.0), description="Emitted radiance, linear RGB, camera units."
    )
    transmission: Fraction = Field(
        default=0.0,
        description="Fraction of the light entering the surface that is transmitted, 0..1; the rest is diffuse. "
        "Each surface that light passes through multiplies it by base_color. Refraction follows ior, "
        "or else specular.",
    )
    thin_walled: bool = Field(
        default=False,
        description="true = a sheet without thickness, which does not refract; false = a solid body.",
    )
    attenuation_color: Colour = Field(
        default=(1.0, 1.0, 1.0),
        description="Colour of white light after `attenuation_distance_m` inside the object, linear RGB, 0..1.",
    )
    attenuation_distance_m: float | None = Field(
        default=None,
        gt=0,
        le=1e4,
        description="Path length inside the object after which white light has `attenuation_color`, metres; null "
        "= clear.",
    )


class PrecomputedMaterial(StrictModel):
    """A material that was precomputed (transfer, measured BRDF) and is kept as an asset."""

    precomputed: Asset = Field(description=f"Asset of the precomputed data: {ASSET_TEXT}")


def _material_kind(value: Any) -> str:  # noqa: ANN401 - whatever the document holds
    if isinstance(value, dict):
        return "precomputed" if "precomputed" in value else "material"
    return "precomputed" if isinstance(value, PrecomputedMaterial) else "material"


AnyMaterial = Annotated[
    Annotated[Material, Tag("material")] | Annotated[PrecomputedMaterial, Tag("precomputed")],
    Discriminator(_material_kind),
]


def _clip(value: object) -> object:
    """Refuses what neither names nor numbers a clip, in one sentence for both."""
    if value == "" or not isinstance(value, str | int | None):
        raise ValueError("must be the name of a clip, or its number (from 0)")
    return value


class Animation(StrictModel):
    """Plays a clip of the asset; what it shows follows from a frame's capture time alone."""

    clip: Annotated[
        Annotated[int, Field(ge=0)] | Annotated[str, Field(min_length=1)] | None,
        AfterValidator(without_nul),
        BeforeValidator(_clip),
    ] = Field(default=None, description="Name or number (from 0) of the asset's clip; null = the first.")
    speed: float = Field(
        default=1.0,
        ge=-100,
        le=100,
        description="Playback speed, clip seconds per second; 0 holds the clip at `offset_s`, negative values "
        "play it backwards.",
    )
    offset_s: float = Field(
        default=0.0, ge=-1e12, le=1e12, description="Clip time at capture time 0, seconds."
    )
    loop: bool = Field(
        default=True, description="Start again at the end; false = hold the first and last pose."
    )

    def time_s(self, capture_ns: int, duration_s: float) -> float:
        """Returns the clip time, s, 0..duration, of a frame captured at `capture_ns`."""
        time_s = capture_ns / 1e9 * self.speed + self.offset_s
        if self.loop and duration_s > 0:
            return time_s % duration_s
        return min(max(time_s, 0.0), duration_s)


def _addressable(name: str) -> str:
    """Refuses the names that browsers and HTTP clients take out of addresses: `objects/..` is the scene itself."""
    if name in (".", ".."):
        raise ValueError("`.` and `..` cannot be part of an address, so choose another name")
    return name


class SceneObject(StrictModel):
    """A virtual object."""

    id: Annotated[Text, AfterValidator(_addressable)] = Field(
        default="object", min_length=1, max_length=200, description="Unique name; default `object<index>`."
    )
    asset: Asset = Field(description=f"Mesh: {ASSET_TEXT}")
    up_axis: Literal["y", "z"] | None = Field(
        default=None,
        description="The asset's up axis; null = y for glTF, else z. The object's own frame is then z up.",
    )
    pose: Pose = Field(default_factory=Pose, description="frame_from_object.")
    frame: str = Field(
        default="world", pattern=r"^(world|marker:\d+)$", description="`world` (the board) or `marker:ID`."
    )
    material: AnyMaterial | None = Field(default=None, description="null = from the asset.")
    rigid: bool = Field(
        default=True,
        description="true = the asset in its rest pose (its transfer may be precomputed), unless `animation` is "
        "given; false = it plays its first clip, if it has one.",
    )
    animation: Animation | None = Field(
        default=None, description="How to play a glTF asset's clip; null = as `rigid` says."
    )
    lamps: float = Field(
        default=1.0,
        ge=0,
        le=1e6,
        allow_inf_nan=False,
        description="Factor on the lights that come with a glTF asset (KHR_lights_punctual); 0 = they are off.",
    )
    visible: bool = Field(default=True, description="Whether the object is rendered and affects the light.")

    @property
    def resolved_up_axis(self) -> Literal["y", "z"]:
        """The asset's up axis: as given, or y for glTF and z otherwise."""
        if self.up_axis is not None:
            return self.up_axis
        return "y" if _is_gltf(self.asset) else "z"

    @property
    def playing(self) -> Animation | None:
        """The animation of the asset's clip, if any; None = the object keeps its shape."""
        return Animation() if self.animation is None and not self.rigid else self.animation

    def world_from_object(self) -> Float64[np.ndarray, "4 4"]:
        """Returns the 4x4 matrix from asset coordinates to `frame` (the world unless it is a marker).

        The asset is first rotated so that its up axis is z (+90 degrees about x if it is y), then scaled, rotated and
        moved by the pose.
        """
        matrix = self.pose.matrix()
        matrix[:3, :3] @= self.asset_rotation
        return matrix

    @property
    def asset_rotation(self) -> Float64[np.ndarray, "3 3"]:
        """Rotation of the asset that makes its up axis z."""
        return Z_UP_FROM_Y_UP[:3, :3] if self.resolved_up_axis == "y" else np.eye(3)


class ModelGeometry(StrictModel):
    """A given model of the real scene, registered to the board."""

    model: Asset = Field(description=f"Mesh of the real scene: {ASSET_TEXT}")
    pose: Pose = Field(
        default_factory=Pose, description="world_from_model; the model's own axes are used as they are."
    )


def _geometry_kind(value: Any) -> str:  # noqa: ANN401 - whatever the document holds
    return "model" if isinstance(value, (dict, ModelGeometry)) else "sensed"


Geometry = Annotated[
    Annotated[Literal["depth", "fused"], Tag("sensed")] | Annotated[ModelGeometry, Tag("model")],
    Discriminator(_geometry_kind),
]


class PlaneRegion(StrictModel):
    """Points near a plane."""

    point_m: Point = Field(default=(0.0, 0.0, 0.0), description="A point on the plane, world, metres.")
    normal: Direction = Field(
        default=(0.0, 0.0, 1.0), description="Normal of the plane, world axes; normalised on loading."
    )
    tolerance_m: float = Field(
        default=0.01, gt=0, le=100, description="Maximum distance from the plane, metres."
    )


class BoxRegion(StrictModel):
    """Points in a box along the world axes."""

    min_m: Point = Field(default=(-0.5, -0.5, -0.5), description="Lower corner, world, metres.")
    max_m: Point = Field(default=(0.5, 0.5, 0.5), description="Upper corner, world, metres.")

    @model_validator(mode="after")
    def _check(self) -> Self:
        if any(low >= high for low, high in zip(self.min_m, self.max_m, strict=True)):
            raise ValueError("every coordinate of min_m must be below that of max_m")
        return self


class SheetRegion(StrictModel):
    """A rectangle on the board's plane (world z = 0), thinner than depth shows: paper, a cloth, a mat."""

    middle_m: tuple[Coordinate, Coordinate] = Field(description="Its middle, world x and y, metres.")
    size_m: tuple[SheetEdge, SheetEdge] = Field(description="Lengths of its edges, metres.")
    turn_deg: float = Field(
        default=0.0, ge=-360, le=360, description="Turn of its first edge from world x towards y, degrees."
    )


class Region(StrictModel):
    """Where a real surface is: exactly one of plane, box, sheet, material; without any, the board's plane."""

    plane: PlaneRegion | None = Field(default=None, description="Points near a plane.")
    box: BoxRegion | None = Field(default=None, description="Points in a box.")
    sheet: SheetRegion | None = Field(
        default=None, description="A diffuse sheet on the board's plane; it lies on every declared surface."
    )
    material: Text | None = Field(
        default=None, min_length=1, description="Name of a material of the given model."
    )

    @model_validator(mode="before")
    @classmethod
    def _default_plane(cls, data: Any) -> Any:  # noqa: ANN401 - whatever the document holds
        return {"plane": {}} if data == {} else data

    @model_validator(mode="after")
    def _check(self) -> Self:
        if sum(part is not None for part in (self.plane, self.box, self.sheet, self.material)) != 1:
            raise ValueError("a region has exactly one of plane, box, sheet, material")
        return self


class Surface(StrictModel):
    """What a region of the real scene is made of."""

    region: Region = Field(default_factory=lambda: Region(plane=PlaneRegion()))
    roughness: Fraction = Field(default=0.5, description="Perceptual roughness, 0..1.")
    metallic: Fraction = Field(default=0.0, description="0 = dielectric, 1 = metal.")
    specular: Fraction = Field(default=0.5, description="F0 = 0.08 specular.")
    albedo: Colour | None = Field(
        default=None, description="Linear RGB, 0..1 (F0 where metallic); null = measured from the picture."
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        shine = type(self).model_fields.keys() - {"region"}
        if self.region.sheet and any(
            getattr(self, key) != type(self).model_fields[key].default for key in shine
        ):
            raise ValueError("a sheet is diffuse: leave out roughness, metallic, specular and albedo")
        return self


class RealScene(StrictModel):
    """The real scene: where its shape comes from, and which of its surfaces are not diffuse."""

    geometry: Geometry = Field(
        default="depth",
        description="`depth` (each frame's own), `fused` (over all frames), or a given model.",
    )
    surfaces: tuple[Surface, ...] = Field(
        default=(),
        max_length=16,
        fail_fast=True,
        description="The first match wins; all other surfaces are diffuse.",
    )
    unseen_albedo: Annotated[float, Field(ge=0, le=0.95)] | None = Field(
        default=None,
        description="Albedo of surfaces, of a model or of fused depth, that the camera does not currently see; "
        "null = as last seen, or else that of their surroundings. A number makes each picture "
        "independent of earlier ones.",
    )
