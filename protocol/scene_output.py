"""How a scene document wants objects shaded, and the picture."""

from typing import Annotated, Literal

from pydantic import Field

from deltalight.protocol.documents import StrictModel
from deltalight.protocol.scene_fields import View

PictureSize = Annotated[int, Field(ge=16, le=8192)]


class Shading(StrictModel):
    """How virtual surfaces get their light."""

    name: Literal["auto", "volume", "image_based", "precomputed"] = Field(
        default="auto",
        description="As the method does (auto, volume), or by a map of all light around the objects alone "
        "(image_based, docs/method.md 6.6), where rigid objects may have their own shadows and bounced light "
        "precomputed (precomputed, docs/method.md 6.5).",
    )
    samples: int = Field(
        default=40,
        ge=1,
        le=64,
        description="Of image_based and precomputed: samples per pixel of what a surface mirrors.",
    )
    occlusion_radius_m: float | None = Field(
        default=None,
        ge=0,
        le=20,
        description="Of image_based: objects keep light off themselves within this distance, metres, and less up to "
        "twice of it; 0 = not at all, null = the longest edge of the largest object.",
    )
    coefficients: Literal[9, 16] = Field(
        default=9,
        description="Of precomputed: spherical harmonics of the light that objects keep off themselves.",
    )
    bounces: int = Field(
        default=2,
        ge=0,
        le=8,
        description="Of precomputed: times that light goes on from an object to itself.",
    )
    rays: int = Field(
        default=1024,
        ge=64,
        le=16384,
        description="Of precomputed: rays over the sphere around each vertex; more = less noise, longer, once.",
    )

    @property
    def is_image_based(self) -> bool:
        """Whether objects are lit by a map of the light around them alone, less what the picture shows of them."""
        return self.name == "image_based"

    @property
    def is_precomputed(self) -> bool:
        """Whether objects are lit by such a map and their precomputed transfer."""
        return self.name == "precomputed"


class Output(StrictModel):
    """The picture that comes out."""

    width: PictureSize | None = Field(default=None, description="Width, pixels; null = the camera's.")
    height: PictureSize | None = Field(default=None, description="Height, pixels; null = the camera's.")
    tone: Literal["camera", "aces"] = Field(
        default="camera", description="The camera's own response, or ACES."
    )
    frame_budget_ms: float | None = Field(
        default=None,
        ge=5,
        le=5000,
        description="What a frame may take while something moves, ms: quality, then the size at which it is rendered "
        "give way (docs/speed.md); null = no limit.",
    )
    antialiasing: bool = Field(default=False, description="Smooth the edges of virtual objects.")
    matting_px: int = Field(
        default=0,
        ge=0,
        le=16,
        description="Pixels from real things in front of objects within which hair and fingers that depth does not "
        "show are found by colour; 0 = edges alone.",
    )
    camera_artifacts: bool = Field(
        default=False,
        description="Put the camera's noise, sharpness, vignetting, JPEG compression and motion blur on the virtual "
        "part, as its frames show them.",
    )
    bloom: float = Field(
        default=0.0,
        ge=0,
        le=0.5,
        description="Share of the light of what changes that the lens scatters around it; 0 = none.",
    )
    view: View = Field(default="composite", description="The picture, or a look inside.")

    @property
    def has_bloom(self) -> bool:
        """Whether the view `composite` has bloom, which is put on in the camera's own response."""
        return self.bloom > 0 and self.tone == "camera"
