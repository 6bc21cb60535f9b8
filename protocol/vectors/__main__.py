"""Rewrites the byte vectors after a change of the wire and its version: `python -m deltalight.protocol.vectors`."""

import base64
import json
from collections.abc import Iterator, Sequence
from typing import Any, Literal

import numpy as np

from deltalight.protocol.codecs import encode_array, encode_color, encode_depth
from deltalight.protocol.envelope import encode
from deltalight.protocol.messages import (
    CameraEntry,
    CamerasMessage,
    ColorMessage,
    CompositeMessage,
    ControlReply,
    ControlRequest,
    DepthMessage,
    FisheyeMessage,
    LampEntry,
    LampsMessage,
    LightEntry,
    LightsMessage,
    Message,
    OtherPicture,
    PoseMessage,
    RadianceMessage,
    StatsMessage,
)
from deltalight.protocol.vectors import FOLDER, frame_pieces

CAMERA: dict[str, object] = {
    "width": 4,
    "height": 2,
    "matrix": [3.5, 0.0, 1.5, 0.0, 3.5, 0.5, 0.0, 0.0, 1.0],
    "distortion_model": "plumb_bob",
    "distortion": [0.1, -0.05, 0.0, 0.0, 0.0],
}
FISHEYE: dict[str, object] = {
    "lens": {
        **CAMERA,
        "distortion_model": "equidistant",
        "distortion": [0.0, 0.0, 0.0, 0.0],
        "image_circle": None,
    },
    "vignetting": [-0.05],
    "response": None,
}
LAMP: dict[str, object] = {
    "type": "sphere",
    "position_m": [0.5, -0.25, 1.5],
    "intensity": 20.0,
    "radius_m": 0.05,
    "color_linear": [1.0, 0.9, 0.8],
}
POSE = ((1.0, 0.0, 0.0, 0.25), (0.0, -1.0, 0.0, -0.5), (0.0, 0.0, -1.0, 0.75), (0.0, 0.0, 0.0, 1.0))
OTHER_POSE = ((1.0, 0.0, 0.0, 0.25), (0.0, -0.6, 0.8, -0.5), (0.0, -0.8, -0.6, 0.75), (0.0, 0.0, 0.0, 1.0))
PIXELS = np.arange(24, dtype=np.uint8).reshape(2, 4, 3) * 10
SHAPE = (2, 4, 3)
RESPONSE = np.repeat(np.arange(256, dtype="<f4")[:, None] / np.float32(255), 3, axis=1)
NODE, FRAME, CAPTURE_NS, OFFSET_NS, BOUND_NS = "desk", 7, 1_700_000_000_123_456_789, -1500, 800

Example = tuple[str, Message, Sequence[bytes], Sequence[Sequence[float]]]


def main() -> None:
    """Writes every vector into the folder of this module."""
    examples = [
        *_color_examples(),
        *_fisheye_examples(),
        *_composite_examples(),
        *_depth_examples(),
        *_radiance_examples(),
        *_lights_examples(),
        *_pose_examples(),
        *_state_examples(),
        *_command_examples(),
    ]
    for name, message, parts, values in examples:
        pieces = encode(message, parts)
        (FOLDER / f"{name}.bin").write_bytes(frame_pieces(pieces))
        meaning = {
            "topic": message.topic,
            "header": message.model_dump(mode="json"),
            "parts": [base64.b64encode(part).decode() for part in parts],
            **({"values": values} if values else {}),
        }
        (FOLDER / f"{name}.json").write_text(json.dumps(meaning, indent=1) + "\n")


def _stamps() -> dict[str, Any]:
    return {
        "frame_id": FRAME,
        "capture_ns": CAPTURE_NS,
        "clock_offset_ns": OFFSET_NS,
        "clock_bound_ns": BOUND_NS,
    }


def _color_examples() -> Iterator[Example]:
    yield (
        "color_raw",
        ColorMessage(
            node=NODE,
            **_stamps(),
            encoding="raw",
            shape=SHAPE,
            camera=CAMERA,
            has_response=True,
            exposure_s=0.01,
        ),
        [PIXELS.tobytes(), RESPONSE.tobytes()],
        [PIXELS.ravel().tolist()],
    )
    yield (
        "color_jpeg",
        ColorMessage(node=NODE, **_stamps(), encoding="jpeg", shape=SHAPE, camera=CAMERA),
        [encode_color(PIXELS)],
        [],
    )


def _fisheye_examples() -> Iterator[Example]:
    bracket = [np.float32(exposure) * PIXELS for exposure in (0.5, 2.0)]
    yield (
        "fisheye_raw",
        FisheyeMessage(
            node=NODE,
            **_stamps(),
            encoding="raw",
            shape=SHAPE,
            dtype="float32",
            camera=FISHEYE,
            exposures_s=(0.005, 0.02),
        ),
        [picture.astype("<f4").tobytes() for picture in bracket],
        [picture.astype(int).ravel().tolist() for picture in bracket],
    )
    yield (
        "fisheye_coded_raw",
        FisheyeMessage(
            node=NODE, **_stamps(), encoding="raw", shape=SHAPE, camera=FISHEYE, has_response=True
        ),
        [PIXELS.tobytes(), RESPONSE.tobytes()],
        [PIXELS.ravel().tolist()],
    )


def _composite_examples() -> Iterator[Example]:
    yield (
        "composite_raw",
        CompositeMessage(
            node="server",
            **_stamps(),
            encoding="raw",
            shape=SHAPE,
            status="ok",
            scene_id="4f0c2a9be1d37785",
            scene_revision=4,
            camera=CAMERA,
            world_from_camera=POSE,
            received_ns=CAPTURE_NS + 2_000_000,
            rendered_ns=CAPTURE_NS + 30_000_000,
            pass_times_ms={"voxelize": 1.25, "cones": 20.5},
            reused_pass_times_ms={"voxelize real": 7.5},
            lights=(LAMP,),
            drops={"color.desk": 3},
            quality="live",
            scale=0.5,
            others=(OtherPicture(view="rsm"),),
        ),
        [PIXELS.tobytes(), PIXELS[::-1].tobytes()],
        [PIXELS.ravel().tolist()],
    )


def _depth_examples() -> Iterator[Example]:
    steps = np.array([[0, 5000, 5001, 65535], [1, 0, 10000, 20000]])
    encodings: tuple[Literal["raw", "blosc2"], ...] = ("raw", "blosc2")
    for encoding in encodings:
        part = encode_depth((steps * 0.0002).astype(np.float32), steps > 0, encoding, 0.0002)
        message = DepthMessage(
            node=NODE,
            **_stamps(),
            encoding=encoding,
            stream="clean_depth" if encoding == "raw" else "depth",
            shape=(2, 4),
            depth_scale_m=0.0002,
            camera=CAMERA,
            noise_sigma_m=0.002,
        )
        yield f"{message.stream}_{encoding}", message, [part], [steps.ravel().tolist()]


def _radiance_examples() -> Iterator[Example]:
    radiance = np.arange(48, dtype=np.float32).reshape(4, 4, 3) * np.float32(2.5)
    seen = np.arange(16, dtype=np.uint8).reshape(4, 4) % 3 > 0
    picture = encode_color(PIXELS)
    encodings: tuple[Literal["raw", "blosc2"], ...] = ("raw", "blosc2")
    for encoding in encodings:
        message = RadianceMessage(
            node=NODE,
            **_stamps(),
            encoding=encoding,
            size=4,
            picture_shape=SHAPE,
            clipped_share=0.125,
            world_from_fisheye=POSE,
            camera=FISHEYE,
        )
        parts = [encode_array(radiance, encoding), encode_array(seen.astype(np.uint8), encoding), picture]
        values = [radiance.ravel().tolist(), seen.astype(int).ravel().tolist()]
        yield f"radiance_{encoding}", message, parts, values


def _lights_examples() -> Iterator[Example]:
    residual = np.arange(48, dtype=np.float32).reshape(4, 4, 3) * np.float32(0.25)
    seen = np.arange(16, dtype=np.float32).reshape(4, 4) / np.float32(16)
    lights = (
        LightEntry(id=3, to_light=(0.0, 0.6, 0.8), irradiance=(2.5, 2.0, 1.5), angular_radius_rad=0.0625),
        LightEntry(id=5, to_light=(-1.0, 0.0, 0.0), irradiance=(0.0, 0.0, 0.0), angular_radius_rad=0.25),
    )
    encodings: tuple[Literal["raw", "blosc2"], ...] = ("raw", "blosc2")
    for encoding in encodings:
        message = LightsMessage(
            node=NODE,
            **_stamps(),
            encoding=encoding,
            size=4,
            count=4,
            split="peaks",
            threshold=4.0,
            smoothing_s=0.5,
            radiance_frame_id=FRAME - 2,
            radiance_capture_ns=CAPTURE_NS - 66_666_667,
            world_from_fisheye=POSE,
            lights=lights,
            regions=((0, 2, 1, 4),),
        )
        parts = [encode_array(residual, encoding), encode_array(seen, encoding)]
        yield f"lights_{encoding}", message, parts, [residual.ravel().tolist(), seen.ravel().tolist()]


def _pose_examples() -> Iterator[Example]:
    pose = PoseMessage(
        node=NODE,
        **_stamps(),
        status="ok",
        world_from_camera=POSE,
        alternative=OTHER_POSE,
        reprojection_error_px=0.25,
        board={"type": "aruco_grid", "rows": 2, "columns": 3},
    )
    yield "pose_ok", pose, [], []
    yield "pose_no_board", PoseMessage(node=NODE, **_stamps(), status="no_board"), [], []
    lamps = (LampEntry(marker=40, world_from_marker=POSE), LampEntry(marker=41, world_from_marker=OTHER_POSE))
    yield "lamps", LampsMessage(node=NODE, **_stamps(), lamps=lamps), [], []


def _state_examples() -> Iterator[Example]:
    cameras = CamerasMessage(
        node="server",
        capture_ns=CAPTURE_NS,
        cameras=(
            CameraEntry(
                node=NODE,
                status="live",
                frame_id=FRAME,
                capture_ns=CAPTURE_NS,
                received_ns=CAPTURE_NS + 2_000_000,
            ),
            CameraEntry(node="window", status="silent", frame_id=0, capture_ns=0, received_ns=1),
        ),
    )
    yield "cameras", cameras, [], []
    stats = StatsMessage(
        node="server",
        capture_ns=CAPTURE_NS,
        state="running",
        detail="rendering on llvmpipe",
        rates={"composite": 12.5},
        drops={"color.desk": 3},
    )
    yield "stats", stats, [], []


def _command_examples() -> Iterator[Example]:
    request = ControlRequest(
        node="api",
        capture_ns=CAPTURE_NS,
        id="a1",
        op="set_scene",
        scene_id="4f0c2a9be1d37785",
        revision=4,
        payload={"name": "table"},
    )
    yield "request", request, [], []
    text = b'{"scene": {"name": "table"}}'
    long = ControlRequest(
        node="api", capture_ns=CAPTURE_NS, id="a2", op="set_scene", revision=5, payload_bytes=len(text)
    )
    yield "request_long", long, [text], []
    accepted = ControlReply(node="server", capture_ns=CAPTURE_NS, id="a1", ok=True, payload={"revision": 4})
    yield "reply_ok", accepted, [], []
    refused = ControlReply(
        node="server", capture_ns=CAPTURE_NS, id="a1", ok=False, error="the scene has no object: add one"
    )
    yield "reply_error", refused, [], []


if __name__ == "__main__":
    main()
