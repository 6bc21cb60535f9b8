"""How the scene document's picture is computed and shown: `method`, `shading`, `output` (docs/formats.md 3)."""

from typing import Annotated, Any, Literal, Self, TypeVar, get_args

from pydantic import ConfigDict, Field, model_validator

from deltalight.protocol.documents import StrictModel
from deltalight.protocol.quality import TIERS, Quality, QualityTier

DEFAULT_METHOD = "dvct"
T = TypeVar("T")


VolumeEdge = Annotated[
    Annotated[float, Field(ge=0.01, le=20)] | None,
    Field(description="Edge length of the volume, metres; null = twice the longest edge of the objects."),
]
ShadowMapSize = Annotated[
    Annotated[int, Field(ge=128, le=4096)] | None,
    Field(description="Texels along each edge of a shadow map; null = 1024 on a GPU, 512 in software."),
]
TriangleBudget = Annotated[
    Annotated[int, Field(ge=1000, le=4_000_000)] | None,
    Field(description="Maximum triangles of the depth mesh; null = 400000 on a GPU, 40000 in software."),
]
MemoryBudget = Annotated[
    int,
    Field(ge=16, le=65536, description="Memory limit of the volumes, MB; beyond it, rendering is refused."),
]
ShadowSamples = Annotated[int, Field(ge=1, le=64, description="Samples per area light, for soft shadows.")]


def _require_name(schema: dict[str, Any], model: type["MethodSettings"]) -> None:
    """Without `name` the method is dvct, so the others need the key for a document to match one method only."""
    if model.method_name() != DEFAULT_METHOD:
        schema["required"] = ["name", *schema.get("required", [])]


class MethodSettings(StrictModel):
    """Base of the settings of all methods; each has a field `name`, a literal with its name as default."""

    model_config = ConfigDict(json_schema_extra=_require_name)

    quality: Quality = Field(
        default="best",
        description="Quality that a moving picture gives up for speed (docs/speed.md): `live` most, `balanced` "
        "some, `best` none.",
    )

    @property
    def tier(self) -> QualityTier:
        """What the quality gives up."""
        return TIERS[self.quality]

    def limited(self) -> Self:
        """Returns the settings within the limits of their tier."""
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
        """How the change of light is applied to the picture."""
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
        description="Cones are traced at 1/scale of the picture's size; null = 2 on a GPU, 4 in software.",
    )
    cone_count: int = Field(default=16, ge=4, le=64, description="Diffuse cones per pixel (exact operator).")
    bounces: int = Field(
        default=1,
        ge=0,
        le=4,
        description="Bounces of light from voxel to voxel, in addition to the light that the camera measured and "
        "the direct light; 0 = direct and unoccluded ambient light only (exact operator).",
    )
    rsm_size: ShadowMapSize = None
    triangle_budget: TriangleBudget = None
    voxels: Literal["directional", "isotropic"] = Field(
        default="directional",
        description="Exact operator: six directional values per voxel, or one isotropic value (as in the paper).",
    )
    coverage: Literal["summed", "multiplied"] = Field(
        default="summed",
        description="Exact operator: how a cone accumulates coverage: summed, or multiplied front to back.",
    )
    radiance: Literal["measured", "predicted"] = Field(
        default="measured",
        description="Exact operator: radiance of real surfaces, as the camera measures it or as the lights "
        "predict it.",
    )
    far_volume: bool = Field(
        default=True, description="Exact operator: cones also see the real scene beyond the volume."
    )
    reflections: Literal["rays", "cones"] = Field(
        default="rays",
        description="Exact operator: smooth real surfaces reflect objects by rays or by cones.",
    )
    screen_space: bool = Field(
        default=True,
        description="Exact operator: smooth objects reflect the camera's picture where it shows the spot; false = "
        "voxels only.",
    )
    shadow_samples: ShadowSamples = 16
    memory_budget_mb: MemoryBudget = 4096


class DvctMethod(VoxelConeSettings):
    """Delta voxel cone tracing (docs/method.md 4)."""

    name: Literal["dvct"] = "dvct"
    operator: Literal["exact", "paper"] = Field(
        default="exact", description="Dual march (docs/method.md 3), or the operator as printed in the paper."
    )
    shadow: Literal["map", "cone"] | None = Field(
        default=None,
        description="Shadows from shadow maps or from shadow cones; null = map for exact, cone for paper.",
    )
    composition: Literal["ratio", "additive"] | None = Field(
        default=None,
        description="How the change of light is applied to the picture; null = ratio for exact, additive for "
        "paper.",
    )
    mirrored_lights: bool = Field(
        default=True,
        description="Exact operator: smooth declared planes reflect the lights onto what stands in front of them.",
    )
    caustics: bool = Field(
        default=True,
        description="Exact operator: smooth objects reflect the lights onto other surfaces as caustics; false = "
        "diffusely, as if they were matte.",
    )

    @property
    def resolved_shadow(self) -> Literal["map", "cone"]:
        """Kind of shadow as given, or the operator's default."""
        return self.shadow or ("map" if self.operator == "exact" else "cone")

    @property
    def resolved_composition(self) -> Literal["ratio", "additive"]:
        """Composition as given, or the operator's default."""
        return self.composition or ("ratio" if self.operator == "exact" else "additive")


PrintedCells = Annotated[int | None, Field(ge=16, le=128, multiple_of=8)]


class DlpvMethod(MethodSettings):
    """Delta light propagation volumes (docs/method.md 5)."""

    name: Literal["dlpv"] = "dlpv"
    operator: Literal["difference", "paper"] = Field(
        default="difference",
        description="The difference of two volumes, with and without objects; or one volume of the change, as "
        "printed in the paper. It sets the defaults of settings that are null.",
    )
    volume_size: int = Field(
        default=32,
        ge=16,
        le=128,
        multiple_of=8,
        description="Cells along each edge; more cells cost more and hardly improve the picture.",
    )
    volume_edge_m: VolumeEdge = None
    steps: int | None = Field(
        default=None,
        ge=1,
        le=256,
        description="Propagation steps, one cell each; null = as many as cells along an edge. The result depends "
        "on their number.",
    )
    objects_volume_size: PrintedCells = Field(
        default=None,
        description="Operator paper: cells along each edge of the volume that lights the objects; null = "
        "volume_size.",
    )
    objects_steps: int | None = Field(
        default=None,
        ge=1,
        le=256,
        description="Operator paper: propagation steps in the volume that lights the objects; null = as in "
        "`steps`.",
    )
    direct_volume_size: PrintedCells = Field(
        default=None,
        description="Shadow lobe: cells along each edge of the volume of direct light; null = volume_size.",
    )
    direct_steps: int | None = Field(
        default=None,
        ge=0,
        le=256,
        description="Shadow lobe: propagation steps of direct light after injection, which soften and deepen "
        "shadows; null = 5 ([P2] fig. 7), 0 = none.",
    )
    direct_filter: int | None = Field(
        default=None,
        ge=0,
        le=4,
        description="Shadow lobe: radius, in cells, of the cube over which direct light is averaged, which "
        "softens and lightens shadows; null = 0.",
    )
    propagation: Literal["moments", "lobes"] | None = Field(
        default=None,
        description="How a cell stores the light that enters it: as moments of its direction, or as lobes about "
        "the faces that it reaches; null = moments, lobes for paper.",
    )
    geometry_volume: bool | None = Field(
        default=None, description="Whether surfaces block light between cells; null = yes, no for paper."
    )
    bounces: int | None = Field(
        default=None,
        ge=0,
        le=4,
        description="Bounces: how often surfaces reflect the light that reaches them through the volume; null = "
        "2, 0 for paper.",
    )
    ambient: Literal["blocked", "open"] | None = Field(
        default=None,
        description="Whether surfaces in the volume block light from the surroundings; null = blocked, open for "
        "paper.",
    )
    damping: float | None = Field(
        default=None,
        ge=0,
        le=8,
        description="How strongly light that increases behind a surface is damped; 0 = not at all; null = 0, 1 "
        "for paper.",
    )
    shadow: Literal["map", "lobe"] | None = Field(
        default=None,
        description="Shadows from shadow maps, or as negative light in the volume; null = map, lobe for paper.",
    )
    caustics: bool | None = Field(
        default=None,
        description="Smooth objects reflect the lights onto other surfaces as caustics, or their reflected light "
        "is injected into the volume; null = caustics, the volume for paper.",
    )
    screen_space: bool | None = Field(
        default=None,
        description="Smooth objects reflect the camera's picture where it shows the spot, or only the "
        "surroundings; null = the picture, the surroundings for paper.",
    )
    reflections: Literal["rays", "none"] | None = Field(
        default=None,
        description="Whether smooth real surfaces reflect objects, by rays; null = rays, none for paper.",
    )
    query_scale: Literal[1, 2, 4] | None = Field(
        default=None,
        description="The volume is sampled at 1/scale of the picture's size; null = 2 on a GPU, 4 in software.",
    )
    rsm_size: ShadowMapSize = None
    triangle_budget: TriangleBudget = None
    shadow_samples: ShadowSamples = 16
    memory_budget_mb: MemoryBudget = 4096
    composition: Literal["ratio", "additive"] | None = Field(
        default=None,
        description="How the change of light is applied to the picture; null = ratio, additive for paper.",
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
        description="Bands of spherical harmonics for an object's occlusion: 9, 16 or 25 coefficients per sample.",
    )
    shells: int = Field(
        default=4, ge=2, le=6, description="Nested grids (shells) of samples around an object."
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
        description="Extent of the outermost shell from the object's centre, in radii of its bounding sphere.",
    )
    rays: int = Field(
        default=256,
        ge=64,
        le=4096,
        description="Rays from each sample over the whole sphere; more make the precomputation longer.",
    )
    indirect: bool = Field(
        default=True,
        description="Objects also reflect light onto their surroundings (radiance transfer field).",
    )
    near_light: Literal["measured", "none"] = Field(
        default="measured",
        description="Light around an object comes from what the camera sees there, or only from the environment "
        "map.",
    )
    caustics: bool = Field(
        default=True,
        description="Smooth objects reflect the lights onto other surfaces as caustics; false = not at all.",
    )
    screen_space: bool = Field(
        default=True,
        description="Smooth objects reflect the camera's picture where it shows the spot; false = only the "
        "surroundings.",
    )
    shading_scale: Literal[1, 2, 4] | None = Field(
        default=None,
        description="Fields are sampled at 1/scale of the picture's size; null = 2 on a GPU, 4 in software.",
    )
    rsm_size: ShadowMapSize = None
    triangle_budget: TriangleBudget = None
    shadow_samples: ShadowSamples = 16
    composition: Literal["ratio", "additive"] = Field(
        default="ratio", description="How the change of light is applied to the picture."
    )

    @property
    def resolved_composition(self) -> Literal["ratio", "additive"]:
        """Composition as given."""
        return self.composition


class DifferentialMethod(VoxelConeSettings):
    """Differential rendering: two full solutions, the reference (docs/method.md 6)."""

    name: Literal["differential"] = "differential"
    composition: Literal["ratio", "additive"] = Field(
        default="ratio", description="How the change of light is applied to the picture."
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
