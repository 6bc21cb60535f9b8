"""Copies of recordings: recovery, and conversion from and to dataset folders."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path

from deltalight.protocol.dataset import open_dataset
from deltalight.protocol.dataset_writer import DEFAULT_DEPTH_SCALE, DatasetWriter
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.files import ACTIVE_SUFFIX
from deltalight.protocol.recording_reader import RecordingReader
from deltalight.protocol.recording_writer import RecordingWriter
from deltalight.protocol.scene import SceneDocument, load_scene
from deltalight.services.files import appearing, make_output_folder, require_absent, require_recording_name
from deltalight.services.recording_info import RecordingScan, scan_recording

SCENE_FILE = "scene.json"

# Iterates over frame numbers and shows progress.
Track = Callable[[range], Iterable[int]]


@dataclass(frozen=True)
class Copied:
    """Result of a copy: how many frames were written and lost, and sentences for the user."""

    out: Path
    frames: int
    lost: int = 0
    notes: list[str] = field(default_factory=list)


def recovered_name(path: Path) -> Path:
    """Returns the default path of a recovered recording: `NAME.mcap` of `NAME.mcap.active`, else a name beside it."""
    if path.name.endswith(ACTIVE_SUFFIX):
        return path.with_name(path.name.removesuffix(ACTIVE_SUFFIX))
    return path.with_name(f"{path.stem}-recovered.mcap")


def recover_recording(path: Path, out: Path, track: Track) -> Copied | None:
    """Writes all readable frames to a new, finished recording; returns None if there is nothing to recover.

    The recording itself is only read; `out` appears when it is complete.

    Raises:
        DeltalightError: no frame can be read, `out` is taken, or the disk refuses.
    """
    require_recording_name(out)
    reader, scan = RecordingReader(path), scan_recording(path)
    if scan.is_finished and not scan.damaged and path.suffix != ACTIVE_SUFFIX:
        return None
    lost = 0
    with appearing(out) as temporary, _writer_like(temporary, reader, scan) as writer:
        for index in track(range(len(reader))):
            try:
                frame = reader[index]
            except DeltalightError:
                lost += 1
            else:
                writer.add(frame)
        if lost == len(reader):
            raise DeltalightError(f"{path} holds no frame that can be read; record it again.")
    return Copied(out, len(reader) - lost, lost, [*reader.notes, *_losses(scan, lost)])


def _writer_like(out: Path, reader: RecordingReader, scan: RecordingScan) -> RecordingWriter:
    return RecordingWriter(
        out,
        board=reader.board,
        extrinsics=reader.extrinsics,
        scene=reader.scene,
        depth_scale=scan.depth_scale,
    )


def _losses(scan: RecordingScan, lost: int) -> list[str]:
    notes = [f"{lost} damaged frames were left out."] if lost else []
    if scan.unread_bytes:
        notes.append(f"The last {scan.unread_bytes} bytes are not a complete record.")
    return notes


def import_folder(folder: Path, out: Path, scene: Path | None, track: Track) -> Copied:
    """Writes a dataset folder as a recording, with the scene `scene`, else scene.json in the folder if it exists.

    Colour keeps its JPEG bytes, everything else its pixels. `out` appears when it is complete.

    Raises:
        DeltalightError: the folder or the scene is wrong, `out` is taken, or the disk refuses.
    """
    require_recording_name(out)
    source = open_dataset(folder)
    document = _scene_of(folder, scene)
    with (
        appearing(out) as temporary,
        RecordingWriter(
            temporary,
            board=source.board,
            extrinsics=source.extrinsics,
            scene=document,
            depth_scale=source.depth_scale,
        ) as writer,
    ):
        for index in track(range(len(source))):
            writer.add(source[index])
    return Copied(out, len(source), notes=source.notes)


def _scene_of(folder: Path, scene: Path | None) -> SceneDocument | None:
    path = scene or folder / SCENE_FILE
    return load_scene(path) if scene is not None or path.is_file() else None


def export_recording(path: Path, out: Path, track: Track) -> Copied:
    """Writes a recording as a dataset folder, with its scene as scene.json.

    The folder appears when it is complete; a killed process leaves a hidden one beside it.

    Raises:
        DeltalightError: a frame is damaged, cameras change within the recording, `out` is taken, or the disk refuses.
    """
    require_absent(out)
    make_output_folder(out.parent)
    reader, scan = RecordingReader(path), scan_recording(path)
    with (
        appearing(out) as temporary,
        DatasetWriter(
            temporary, board=reader.board, extrinsics=reader.extrinsics, depth_scale=scan.depth_scale
        ) as writer,
    ):
        for index in track(range(len(reader))):
            writer.add(reader[index])
        if reader.scene is not None:
            text = reader.scene.model_dump_json(indent=1)
            (temporary / SCENE_FILE).write_text(text, encoding="utf-8")
    return Copied(out, len(reader), notes=[*reader.notes, *_rounding(scan)])


def _rounding(scan: RecordingScan) -> list[str]:
    if scan.depth_scale is not None or not any(frame.depth for frame in scan.frames):
        return []
    return [
        f"The depth of {scan.path} is not in steps of one size; folders keep steps, so it was rounded to those of"
        f" the first frame (else {1000 * DEFAULT_DEPTH_SCALE:g} mm)."
    ]
