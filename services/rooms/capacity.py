"""How many rooms a device holds by what `deltalight gpu-check` measured, and whether a host's claim is true."""

import json
import math
import re
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from deltalight.protocol.errors import DeltalightError
from deltalight.services.rooms.rooms_file import MAX_ROOMS, RoomsFile

if TYPE_CHECKING:
    from deltalight.render_server.gpu.device_memory import FoundDevice

GPU_LABEL, MEMORY_LABEL = "gpu", "gpu-memory-mb"  # of a host of a cluster: what it claims to be
USED_FRACTION = 0.9  # of a device's memory; the rest is for the driver, and for what else runs
CLAIMED_FRACTION = 0.95  # of the claimed memory that must be there: drivers keep some to themselves
PROBE_TIMEOUT_S = 60.0
MAKE_REPORT = "make it on this host with `deltalight gpu-check --steps memory,speed`"
# What reading JSON of another kind raises: text that is none, other keys and types, numbers beyond all, deep nesting.
_NO_FIGURES = (
    ValueError,
    KeyError,
    TypeError,
    AttributeError,
    StopIteration,
    OverflowError,
    RecursionError,
)
_PROBE = """
import json, sys
from dataclasses import asdict
from deltalight.render_server.gpu.device_memory import find_device
device = json.loads(sys.argv[1])
print(json.dumps(asdict(find_device(device))))
"""


class FalseClaimError(DeltalightError):
    """A host does not have what it claims."""


@dataclass(frozen=True)
class RoomFigures:
    """What one room takes of a device of this `device` name: memory, and time a frame of the slowest method."""

    path: Path
    device: str
    room_bytes: int
    frame_ms: float


def load_figures(path: Path) -> RoomFigures:
    """Reads the figures of a room from `report.json` of `deltalight gpu-check`.

    Raises:
        DeltalightError: it is not there, or lacks the steps `memory` or `speed`.
    """
    try:
        report = json.loads(path.read_bytes())
        memory, speed = (report["steps"][step]["figures"] for step in ("memory", "speed"))
        methods = next(iter(speed["timed"].values()))
        frame_ms = max(max(method["frames_ms"].values()) for method in methods.values())
        figures = RoomFigures(path, str(report["gpu"]), int(memory["room_bytes"]), float(frame_ms))
        if figures.room_bytes < 1 or not 0 < figures.frame_ms < math.inf:
            raise ValueError("a room takes memory and time")
        return figures
    except OSError as fault:
        raise DeltalightError(f"{path} cannot be read ({fault.strerror}); {MAKE_REPORT}.") from fault
    except _NO_FIGURES as fault:
        raise DeltalightError(f"{path} lacks memory or frame times of a room; {MAKE_REPORT}.") from fault


def find_device_apart(device: int | None) -> "FoundDevice":
    """Asks an EGL device in a process of its own, because a process has one context.

    Raises:
        DeltalightError: the device cannot be used.
    """
    from deltalight.render_server.gpu.device_memory import FoundDevice

    command = [sys.executable, "-P", "-c", _PROBE, json.dumps(device)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=PROBE_TIMEOUT_S, check=True)
        return FoundDevice(**json.loads(done.stdout))
    except (OSError, subprocess.SubprocessError, ValueError) as fault:
        said = (getattr(fault, "stderr", None) or str(fault)).strip().splitlines()
        where = "the first EGL device" if device is None else f"EGL device {device}"
        raise DeltalightError(
            f"{where} cannot be queried ({said[-1] if said else 'it said nothing'}); see `deltalight doctor`."
        ) from fault


def slots_of(figures: RoomFigures, found: "FoundDevice", frames_per_s: float) -> int:
    """Returns how many rooms a device holds: by memory, and by the time that frames take (at least one).

    Raises:
        DeltalightError: the figures are another device's, or not even one room fits.
    """
    if figures.device != found.name:
        raise DeltalightError(
            f"the figures in {figures.path} are for {figures.device}, and this host renders on {found.name}; make"
            " them here with `deltalight gpu-check --steps memory,speed`."
        )
    by_time = max(1, int(1000.0 / frames_per_s / figures.frame_ms))
    if found.memory_bytes is None:
        raise DeltalightError(
            f"the driver of {found.name} does not report its memory; give `slots` as a number."
        )
    by_memory = int(found.memory_bytes * USED_FRACTION / figures.room_bytes)
    if by_memory < 1:
        raise DeltalightError(
            f"{found.name} has {found.memory_bytes >> 20} MiB, and a room takes {figures.room_bytes >> 20}: no room"
            " fits; use another device."
        )
    return min(by_memory, by_time)


def with_slots(
    rooms: RoomsFile,
    devices: Sequence[int],
    find: "Callable[[int | None], FoundDevice]" = find_device_apart,
) -> RoomsFile:
    """Returns the rooms file with a number for `slots: auto`: what these EGL devices hold, without any the first one.

    Raises:
        DeltalightError: the figures are not there or another device's, or no room fits.
    """
    if rooms.slots != "auto":
        return rooms
    assert rooms.figures is not None
    figures = load_figures(rooms.figures)
    numbers: Sequence[int | None] = devices or (None,)
    slots = [device for device in numbers for _ in range(slots_of(figures, find(device), rooms.frames_per_s))]
    return rooms.replaced(slots=tuple(slots[:MAX_ROOMS]))


def labels_of(found: "FoundDevice") -> dict[str, str]:
    """Returns the labels by which a host of a cluster claims its device."""
    labels = {GPU_LABEL: label_text(found.name)}
    if found.memory_bytes is not None:
        labels[MEMORY_LABEL] = str(found.memory_bytes >> 20)
    return labels


def label_text(name: str) -> str:
    """Returns the name of a device as a label's value: letters, digits, `-`, `_` and `.`, at most 63 of them."""
    return re.sub(r"[^A-Za-z0-9._-]+", "-", name).strip("-_.")[:63].strip("-_.")


def is_claim(labels: Mapping[str, str]) -> bool:
    """Whether a host says which device it has."""
    return GPU_LABEL in labels or MEMORY_LABEL in labels


def check_claim(
    host: str, labels: Mapping[str, str], slots: int, found: "FoundDevice", figures: RoomFigures | None
) -> None:
    """Checks what a host of a cluster says of its device, and with `figures` whether `slots` rooms fit on that.

    Raises:
        FalseClaimError: it does not have what it claims.
    """
    claimed, memory_mb = labels.get(GPU_LABEL), _number(labels.get(MEMORY_LABEL))
    has_mb = None if found.memory_bytes is None else found.memory_bytes >> 20
    if claimed is not None and claimed != label_text(found.name):
        fault = f"it claims the device {claimed} and renders on {found.name}"
    elif memory_mb is not None and (has_mb is None or has_mb < memory_mb * CLAIMED_FRACTION):
        has = "its driver does not tell" if has_mb is None else f"has {has_mb}"
        fault = f"it claims {memory_mb} MiB of memory and {has}"
    elif figures is not None and has_mb is not None and slots * figures.room_bytes >> 20 > has_mb:
        needed_mb = slots * figures.room_bytes >> 20
        fault = f"it claims {slots} slots a device, which take {needed_mb} MiB, and has {has_mb}"
    else:
        return
    raise FalseClaimError(f"the host {host} is refused: {fault}; start Ray there with what it has.")


def _number(text: Any) -> int | None:  # noqa: ANN401 (whatever a label holds)
    return int(text) if isinstance(text, str) and text.isdecimal() else None
