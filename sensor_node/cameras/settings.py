"""Settings of cameras in a node's configuration."""

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from deltalight.protocol.documents import StrictModel

# Half an hour is longer than any sensor exposes, one microsecond shorter than any rolling shutter allows.
Exposure = Annotated[float, Field(ge=1e-6, le=1800)]


class CameraSettings(StrictModel):
    """How a camera is opened; replayed sources use `realtime` and `loop`, live ones the rest.

    The synthetic one uses both of those, and `width`, `height` and `fps`.
    """

    realtime: bool = Field(default=True, description="Replay: obey the recorded times; else fast.")
    loop: bool = Field(default=True, description="Replay: begin again at the end of the source.")
    calibration: Path | None = Field(
        default=None,
        description="Live cameras: folder with rgb.yaml and, where they apply, depth.yaml, extrinsics.yaml,"
        " board.yaml, fisheye.yaml, response.txt; null = what the camera itself knows.",
    )
    width: int | None = Field(default=None, ge=16, le=16384, description="Columns; null = as calibrated.")
    height: int | None = Field(default=None, ge=16, le=16384, description="Rows; null = as calibrated.")
    fps: float = Field(default=30, gt=0, le=1000, description="Frames per second to ask a camera for.")
    exposure_s: Exposure | None = Field(
        default=None, description="Exposure to lock, s; null = automatic, sent with each frame where known."
    )
    white_balance_k: int | None = Field(
        default=None, ge=1000, le=12000, description="Colour temperature to lock, K; null = see `lock`."
    )
    lock: bool = Field(
        default=True,
        description="Without exposure_s and white_balance_k: let the camera settle, then keep both as they are.",
    )
    neural_depth: Literal["nano", "small", "medium", "large"] | None = Field(
        default=None,
        description="OAK 4: depth by the device's neural network of this size; null = by stereo matching.",
    )
    stall_s: float = Field(
        default=2.0, gt=0, le=60, description="A live camera that gives no frame for so long is reopened, s."
    )


class FisheyeSettings(StrictModel):
    """The camera that sees the light: any camera as a source, single exposure or a bracket."""

    source: str = Field(description="Source of the fish-eye pictures, as for the camera: uvc:2, oak:ID, ...")
    camera: CameraSettings = Field(default=CameraSettings(), description="How that camera is opened.")
    exposures_s: tuple[Exposure, ...] = Field(
        default=(), max_length=9, description="Exposure bracket, s; empty = one picture as it comes."
    )
    settle_frames: int = Field(
        default=3,
        ge=0,
        le=30,
        description="Frames left out after an exposure was changed, where the camera does not report its own.",
    )
