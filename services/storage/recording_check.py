"""The check of an uploaded recording, in the worker: an .mcap file, or a .zip of a dataset folder made into one."""

import posixpath
import zipfile
from pathlib import Path, PurePosixPath

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.recording_reader import RecordingReader
from deltalight.services.recording_copies import SCENE_FILE, import_folder
from deltalight.services.recording_info import describe_recording
from deltalight.services.storage.archive import Archive, unpacking
from deltalight.services.storage.asset_kinds import Facts

MCAP_MAGIC, ZIP_MAGIC = b"\x89MCAP0\r\n", b"PK\x03\x04"
MAX_FILES = 100_000
COLORS = "rgb.txt"
CONTENTS = "one dataset folder"
LISTS = (COLORS, "depth.txt", "composite.txt", "fisheye.txt", "groundtruth.txt")


def check_recording(path: Path, out: str, limit: str) -> Facts:
    """Checks a recording; makes `out` of a zipped dataset folder, of at most `limit` bytes unpacked.

    Raises:
        DeltalightError: it is neither, or cannot be read.
    """
    with path.open("rb") as file:
        head = file.read(len(MCAP_MAGIC))
    is_zip = head.startswith(ZIP_MAGIC)
    if not is_zip and head != MCAP_MAGIC:
        raise DeltalightError(f"{path} is neither an .mcap recording nor a .zip of a dataset folder.")
    recording = _imported(path, Path(out), int(limit)) if is_zip else path
    if not describe_recording(recording)["is_finished"]:
        raise DeltalightError(f"{path} was cut off; `deltalight recordings recover` repairs it.")
    reader = RecordingReader(recording)
    for index in {0, len(reader) - 1}:
        _ = reader[index]
    return {"is_made": is_zip}


def _imported(path: Path, out: Path, limit_bytes: int) -> Path:
    folder = out.with_suffix("")
    with unpacking(path), zipfile.ZipFile(path) as opened:
        archive = Archive(opened, path, limit_bytes, MAX_FILES, CONTENTS)
        roots = [posixpath.dirname(name) for name in archive.entries if posixpath.basename(name) == COLORS]
        if len(roots) != 1:
            raise DeltalightError(
                f"{path} holds {len(roots)} folders with {COLORS}; pack one dataset folder."
            )
        root = PurePosixPath(roots[0])
        inside = [name for name in archive.entries if PurePosixPath(name).is_relative_to(root)]
        for name in inside:
            target = PurePosixPath(name).relative_to(root)
            if str(target) != SCENE_FILE:  # which names files of another machine
                archive.unpack(name, folder / target)
    try:
        for name in LISTS:
            _require_inside(folder / name)
        import_folder(folder, out, None, lambda numbers: numbers)
    except DeltalightError as fault:
        raise DeltalightError(str(fault).replace(f"{folder}/", "").replace(str(folder), str(path))) from fault
    return out


def _require_inside(path: Path) -> None:
    """Refuses a list that names files outside of its folder.

    Raises:
        DeltalightError: it does.
    """
    if not path.is_file():
        return
    for word in path.read_text(encoding="utf-8", errors="replace").split():
        if word.startswith("/") or ".." in PurePosixPath(word.replace("\\", "/")).parts:
            raise DeltalightError(
                f"{path} names {word!r:.200}, outside of the dataset folder; correct the list."
            )
