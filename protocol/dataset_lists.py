"""The list files of a dataset folder (docs/formats.md 1): rgb.txt, depth.txt, fisheye.txt, groundtruth.txt."""

import statistics
from bisect import bisect_left
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from decimal import Decimal
from itertools import pairwise, takewhile
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.files import is_file
from deltalight.protocol.poses import interpolate_pose, rigid_matrix, rotation_from_wxyz

MAX_TIMESTAMP_NS = 2**63 - 1
MAX_PAIRING_NS = 20_000_000
MAX_POSE_GAP_NS = 200_000_000


@dataclass(frozen=True)
class ListEntry:
    """One line of a list file: capture time, picture, and the exposure if a third column gives it."""

    timestamp_ns: int
    path: Path
    exposure_s: float | None = None


@dataclass(frozen=True)
class FisheyeEntry:
    """A fish-eye picture, or the bracket of pictures with one timestamp (exposures None if not given)."""

    timestamp_ns: int
    paths: tuple[Path, ...]
    exposures_s: tuple[float | None, ...]


@dataclass(frozen=True, eq=False)
class PoseEntry:
    """One line of groundtruth.txt: world_from_camera (4, 4) at a time."""

    timestamp_ns: int
    world_from_camera: Float64[np.ndarray, "4 4"]


def read_list(path: Path) -> list[ListEntry]:
    """Reads `timestamp filename [exposure_s]` lines; times must not run backwards, files must exist.

    Raises:
        DeltalightError: the file is missing, or the first line that is wrong.
    """
    entries: list[ListEntry] = []
    for place, words in _lines(path):
        if len(words) < 2:
            raise DeltalightError(f"{place} has no filename; write `timestamp filename`.")
        entries.append(_list_entry(place, words, path.parent))
        if len(entries) > 1 and entries[-1].timestamp_ns < entries[-2].timestamp_ns:
            raise DeltalightError(f"{place} is earlier than the line before; sort the list by time.")
    if not entries:
        raise DeltalightError(f"{path} names no picture; write lines `timestamp filename`.")
    lost = [entry.path for entry in entries if not is_file(entry.path)]
    if len(lost) == 1:
        raise DeltalightError(
            f"{path} names {lost[0]!s:.500}, which is missing; restore it or take it off the list."
        )
    if lost:
        raise DeltalightError(
            f"{path} names {len(lost)} missing files, first {lost[0]!s:.500}; restore them or cut the list."
        )
    return entries


def require_increasing(entries: Sequence[ListEntry], path: Path) -> None:
    """Refuses two pictures of one time, because frames are identified by their time.

    Raises:
        DeltalightError: names the first picture that repeats a time.
    """
    for before, entry in pairwise(entries):
        if entry.timestamp_ns == before.timestamp_ns:
            raise DeltalightError(
                f"{path} gives {entry.path.name} the time of {before.path.name}; keep one of them."
            )


def _lines(path: Path) -> Iterator[tuple[str, list[str]]]:
    """Yields (place, words) of every line that is neither empty nor a comment."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise DeltalightError(
            f"the list file {path} cannot be read; write lines `timestamp filename`."
        ) from error
    for number, line in enumerate(text.splitlines(), start=1):
        # A hash within a word belongs to a filename.
        if words := list(takewhile(lambda word: not word.startswith("#"), line.split())):
            yield f"{path} line {number}", words


def _list_entry(place: str, words: list[str], folder: Path) -> ListEntry:
    exposure, name = None, words[1:]
    if len(name) > 1:
        exposure = _exposure(name[-1])
        name = name if exposure is None else name[:-1]
    return ListEntry(parse_timestamp(place, words[0]), folder / " ".join(name), exposure)


def _exposure(word: str) -> float | None:
    try:
        value = float(word)
    except ValueError:
        return None
    return value if 0 < value < 3600 else None


def parse_timestamp(place: str, word: str) -> int:
    """Parses seconds as text into nanoseconds, exactly.

    Raises:
        DeltalightError: not a number, negative, or beyond 64 bits.
    """
    try:
        nanoseconds = Decimal(word) * 10**9
        is_known = 0 <= nanoseconds <= MAX_TIMESTAMP_NS  # as a whole number 1e999999 would take for ever
    except ArithmeticError:
        is_known = False
    if not is_known:
        raise DeltalightError(f"{place} has the timestamp `{word:.60}`; write seconds, zero or more.")
    return int(nanoseconds)


def format_timestamp(timestamp_ns: int) -> str:
    """Formats nanoseconds as seconds, exactly."""
    return f"{timestamp_ns // 10**9}.{timestamp_ns % 10**9:09d}"


def default_tolerance_ns(timestamps_ns: Sequence[int]) -> int:
    """Returns the largest time difference of a pair: half the median colour period, at most 20 ms."""
    if len(timestamps_ns) < 2:
        return MAX_PAIRING_NS
    periods = [after - before for before, after in pairwise(timestamps_ns)]
    return min(int(statistics.median(periods) // 2), MAX_PAIRING_NS)


def nearest_index(timestamps_ns: Sequence[int], wanted_ns: int, tolerance_ns: int) -> int | None:
    """Returns the index of the nearest of the sorted times, or None if none is within the tolerance."""
    right = bisect_left(timestamps_ns, wanted_ns)
    candidates = [index for index in (right - 1, right) if 0 <= index < len(timestamps_ns)]
    best = min(candidates, key=lambda index: abs(timestamps_ns[index] - wanted_ns), default=None)
    return best if best is not None and abs(timestamps_ns[best] - wanted_ns) <= tolerance_ns else None


def read_fisheye_list(path: Path) -> list[FisheyeEntry]:
    """Reads fisheye.txt; lines of one timestamp are an exposure bracket.

    Raises:
        DeltalightError: as `read_list`, or a bracket without exposures.
    """
    groups: dict[int, list[ListEntry]] = {}
    for entry in read_list(path):
        groups.setdefault(entry.timestamp_ns, []).append(entry)
    for group in groups.values():
        if len(group) > 1 and any(entry.exposure_s is None for entry in group):
            raise DeltalightError(
                f"{path} has a bracket without exposures; write exposure_s as the third column."
            )
    return [
        FisheyeEntry(time, tuple(entry.path for entry in group), tuple(entry.exposure_s for entry in group))
        for time, group in groups.items()
    ]


def read_poses(path: Path) -> list[PoseEntry]:
    """Reads groundtruth.txt: `timestamp tx ty tz qx qy qz qw` = world_from_camera, sorted by time.

    Raises:
        DeltalightError: names the first line that is wrong.
    """
    return sorted(
        (_pose_entry(place, words) for place, words in _lines(path)), key=lambda pose: pose.timestamp_ns
    )


def _pose_entry(place: str, words: list[str]) -> PoseEntry:
    try:
        x, y, z, qx, qy, qz, qw = (float(word) for word in words[1:])
    except ValueError:
        raise DeltalightError(f"{place} is not `timestamp tx ty tz qx qy qz qw`; write 8 numbers.") from None
    values = np.array([x, y, z, qx, qy, qz, qw])
    if not np.isfinite(values).all() or np.abs(values).max() > 1e6 or np.linalg.norm(values[3:]) < 1e-3:
        raise DeltalightError(f"{place} holds no usable pose; write finite metres and a unit quaternion.")
    matrix = rigid_matrix(rotation_from_wxyz((qw, qx, qy, qz)), (x, y, z))
    return PoseEntry(parse_timestamp(place, words[0]), matrix)


def pose_at(
    poses: Sequence[PoseEntry], times_ns: Sequence[int], wanted_ns: int, tolerance_ns: int
) -> Float64[np.ndarray, "4 4"] | None:
    """Returns the pose at a time, or None if unknown.

    It is interpolated between two poses at most 0.2 s apart, else the nearest one within the tolerance.
    """
    right = bisect_left(times_ns, wanted_ns)
    if 0 < right < len(poses) and times_ns[right] != wanted_ns:
        gap = times_ns[right] - times_ns[right - 1]
        if 0 < gap <= MAX_POSE_GAP_NS:
            fraction = (wanted_ns - times_ns[right - 1]) / gap
            start, end = poses[right - 1], poses[right]
            return interpolate_pose(start.world_from_camera, end.world_from_camera, fraction)
    index = nearest_index(times_ns, wanted_ns, tolerance_ns)
    return None if index is None else poses[index].world_from_camera
