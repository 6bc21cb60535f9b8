"""A recording or dataset folder in another program's format."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

from deltalight.protocol.counts import counted
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.scene import SceneDocument, load_scene
from deltalight.protocol.source import Source, open_source
from deltalight.services.exports import ExportFormat
from deltalight.services.exports.colmap import write_colmap
from deltalight.services.exports.nerfstudio import write_nerfstudio
from deltalight.services.exports.posed_views import PosedView, posed_views
from deltalight.services.exports.ros_bags import Version, export_bag
from deltalight.services.exports.scene_glb import write_scene_glb
from deltalight.services.exports.video import export_video
from deltalight.services.files import appearing, make_output_folder, require_absent
from deltalight.services.recording_copies import Copied, Track, export_recording

GLB = ".glb"


def export_as(wanted: ExportFormat, path: Path, out: Path, scene: Path | None, track: Track) -> Copied:
    """Writes a recording in a format; `scene` replaces the attached scene document (glb alone has it).

    Raises:
        DeltalightError: the format needs other poses or another lens, `out` is taken, or the disk refuses.
    """
    if scene is not None and wanted is not ExportFormat.GLB:
        raise DeltalightError("--scene belongs to --format glb; leave it out.")
    match wanted:
        case ExportFormat.DATASET:
            return export_recording(path, out, track)
        case ExportFormat.ROS1 | ExportFormat.ROS2:
            version: Version = "ros1" if wanted is ExportFormat.ROS1 else "ros2"
            return export_bag(open_source(path), out, version, track)
        case ExportFormat.GLB:
            return _export_glb(open_source(path), out, scene, track)
        case ExportFormat.MP4:
            return export_video(open_source(path), out, track)
        case ExportFormat.COLMAP:
            return _export_folder(open_source(path), out, write_colmap, track)
        case ExportFormat.NERFSTUDIO:
            return _export_folder(open_source(path), out, write_nerfstudio, track)


Writer = Callable[[Path, Iterator[PosedView]], int]


def _export_folder(source: Source, out: Path, write: Writer, track: Track) -> Copied:
    make_output_folder(out.parent)
    with appearing(out) as temporary:
        count = write(temporary, posed_views(source, track))
    return _with_poses(Copied(out, count, notes=source.notes), source)


def _export_glb(source: Source, out: Path, scene: Path | None, track: Track) -> Copied:
    if out.suffix != GLB:
        raise DeltalightError(f"{out} must end in {GLB}; choose another name.")
    require_absent(out)
    make_output_folder(out.parent)
    document = load_scene(scene) if scene is not None else source.scene or SceneDocument()
    exported = write_scene_glb(out, document, posed_views(source, track))
    return _with_poses(Copied(out, exported.frames, notes=[*source.notes, *exported.notes]), source)


def _with_poses(copied: Copied, source: Source) -> Copied:
    """Says how many frames have no pose."""
    missing = len(source) - copied.frames
    note = [f"Left out: {counted(missing, 'frame')} without a pose."] if missing else []
    return replace(copied, notes=[*copied.notes, *note])
