"""How the scene document's picture is computed and shown: `method`, `shading`, `output` (FORMATS 3)."""

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import ConfigDict, Discriminator, Field, Tag

from protocol.documents import StrictModel

DEFAULT_METHOD = "dvct"
# Without `name` the method is dvct, so the others need the key for a document to match one method only.
NEEDS_NAME = ConfigDict(json_schema_extra={"required": ["name"]})
PictureSize = Annotated[int, Field(ge=16, le=8192)]


class DvctMethod(StrictModel):
    """Delta voxel cone tracing (METHOD 4)."""

    name: Literal["dvct"] = "dvct"
    operator: Literal["exact", "paper"] = Field(
        default="exact", description="Dual march (METHOD 3), or the operator as printed in the paper."
    )
    volume_size: int | None = Field(
        default=None,
        ge=32,
        le=512,
        multiple_of=8,
        description="Voxels an edge; null = 256 on a GPU, 64 in software.",
    )
    volume_edge_m: float | None = Field(
        default=None,
        ge=0.01,
        le=20,
        description="Edge of the volume, metres; null = twice the objects' longest edge.",
    )
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
    rsm_size: int | None = Field(
        default=None,
        ge=128,
        le=4096,
        description="Texels an edge of a shadow map; null = 1024 GPU, 512 software.",
    )
    triangle_budget: int | None = Field(
        default=None,
        ge=1000,
        le=4_000_000,
        description="Triangles of the depth mesh; null = 400000 on a GPU, 40000 in software.",
    )
    voxels: Literal["directional", "isotropic"] = Field(
        default="directional",
        description="Of the exact operator: six one-sided directions a voxel, or one for all (as in the paper).",
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
    shadow: Literal["map", "cone"] | None = Field(
        default=None,
        description="Shadows from shadow maps, or from shadow cones; null = map for exact, cone for paper.",
    )
    shadow_samples: int = Field(
        default=16, ge=1, le=64, description="Samples of a light's area for soft shadows."
    )
    composition: Literal["ratio", "additive"] | None = Field(
        default=None,
        description="How the delta meets the picture; null = ratio for exact, additive for paper.",
    )
    memory_budget_mb: int = Field(
        default=4096,
        ge=16,
        le=65536,
        description="Greatest memory of the volumes, MB; beyond it rendering is refused.",
    )

    @property
    def resolved_shadow(self) -> Literal["map", "cone"]:
        """Kind of shadow as given, or the operator's default."""
        return self.shadow or ("map" if self.operator == "exact" else "cone")

    @property
    def resolved_composition(self) -> Literal["ratio", "additive"]:
        """Composition as given, or the operator's default."""
        return self.composition or ("ratio" if self.operator == "exact" else "additive")


class DlpvMethod(StrictModel):
    """Delta light propagation volumes (METHOD 5)."""

    model_config = NEEDS_NAME

    name: Literal["dlpv"] = "dlpv"


class AroofMethod(StrictModel):
    """Object occlusion fields (METHOD 6)."""

    model_config = NEEDS_NAME

    name: Literal["aroof"] = "aroof"


class DifferentialMethod(StrictModel):
    """Differential rendering: two full solutions, the reference (METHOD 6)."""

    model_config = NEEDS_NAME

    name: Literal["differential"] = "differential"


class NoneMethod(StrictModel):
    """No relighting of the real scene."""

    model_config = NEEDS_NAME

    name: Literal["none"] = "none"


def _method_name(value: Any) -> Any:  # noqa: ANN401 - whatever the document holds
    if isinstance(value, Mapping):
        return value.get("name", DEFAULT_METHOD)
    return getattr(value, "name", DEFAULT_METHOD)


Method = Annotated[
    Annotated[DvctMethod, Tag("dvct")]
    | Annotated[DlpvMethod, Tag("dlpv")]
    | Annotated[AroofMethod, Tag("aroof")]
    | Annotated[DifferentialMethod, Tag("differential")]
    | Annotated[NoneMethod, Tag("none")],
    Discriminator(_method_name),
]


class Shading(StrictModel):
    """How virtual surfaces get their indirect light."""

    name: Literal["auto", "volume", "image_based", "precomputed"] = "auto"


class Output(StrictModel):
    """The picture that comes out."""

    width: PictureSize | None = Field(default=None, description="Width, pixels; null = the camera's.")
    height: PictureSize | None = Field(default=None, description="Height, pixels; null = the camera's.")
    tone: Literal["camera", "aces"] = Field(
        default="camera", description="The camera's own response, or ACES."
    )
    antialiasing: bool = Field(default=False, description="Smooth the edges of virtual objects.")
    camera_artifacts: bool = Field(
        default=False, description="Put the camera's noise and blur on the virtual part."
    )
    view: Literal["composite", "effects", "delta", "volume", "rsm", "lights"] = Field(
        default="composite", description="The picture, or a look inside."
    )
