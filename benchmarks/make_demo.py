"""Make the demo that the project ships: `python -m deltalight.benchmarks.make_demo --out DIR` (needs Mitsuba).

Writes demo.mcap (the room of `ground_truth/scene_demo.py` as sensors see it), object.glb, facts.json (what the check
of assets finds in it) and scene.json. With `--truth DIR` also the first frame without noise, without and with the
object, as PNG and linear NPY.
"""

import json
import sys
import tempfile
from hashlib import sha256
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from jaxtyping import Float32
from PIL import Image
from rich.progress import Progress

from deltalight.benchmarks.ground_truth import scene_demo
from deltalight.benchmarks.ground_truth.demo_object import write_glb
from deltalight.benchmarks.ground_truth.render import RoomRenderer, choose_variant
from deltalight.benchmarks.ground_truth.sensors import ColorSensor, StereoDepthSensor, srgb_bytes
from deltalight.protocol.codecs import encode_color
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import DepthImage, SensorFrame
from deltalight.protocol.pictures import decode_rgb, depth_from_steps
from deltalight.protocol.recording_writer import RecordingWriter
from deltalight.protocol.scene import load_scene
from deltalight.services.storage.asset_facts import mesh_facts
from deltalight.services.storage.asset_kinds import Facts

SEED = 20210
JPEG_QUALITY = 85
DEPTH_SAMPLES = 16
FIRST_CAPTURE_NS = 1_000_000_000

Views = dict[float, tuple[Float32[np.ndarray, "h w 3"], Float32[np.ndarray, "h w"]]]


def render_views(mesh_folder: Path, spp: int, progress: Progress) -> Views:
    """Renders colour and depth without noise for each different pose of the take, by the camera's x coordinate."""
    room = RoomRenderer(scene_demo.mitsuba_scene(mesh_folder, with_object=False), scene_demo.CAMERA)
    poses = {_pose_key(frame): scene_demo.world_from_camera(frame) for frame in range(scene_demo.FRAME_COUNT)}
    views: Views = {}
    for number, (key, pose) in enumerate(progress.track(poses.items(), description="rendering views")):
        color = room.color(pose, spp=spp, seed=SEED + number)
        views[key] = color, room.depth(pose, spp=DEPTH_SAMPLES, seed=SEED + number)
    return views


def _pose_key(frame: int) -> float:
    """Returns a key of the pose: the swing returns along its own path, so most poses occur twice."""
    return round(float(scene_demo.world_from_camera(frame)[0, 3]), 9)


def sensor_frame(
    frame: int, color: Float32[np.ndarray, "h w 3"], depth_m: Float32[np.ndarray, "h w"]
) -> SensorFrame:
    """Returns one frame as the sensors deliver it; noise depends only on the frame's number."""
    rng = np.random.default_rng([SEED, frame])
    jpeg = encode_color(ColorSensor().expose(color, rng), "jpeg", JPEG_QUALITY)
    stereo = StereoDepthSensor()
    steps = stereo.measure(depth_m, rng)
    depth: DepthImage = depth_from_steps(steps, stereo.step_m, scene_demo.CAMERA, stereo.sigma_at_1m)
    capture_ns = FIRST_CAPTURE_NS + round(frame * 1e9 / scene_demo.FRAME_RATE_HZ)
    return SensorFrame(
        frame_id=frame,
        timestamp_ns=capture_ns,
        color=decode_rgb(jpeg, f"frame {frame}"),
        camera=scene_demo.CAMERA,
        depth=depth,
        depth_timestamp_ns=capture_ns,
        color_jpeg=jpeg,
    )


def write_demo(out: Path, spp: int, progress: Progress) -> None:
    """Writes the demo's files into `out`, replacing older ones when all are complete."""
    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=out, prefix=".making-") as folder:
        made = Path(folder)
        views = render_views(made, spp, progress)
        write_glb(made / "object.glb")
        (made / "facts.json").write_text(json.dumps(facts_by_digest(made / "object.glb"), indent=1) + "\n")
        (made / "scene.json").write_text(json.dumps(scene_demo.scene_document(), indent=2) + "\n")
        scene = load_scene(made / "scene.json")
        step_m = StereoDepthSensor().step_m
        with RecordingWriter(
            made / "demo.mcap", board=scene_demo.BOARD, scene=scene, depth_scale=step_m
        ) as recording:
            for frame in progress.track(range(scene_demo.FRAME_COUNT), description="writing frames"):
                recording.add(sensor_frame(frame, *views[_pose_key(frame)]))
        for name in ("object.glb", "facts.json", "scene.json", "demo.mcap"):
            (made / name).replace(out / name)


def facts_by_digest(mesh: Path) -> dict[str, Facts]:
    """Returns what `storage.assets` need not find out again: the facts of a mesh file, by the hash of its content."""
    return {sha256(mesh.read_bytes()).hexdigest(): mesh_facts(mesh)}


def write_truth(out: Path, spp: int, progress: Progress) -> None:
    """Writes the first frame without noise: {without,with}.png (sRGB) and .npy (linear camera units)."""
    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        for name in progress.track(("without", "with"), description="rendering truth"):
            scene = scene_demo.mitsuba_scene(Path(folder), with_object=name == "with")
            room = RoomRenderer(scene, scene_demo.CAMERA)
            color = room.color(scene_demo.world_from_camera(0), spp=spp, seed=SEED)
            np.save(out / f"{name}.npy", color)
            Image.fromarray(srgb_bytes(color)).save(out / f"{name}.png")


def main(
    out: Annotated[Path, typer.Option(help="Folder for demo.mcap, object.glb, facts.json and scene.json.")],
    spp: Annotated[int, typer.Option(min=1, help="Light paths per pixel of the recording.")] = 192,
    truth: Annotated[Path | None, typer.Option(help="Folder for noise-free pictures of frame 0.")] = None,
    truth_spp: Annotated[int, typer.Option(min=1, help="Light paths per pixel of these.")] = 1024,
) -> None:
    """Renders the demo recording and its virtual object."""
    try:
        variant = choose_variant()
        with Progress() as progress:
            progress.console.print(f"Mitsuba renders with {variant}")
            write_demo(out, spp, progress)
            if truth is not None:
                write_truth(truth, truth_spp, progress)
    except DeltalightError as error:
        sys.stderr.write(f"error: {error}\n")
        raise typer.Exit(2) from error


if __name__ == "__main__":
    typer.run(main)
