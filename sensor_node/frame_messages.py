"""The messages in which a sensor node publishes one frame."""

import math
from typing import Literal, TypedDict

import numpy as np
from jaxtyping import Float64

from protocol.board import BoardSpec
from protocol.codecs import encode_color, encode_depth
from protocol.envelope import encode
from protocol.frames import BoardPose, DepthImage, SensorFrame
from protocol.messages import ColorMessage, DepthMessage, Matrix4, PoseMessage

# Depth that does not come in steps is sent in this step times the least power of two that its range fits.
FINEST_DEPTH_STEP_M = 0.0001
DEPTH_STEPS = 65535


class Stamps(TypedDict):
    """Header fields that all messages of one frame share."""

    node: str
    frame_id: int
    capture_ns: int
    clock_offset_ns: int
    clock_bound_ns: int | None


def depth_multipart(
    depth: DepthImage, stamps: Stamps, stream: Literal["depth", "clean_depth"], step_m: float | None = None
) -> list[bytes]:
    """Return the depth message; `step_m` is the step it is stored in, None = as fine as its range allows."""
    step_m = step_m or fitting_step_m(depth)
    height, width = depth.depth_m.shape
    message = DepthMessage(
        **stamps,
        stream=stream,
        encoding="blosc2",
        shape=(height, width),
        depth_scale_m=step_m,
        camera=depth.camera.to_dict(),
        noise_sigma_m=depth.noise_sigma_m,
    )
    return encode(message, [encode_depth(depth.depth_m, depth.valid, "blosc2", step_m)])


def fitting_step_m(depth: DepthImage) -> float:
    """Return the finest step in metres in which 16 bits hold the farthest known depth."""
    farthest = float(depth.depth_m.max(initial=0.0, where=depth.valid & np.isfinite(depth.depth_m)))
    octaves = math.ceil(math.log2(max(farthest / (FINEST_DEPTH_STEP_M * DEPTH_STEPS), 1.0)))
    return FINEST_DEPTH_STEP_M * 2.0**octaves


def pose_multipart(pose: BoardPose | None, board: BoardSpec | None, stamps: Stamps) -> list[bytes]:
    """Return the pose message, which says so where no pose is known."""
    described = None if board is None else board.model_dump(mode="json", exclude_none=True)
    if pose is None:
        return encode(PoseMessage(**stamps, status="no_board", board=described))
    message = PoseMessage(
        **stamps,
        status="ok",
        world_from_camera=_rows(pose.world_from_camera),
        alternative=None if pose.alternative is None else _rows(pose.alternative),
        reprojection_error_px=pose.reprojection_error_px,
        board=described,
    )
    return encode(message)


def color_multipart(
    frame: SensorFrame, stamps: Stamps, encoding: Literal["jpeg", "raw"], jpeg_quality: int
) -> list[bytes]:
    """Return the colour message; JPEG bytes that the frame came with go out as they are."""
    recorded = frame.color_jpeg if encoding == "jpeg" else None
    picture = recorded or encode_color(frame.color, encoding, jpeg_quality)
    height, width = frame.color.shape[:2]
    message = ColorMessage(
        **stamps,
        encoding=encoding,
        shape=(height, width, 3),
        camera=frame.camera.to_dict(),
        has_response=frame.response is not None,
        exposure_s=frame.exposure_s,
    )
    return encode(message, [picture] if frame.response is None else [picture, frame.response])


def _rows(matrix: Float64[np.ndarray, "4 4"]) -> Matrix4:
    first, second, third, fourth = (tuple(float(value) for value in row) for row in matrix)
    return first, second, third, fourth  # type: ignore[return-value]  # four of four each
