"""How a scene document wants objects shaded, and the picture."""

from typing import Annotated, Literal

from pydantic import Field

from deltalight.protocol.documents import StrictModel
from deltalight.protocol.scene_fields import View

PictureSize = Annotated[int, Field(ge=16, le=8192)]


Tone = Literal["camera", "aces"]


class Shading(StrictModel):
    """How virtual surfaces get their light."""

    name: Literal["auto", "volume", "image_based", "precomputed"] = Field(
        default="auto",
        description="By the method's own light transport (auto, volume), or only from a map of all the light "
        "around the objects (image_based, docs/method.md 6.6), optionally with precomputed "
        "self-shadowing and interreflection for rigid objects (precomputed, docs/method.md 6.5).",
    )
    samples: int = Field(
        default=40,
        ge=1,
        le=64,
        description="image_based and precomputed: specular samples per pixel.",
    )
    occlusion_radius_m: float | None = Field(
        default=None,
        ge=0,
        le=20,
        description="image_based: distance within which objects occlude themselves, metres; the effect fades out "
        "up to twice that distance. 0 = no self-occlusion, null = the longest edge of the largest "
        "object.",
    )
    coefficients: Literal[9, 16] = Field(
        default=9,
        description="precomputed: coefficients of spherical harmonics for self-occlusion.",
    )
    bounces: int = Field(
        default=2,
        ge=0,
        le=8,
        description="precomputed: bounces of light between parts of the same object.",
    )
    rays: int = Field(
        default=1024,
        ge=64,
        le=16384,
        description="precomputed: rays over the sphere around each vertex; more give less noise and a longer "
        "precomputation.",
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
    tone: Tone = Field(default="camera", description="The camera's own response, or the ACES tone curve.")
    frame_budget_ms: float | None = Field(
        default=None,
        ge=5,
        le=5000,
        description="Time limit for a frame while something moves, ms: first the quality is lowered, then the "
        "rendered size (docs/speed.md); null = no limit.",
    )
    antialiasing: bool = Field(default=False, description="Antialias the edges of virtual objects.")
    matting_px: int = Field(
        default=0,
        ge=0,
        le=16,
        description="Width, in pixels, of the band along real objects in front of virtual ones in which colour "
        "recovers hair and fingers that depth misses; 0 = only edges are refined.",
    )
    camera_artifacts: bool = Field(
        default=False,
        description="Add the camera's noise, blur, defocus, vignetting, colour mosaic, JPEG artefacts and motion "
        "blur, measured from its frames, to the virtual part of the picture.",
    )
    bloom: float = Field(
        default=0.0,
        ge=0,
        le=0.5,
        description="Bloom: fraction of the changed light that the lens scatters around it; 0 = none.",
    )
    view: View = Field(
        default="composite", description="What the picture shows: the finished picture, or an inside view."
    )

    @property
    def has_bloom(self) -> bool:
        """Whether the view `composite` has bloom."""
        return self.bloom > 0
