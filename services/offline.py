"""Offline rendering of a recording to files, frame by frame, for `deltalight render`."""

import json
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.files import replacing, write_png
from deltalight.protocol.frames import BoardPose, ViewFrame, linear_color
from deltalight.protocol.radiance_files import require_openexr, write_exr
from deltalight.protocol.scene import SceneDocument
from deltalight.protocol.source import Source
from deltalight.services.files import make_output_folder, require_absent
from deltalight.services.object_sizes import size_warnings
from deltalight.services.video_file import VIDEO_SUFFIX, require_video_support, video_file

if TYPE_CHECKING:
    from deltalight.relighting import RelitPicture
    from deltalight.render_server.renderer import CompositeFrame, SceneRenderer

    Write = Callable[[int, ViewFrame, CompositeFrame], None]

INDEX_FILE = "frames.jsonl"
# What people name who expect one file: a folder of that name would surprise them.
OTHER_FILES = {".avi", ".gif", ".jpeg", ".jpg", ".mkv", ".mov", ".mp4", ".png", ".webm"}


@dataclass(frozen=True)
class RenderJob:
    """A render job; `frames` are indices into the source."""

    source: Source
    scene: SceneDocument
    frames: range
    out: Path
    device: int | None = None
    with_exr: bool = False
    with_layers: bool = False

    @property
    def with_linear(self) -> bool:
        """Whether anything is written that is linear."""
        return self.with_exr or self.with_layers

    @property
    def is_video(self) -> bool:
        """Whether the pictures become one file."""
        return self.out.suffix == VIDEO_SUFFIX


@dataclass
class RenderSummary:
    """Summary of a finished job; `render_ms` holds each frame's time from input to pixels."""

    renderer: str
    out: Path
    without_pose: int = 0
    render_ms: list[float] = field(default_factory=list)

    def add(self, composite: "CompositeFrame", milliseconds: float) -> None:
        """Counts one frame."""
        self.render_ms.append(milliseconds)
        self.without_pose += composite.status == "no_pose"

    def as_dict(self) -> dict[str, Any]:
        """Returns the summary as plain data."""
        return {
            "frames": len(self.render_ms),
            "no_pose": self.without_pose,
            "mean_ms": round(sum(self.render_ms) / max(len(self.render_ms), 1), 3),
            "renderer": self.renderer,
            "out": str(self.out),
        }


def with_output(scene: SceneDocument, size: tuple[int, int] | None, view: str | None) -> SceneDocument:
    """Returns the scene with another output size (width, height) or view, if given."""
    changes: dict[str, object] = {}
    if size is not None:
        changes |= {"width": size[0], "height": size[1]}
    if view is not None:
        changes["view"] = view
    return scene.replaced(output=scene.output.replaced(**changes))


class Progress(Protocol):
    """Observer of a job."""

    def renderer(self, name: str, *, is_software: bool) -> None:
        """Reports the OpenGL renderer in use."""

    def notice(self, sentence: str) -> None:
        """Reports something that the user should read."""

    def frame_done(self) -> None:
        """Reports one more frame on disk."""


def run_job(job: RenderJob, progress: Progress) -> RenderSummary:
    """Renders every frame of the job.

    A picture is complete before its line in frames.jsonl is written, and each line is written at once, so an
    interrupted run leaves a valid shorter run.

    An `out` that ends in .mp4 is a video of the same pictures, which appears when all frames are rendered.

    Raises:
        DeltalightError: bad input, no OpenGL, or the output cannot be written.
    """
    from deltalight.render_server.gpu.context import create_context
    from deltalight.render_server.renderer import SceneRenderer

    if job.with_linear:
        require_openexr("--exr" if job.with_exr else "--layers exr")
    if job.is_video and job.with_linear:
        raise DeltalightError("--exr and --layers write files beside pictures; name a folder with --out.")
    if not job.is_video and job.out.suffix.lower() in OTHER_FILES:
        raise DeltalightError(
            f"'{job.out}' is not an output; name a folder for the pictures, or NAME{VIDEO_SUFFIX} for a video."
        )
    if job.is_video:
        require_video_support()
        require_absent(job.out)
    gpu = create_context(job.device, allow_software=True)
    try:
        progress.renderer(gpu.renderer_name, is_software=gpu.is_software)
        renderer = SceneRenderer(gpu, job.scene, with_linear=job.with_linear)
        try:
            for sentence in size_warnings(job.scene):
                progress.notice(sentence)
            with _written(job, progress) as write:
                return _render_frames(
                    job, renderer, RenderSummary(gpu.renderer_name, job.out), progress, write
                )
        finally:
            renderer.release()
    finally:
        gpu.release()


@contextmanager
def _written(job: RenderJob, progress: Progress) -> "Iterator[Write]":
    """Yields what writes a frame: to a folder, or to a video that appears at the end."""
    if not job.is_video:
        if (make_output_folder(job.out) / INDEX_FILE).exists():
            progress.notice(
                f"'{job.out}' has pictures of an earlier run; those of the same numbers are replaced."
            )
        yield partial(_write_frame, job)
        return
    times_ns = [job.source.timestamps_ns[number] for number in job.frames]
    with video_file(job.out, times_ns) as video:
        yield lambda _number, frame, composite: video.add(composite.color, frame.timestamp_ns)


def _render_frames(
    job: RenderJob, renderer: "SceneRenderer", summary: RenderSummary, progress: Progress, write: "Write"
) -> RenderSummary:
    from deltalight.relighting import RelitPicture
    from deltalight.sensor_node.fisheye import light_warnings
    from deltalight.take import Take

    take = Take(
        job.source,
        needs_depth=job.scene.real.geometry in ("depth", "fused"),
        needs_light=job.scene.lights.mode in ("fisheye", "tracked"),
    )
    notified = set(job.source.notes)
    warnings: list[str] | None = None
    for number in job.frames:
        frame = take[number]
        if number == job.frames.start:
            _require_light(job.scene, frame, take.notes)
        started_s = time.perf_counter()
        composite = renderer.render(frame)
        summary.add(composite, 1000 * (time.perf_counter() - started_s))
        if frame.radiance_map is not None and warnings is None:  # the first map represents all
            warnings = light_warnings(frame.radiance_map)
        for sentence in (*take.notes, *(warnings or ()), *renderer.notices):
            if sentence not in notified:
                progress.notice(sentence)
                notified.add(sentence)
        write(number, frame, composite)
        if job.with_layers:
            _write_layers(job, number, RelitPicture.of(renderer.sized(frame), composite, renderer.layers()))
        progress.frame_done()
    return summary


def _require_light(scene: SceneDocument, frame: ViewFrame, notes: Sequence[str]) -> None:
    """Refuses a source without fish-eye light if the scene needs it.

    The first pictures apply to all earlier frames.
    """
    if scene.lights.mode == "fisheye" and frame.radiance_map is None and frame.pose is not None:
        reason = "".join(f" ({note.rstrip('.')})" for note in notes)
        raise DeltalightError(
            f"the scene's light is the fish-eye camera's but the source shows none{reason}; give fisheye.txt with "
            "its pictures and calibration, or another lights.mode."
        )


def _write_frame(job: RenderJob, number: int, frame: ViewFrame, composite: "CompositeFrame") -> None:
    write_png(job.out / f"{number:06d}.png", composite.color)
    if job.with_exr:
        linear = linear_color(frame, composite.color) if composite.linear is None else composite.linear
        with replacing(job.out / f"{number:06d}.exr") as temporary:
            write_exr(temporary, linear)
    mode = "w" if number == job.frames.start else "a"  # the first picture replaces an older run's index
    with (job.out / INDEX_FILE).open(mode, encoding="utf-8") as index:
        index.write(json.dumps(frame_record(number, frame, composite)) + "\n")


def _write_layers(job: RenderJob, number: int, picture: "RelitPicture") -> None:
    """Writes the picture so that compositing programs can redo it: plate x ratio, and RGBA over it."""
    over = np.dstack([picture.additive, picture.coverage])
    with replacing(job.out / f"{number:06d}.layers.exr") as temporary:
        write_exr(temporary, over, {"ratio": picture.ratio, "Z": picture.depth})


def frame_record(number: int, frame: ViewFrame, composite: "CompositeFrame") -> dict[str, Any]:
    """Returns the line of frames.jsonl for one frame."""
    return {
        "frame": number,
        "timestamp": frame.timestamp_ns / 1e9,
        "timestamp_ns": frame.timestamp_ns,
        "status": composite.status,
        "pose": _pose_record(frame.pose),
        "lights": composite.lights,
        "pass_times_ms": {name: round(value, 4) for name, value in composite.pass_times_ms.items()},
        "drops": 0,  # every frame of a file is rendered
    }


def _pose_record(pose: BoardPose | None) -> dict[str, Any] | None:
    if pose is None:
        return None
    return {
        "world_from_camera": pose.world_from_camera.tolist(),
        "reprojection_error_px": pose.reprojection_error_px,
    }
