"""How the scene document's picture is computed and shown: `method`, `shading`, `output` (docs/formats.md 3)."""

from typing import Annotated, Any, Literal, Self, TypeVar, get_args

from pydantic import ConfigDict, Field, model_validator

from deltalight.protocol.documents import StrictModel
from deltalight.protocol.quality import TIERS, Quality, QualityTier

DEFAULT_METHOD = "dvct"
T = TypeVar("T")


VolumeEdge = Annotated[
    Annotated[float, Field(ge=0.01, le=20)] | None,
    Field(description="Edge of the volume, metres; null = twice the objects' longest edge."),
]
ShadowMapSize = Annotated[
    Annotated[int, Field(ge=128, le=4096)] | None,
    Field(description="Texels along each edge of a shadow map; null = 1024 GPU, 512 software."),
]
TriangleBudget = Annotated[
    Annotated[int, Field(ge=1000, le=4_000_000)] | None,
    Field(description="Triangles of the depth mesh; null = 400000 on a GPU, 40000 in software."),
]
ShadowSamples = Annotated[int, Field(ge=1, le=64, description="Samples of a light's area for soft shadows.")]


def _require_name(schema: dict[str, Any], model: type["MethodSettings"]) -> None:
    """Without `name` the method is dvct, so the others need the key for a document to match one method only."""
    if model.method_name() != DEFAULT_METHOD:
        schema["required"] = ["name", *schema.get("required", [])]


class MethodSettings(StrictModel):
    """Base of the settings of all methods; each has a field `name`, a literal with its name as default."""

    model_config = ConfigDict(json_schema_extra=_require_name)

    quality: Quality = Field(
        default="best",
        description="What a moving picture may give up for speed (docs/speed.md): live, balanced, or best: nothing.",
    )

    @property
    def tier(self) -> QualityTier:
        """What the quality gives up."""
        return TIERS[self.quality]

    def limited(self) -> Self:
        """Return the settings within the limits of their tier."""
        given = {
            name: getattr(self, name) for name in ("cone_count", "shadow_samples") if hasattr(self, name)
        }
        return self.replaced(**{name: min(value, getattr(self.tier, name)) for name, value in given.items()})

    @classmethod
    def method_name(cls) -> str:
        """What `method.name` of the scene document calls the method."""
        (name,) = get_args(cls.model_fields["name"].annotation)
        return str(name)

    @property
    def resolved_composition(self) -> Literal["ratio", "additive"]:
        """How the delta meets the picture."""
        return "ratio"


class VoxelConeSettings(MethodSettings):
    """What every method has that traces cones through voxels (docs/method.md 4)."""

    volume_size: int | None = Field(
        default=None,
        ge=32,
        le=512,
        multiple_of=8,
        description="Voxels along each edge; null = 256 on a GPU, 64 in software.",
    )
    volume_edge_m: VolumeEdge = None
    cone_scale: Literal[1, 2, 4] | None = Field(
        default=None,
        description="Cones are traced at 1/scale of the picture; null = 2 on a GPU, 4 in software.",
    )
    cone_count: int = Field(default=16, ge=4, le=64, description="Diffuse cones of the exact operator.")
    bounces: int = Field(
        default=1,
        ge=0,
        le=4,
        description="Gathers of light from voxel to voxel, after the light that the camera measured and the lights' "
        "own; 0 = direct and unoccluded ambient only (exact operator).",
    )
    rsm_size: ShadowMapSize = None
    triangle_budget: TriangleBudget = None
    voxels: Literal["directional", "isotropic"] = Field(
        default="directional",
        description="Of the exact operator: six one-sided directions per voxel, or one for all (as in the paper).",
    )
    coverage: Literal["summed", "multiplied"] = Field(
        default="summed",
        description="Of the exact operator: what a cone meets adds up to a wall, or blocks front to back.",
    )
    radiance: Literal["measured", "predicted"] = Field(
        default="measured",
        description="Of the exact operator: real surfaces shine as the camera sees them, or as lights predict.",
    )
    far_volume: bool = Field(
        default=True, description="Of the exact operator: cones meet the real scene beyond the volume too."
    )
    reflections: Literal["rays", "cones"] = Field(
        default="rays",
        description="Of the exact operator: objects in smooth real surfaces by rays, or by cones.",
    )
    screen_space: bool = Field(
        default=True,
        description="Of the exact operator: smooth objects reflect what the picture shows; false = voxels alone.",
    )
    shadow_samples: ShadowSamples = 16
    memory_budget_mb: int = Field(
        default=4096,
        ge=16,
        le=65536,
        description="Greatest memory of the volumes, MB; beyond it rendering is refused.",
    )


class DvctMethod(VoxelConeSettings):
    """Delta voxel cone tracing (docs/method.md 4)."""

    name: Literal["dvct"] = "dvct"
    operator: Literal["exact", "paper"] = Field(
        default="exact", description="Dual march (docs/method.md 3), or the operator as printed in the paper."
    )
    shadow: Literal["map", "cone"] | None = Field(
        default=None,
        description="Shadows from shadow maps, or from shadow cones; null = map for exact, cone for paper.",
    )
    composition: Literal["ratio", "additive"] | None = Field(
        default=None,
        description="How the delta meets the picture; null = ratio for exact, additive for paper.",
    )
    mirrored_lights: bool = Field(
        default=True,
        description="Of the exact operator: smooth declared planes throw the lights back at what stands before them.",
    )
    caustics: bool = Field(
        default=True,
        description="Of the exact operator: what smooth objects reflect of the lights falls on other surfaces as "
        "beams; false = it is spread evenly, as if they were matt.",
    )

    @property
    def resolved_shadow(self) -> Literal["map", "cone"]:
        """Kind of shadow as given, or the operator's default."""
        return self.shadow or ("map" if self.operator == "exact" else "cone")

    @property
    def resolved_composition(self) -> Literal["ratio", "additive"]:
        """Composition as given, or the operator's default."""
        return self.composition or ("ratio" if self.operator == "exact" else "additive")


PrintedCells = Annotated[int | None, Field(ge=16, le=64, multiple_of=8)]


class DlpvMethod(MethodSettings):
    """Delta light propagation volumes (docs/method.md 5)."""

    name: Literal["dlpv"] = "dlpv"
    operator: Literal["difference", "paper"] = Field(
        default="difference",
        description="Two volumes, with and without objects, subtracted; or one volume of the change, as printed in "
        "the paper. Settings that are null follow it.",
    )
    volume_size: int = Field(
        default=32,
        ge=16,
        le=64,
        multiple_of=8,
        description="Cells along each edge; more make it costlier, not better.",
    )
    volume_edge_m: VolumeEdge = None
    steps: int | None = Field(
        default=None,
        ge=1,
        le=256,
        description="Steps of propagation, a cell each; null = cells per edge. The result depends on their number.",
    )
    objects_volume_size: PrintedCells = Field(
        default=None,
        description="Of operator paper: cells along each edge of the volume that lights the objects; "
        "null = volume_size.",
    )
    objects_steps: int | None = Field(
        default=None,
        ge=1,
        le=256,
        description="Of operator paper: steps in the volume that lights the objects; null = as steps.",
    )
    direct_volume_size: PrintedCells = Field(
        default=None,
        description="Of shadow lobe: cells along each edge of the volume of direct light; null = volume_size.",
    )
    direct_steps: int | None = Field(
        default=None,
        ge=0,
        le=256,
        description="Of shadow lobe: steps of direct light after injection; they soften and "
        "deepen shadows. null = 5 ([P2] fig. 7); 0 = none.",
    )
    direct_filter: int | None = Field(
        default=None,
        ge=0,
        le=4,
        description="Of shadow lobe: direct light is averaged over cubes that reach so many cells to each side, "
        "which softens shadows and makes them lighter; null = 0.",
    )
    propagation: Literal["moments", "lobes"] | None = Field(
        default=None,
        description="What a cell keeps of light that enters it: its direction, or lobes about the faces that it "
        "reaches; null = moments, lobes for paper.",
    )
    geometry_volume: bool | None = Field(
        default=None, description="Surfaces block light between cells; null = yes, no for paper."
    )
    bounces: int | None = Field(
        default=None,
        ge=0,
        le=4,
        description="How often surfaces reflect what the volume brought them; null = 2, 0 for paper.",
    )
    ambient: Literal["blocked", "open"] | None = Field(
        default=None,
        description="Surfaces in the volume keep off light from the surroundings, or none does; "
        "null = blocked, open for paper.",
    )
    damping: float | None = Field(
        default=None,
        ge=0,
        le=8,
        description="How strongly light that grows towards the back of a surface is damped, "
        "0 = not; null = 0, 1 for paper.",
    )
    shadow: Literal["map", "lobe"] | None = Field(
        default=None,
        description="Shadows of lights from shadow maps, or as negative light in the volume; "
        "null = map, lobe for paper.",
    )
    caustics: bool | None = Field(
        default=None,
        description="What smooth objects reflect of the lights falls on other surfaces as beams, or is injected "
        "into the volume; null = beams, the volume for paper.",
    )
    screen_space: bool | None = Field(
        default=None,
        description="Smooth objects reflect what the picture shows, or the surroundings alone; "
        "null = the picture, the surroundings for paper.",
    )
    reflections: Literal["rays", "none"] | None = Field(
        default=None,
        description="Objects in smooth real surfaces by rays, or not at all; null = rays, none for paper.",
    )
    query_scale: Literal[1, 2, 4] | None = Field(
        default=None,
        description="The volume is read at 1/scale of the picture; null = 2 on a GPU, 4 in software.",
    )
    rsm_size: ShadowMapSize = None
    triangle_budget: TriangleBudget = None
    shadow_samples: ShadowSamples = 16
    composition: Literal["ratio", "additive"] | None = Field(
        default=None,
        description="How the delta meets the picture; null = ratio, additive for paper.",
    )

    @model_validator(mode="after")
    def _fits_operator(self) -> "DlpvMethod":
        if self.shadow == "lobe" and self.operator != "paper":
            raise ValueError("shadow `lobe` is part of operator `paper`: use shadow map, or operator paper")
        if self.bounces and self.operator == "paper":
            raise ValueError(
                "`bounces` are not in operator `paper`: leave them out, or use operator difference"
            )
        given = [name for name in ("objects_volume_size", "objects_steps") if getattr(self, name) is not None]
        if given and self.operator != "paper":
            raise ValueError(f"`{given[0]}` is part of operator `paper`: leave it out, or use operator paper")
        direct = ("direct_volume_size", "direct_steps", "direct_filter")
        given = [name for name in direct if getattr(self, name) is not None]
        if given and self.resolved_shadow != "lobe":
            raise ValueError(
                f"`{given[0]}` is for operator paper with shadow lobe: leave it out, or use these"
            )
        return self

    def _choice(self, value: T | None, default: T, printed: T) -> T:
        if value is not None:
            return value
        return printed if self.operator == "paper" else default

    @property
    def resolved_direct_steps(self) -> int:
        """Steps of direct light as given, or five, as in [P2] fig. 7."""
        return 5 if self.direct_steps is None else self.direct_steps

    @property
    def resolved_propagation(self) -> Literal["moments", "lobes"]:
        """Weights of a step as given, or the operator's default."""
        return self._choice(self.propagation, "moments", "lobes")

    @property
    def resolved_geometry_volume(self) -> bool:
        """Whether surfaces block light, as given or the operator's default."""
        return self._choice(self.geometry_volume, True, False)

    @property
    def resolved_bounces(self) -> int:
        """Bounces as given, or the operator's default."""
        return self._choice(self.bounces, 2, 0)

    @property
    def resolved_ambient(self) -> Literal["blocked", "open"]:
        """Light of the surroundings as given, or the operator's default."""
        return self._choice(self.ambient, "blocked", "open")

    @property
    def resolved_screen_space(self) -> bool:
        """Whether objects reflect the picture, as given or the operator's default."""
        return self._choice(self.screen_space, True, False)

    @property
    def resolved_reflections(self) -> Literal["rays", "none"]:
        """Objects in smooth real surfaces, as given or the operator's default."""
        return self._choice(self.reflections, "rays", "none")

    @property
    def resolved_caustics(self) -> bool:
        """Whether there are beams, as given or the operator's default."""
        return self._choice(self.caustics, True, False)

    @property
    def resolved_damping(self) -> float:
        """Damping as given, or the operator's default."""
        return self._choice(self.damping, 0.0, 1.0)

    @property
    def resolved_shadow(self) -> Literal["map", "lobe"]:
        """Kind of shadow as given, or the operator's default."""
        return self._choice(self.shadow, "map", "lobe")

    @property
    def resolved_composition(self) -> Literal["ratio", "additive"]:
        """Composition as given, or the operator's default."""
        return self._choice(self.composition, "ratio", "additive")


class AroofMethod(MethodSettings):
    """Object occlusion fields (docs/method.md 6): what rigid objects hide of natural light is precomputed."""

    name: Literal["aroof"] = "aroof"
    sh_order: int = Field(
        default=4,
        ge=3,
        le=5,
        description="Bands of spherical harmonics of what an object hides: 9, 16 or 25 coefficients per sample.",
    )
    shells: int = Field(
        default=4, ge=2, le=6, description="Grids of samples around an object, each within the next."
    )
    resolution: int = Field(
        default=32,
        ge=12,
        le=48,
        multiple_of=4,
        description="Samples along each edge of each shell.",
    )
    reach: float = Field(
        default=8.0,
        ge=2,
        le=32,
        description="How far the outermost shell reaches from the object's middle, in radii of the sphere around it.",
    )
    rays: int = Field(
        default=256,
        ge=64,
        le=4096,
        description="Rays from each sample over the whole sphere; more take longer once.",
    )
    indirect: bool = Field(
        default=True,
        description="Objects also reflect light onto what is around them (radiance transfer field).",
    )
    near_light: Literal["measured", "none"] = Field(
        default="measured",
        description="What the camera sees around an object counts as light there, or the environment map alone.",
    )
    caustics: bool = Field(
        default=True,
        description="What smooth objects reflect of the lights falls on other surfaces as beams; false = nowhere.",
    )
    screen_space: bool = Field(
        default=True,
        description="Smooth objects reflect what the picture shows; false = the surroundings alone.",
    )
    shading_scale: Literal[1, 2, 4] | None = Field(
        default=None,
        description="Fields are read at 1/scale of the picture; null = 2 on a GPU, 4 in software.",
    )
    rsm_size: ShadowMapSize = None
    triangle_budget: TriangleBudget = None
    shadow_samples: ShadowSamples = 16
    composition: Literal["ratio", "additive"] = Field(
        default="ratio", description="How the delta meets the picture."
    )

    @property
    def resolved_composition(self) -> Literal["ratio", "additive"]:
        """Composition as given."""
        return self.composition


class DifferentialMethod(VoxelConeSettings):
    """Differential rendering: two full solutions, the reference (docs/method.md 6)."""

    name: Literal["differential"] = "differential"
    composition: Literal["ratio", "additive"] = Field(
        default="ratio", description="How the difference meets the picture."
    )

    @property
    def resolved_composition(self) -> Literal["ratio", "additive"]:
        """Composition as given."""
        return self.composition


class NoneMethod(MethodSettings):
    """No relighting of the real scene."""

    name: Literal["none"] = "none"


BUILT_IN_METHODS: tuple[type[MethodSettings], ...] = (
    DvctMethod,
    DlpvMethod,
    AroofMethod,
    DifferentialMethod,
    NoneMethod,
)
