"""Slots by what a room takes of a device, and hosts that do not have what they claim."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from deltalight.protocol.errors import DeltalightError
from deltalight.render_server.gpu.device_memory import (
    FoundDevice,
    device_memory,
    free_host_memory,
    host_memory,
)
from deltalight.services.rooms.capacity import (
    FalseClaimError,
    RoomFigures,
    check_claim,
    find_device_apart,
    label_text,
    labels_of,
    load_figures,
    slots_of,
    with_slots,
)
from deltalight.services.rooms.rooms_file import RoomsFile, load_rooms
from tests.services.conftest import RunCli

GIB = 1 << 30
CARD = "NVIDIA RTX A4000/PCIe/SSE2"
FIGURES = RoomFigures(Path("report.json"), CARD, 1 * GIB, 4.0)


def card(memory_bytes: int | None = 16 * GIB, name: str = CARD) -> FoundDevice:
    return FoundDevice(name, is_software=False, memory_bytes=memory_bytes)


def report(gpu: str = CARD, room_bytes: int = GIB) -> dict[str, Any]:
    frames = {"exact": {"frames_ms": {"camera": 4.0, "still": 1.0}}, "none": {"frames_ms": {"camera": 0.5}}}
    steps = {
        "memory": {"figures": {"room_bytes": room_bytes}},
        "speed": {"figures": {"timed": {"s": frames}}},
    }
    return {"gpu": gpu, "steps": steps}


def test_memory_and_time_both_limit_the_slots() -> None:
    assert slots_of(FIGURES, card(16 * GIB), 30) == 8, "a thirtieth of a second holds 8 frames of 4 ms"
    assert slots_of(FIGURES, card(6 * GIB), 30) == 5, "9/10 of 6 GiB hold 5 rooms"
    assert slots_of(FIGURES, card(16 * GIB), 240) == 1
    slow = RoomFigures(Path("r"), CARD, GIB, 400.0)
    assert slots_of(slow, card(), 30) == 1, "a room that is slow alone still runs"


@pytest.mark.parametrize(
    ("found", "sentence"),
    [
        (card(GIB), "no room fits"),
        (card(None), "does not report its memory"),
        (card(name="llvmpipe"), "are for NVIDIA RTX A4000/PCIe/SSE2, and this host renders on llvmpipe"),
    ],
)
def test_devices_that_figures_do_not_fit_are_refused(found: FoundDevice, sentence: str) -> None:
    with pytest.raises(DeltalightError, match=sentence):
        slots_of(FIGURES, found, 30)


def test_slots_of_a_rooms_file_are_those_of_its_devices(tmp_path: Path) -> None:
    (tmp_path / "report.json").write_text(json.dumps(report()))
    (tmp_path / "rooms.yaml").write_text(
        "slots: auto\nfigures: report.json\nframes_per_s: 60\n"
        "nodes: {a: {source: synthetic}}\nrooms: {h: {nodes: [a]}}"
    )
    rooms = load_rooms(tmp_path / "rooms.yaml")
    found = {None: card(), 0: card(), 2: card(4 * GIB)}
    assert with_slots(rooms, [0, 2], found.__getitem__).devices == (0, 0, 0, 0, 2, 2, 2)
    assert with_slots(rooms, [], found.__getitem__).devices == (None,) * 4
    assert with_slots(rooms.replaced(slots=2), [0], found.__getitem__).devices == (None, None)


def test_auto_needs_figures() -> None:
    with pytest.raises(ValueError, match="`slots: auto` needs `figures`"):
        RoomsFile.model_validate(
            {"slots": "auto", "nodes": {"a": {"source": "s"}}, "rooms": {"h": {"nodes": ["a"]}}}
        )


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        "{}",
        json.dumps({**report(), "steps": {}}),
        None,
        "[" * 100_000,
        json.dumps(report(room_bytes=0)),
        json.dumps(report(room_bytes=-GIB)),
        json.dumps(report()).replace(str(GIB), "Infinity"),
        json.dumps(report()).replace("4.0", "0.0").replace("1.0", "0").replace("0.5", "0"),
        json.dumps(report()).replace("4.0", "1e999"),
        json.dumps(report()).replace("4.0", "NaN"),
    ],
)
def test_reports_without_figures_are_refused(tmp_path: Path, text: str | None) -> None:
    path = tmp_path / "report.json"
    if text is not None:
        path.write_text(text)
    with pytest.raises(DeltalightError, match=r"gpu-check --steps memory,speed"):
        load_figures(path)


HONEST = labels_of(card())


@pytest.mark.parametrize(
    ("labels", "slots", "found", "sentence"),
    [
        (
            HONEST,
            4,
            card(name="llvmpipe (LLVM 15)"),
            "claims the device NVIDIA-RTX-A4000-PCIe-SSE2 and renders on",
        ),
        (HONEST, 4, card(8 * GIB), "it claims 16384 MiB of memory and has 8192"),
        (HONEST, 4, card(None), "it claims 16384 MiB of memory and its driver does not tell"),
        ({}, 20, card(), "it claims 20 slots a device, which take 20480 MiB, and has 16384"),
    ],
)
def test_a_host_that_lies_about_its_gpu_is_refused(
    labels: dict[str, str], slots: int, found: FoundDevice, sentence: str
) -> None:
    with pytest.raises(FalseClaimError, match=f"^the host gpu-a is refused: .*{sentence}"):
        check_claim("gpu-a", labels, slots, found, FIGURES)


def test_honest_hosts_are_not_refused() -> None:
    check_claim("gpu-a", HONEST, 16, card(), FIGURES)
    check_claim("gpu-a", HONEST, 400, card(int(15.9 * GIB)), None)  # drivers keep some of it
    check_claim("gpu-a", {"network": "hall"}, 4, card(None), FIGURES)
    assert HONEST == {"gpu": "NVIDIA-RTX-A4000-PCIe-SSE2", "gpu-memory-mb": "16384"}
    assert label_text("llvmpipe (LLVM 15.0.6, 256 bits)") == "llvmpipe-LLVM-15.0.6-256-bits"


def integers(numbers: dict[int, list[int]]) -> Callable[[int, int], list[int]]:
    return lambda name, count: numbers[name][:count]


def test_drivers_tell_memory_in_their_ways() -> None:
    nvidia = integers({0x9047: [8 << 20], 0x9049: [6 << 20]})
    assert device_memory(["GL_NVX_gpu_memory_info"], nvidia, is_software=False) == (8 * GIB, 6 * GIB)
    amd = integers({0x87FC: [4 << 20, 1, 2, 3]})
    assert device_memory(["GL_ATI_meminfo"], amd, is_software=False) == (4 * GIB, 4 * GIB)
    assert device_memory([], integers({}), is_software=False) == (None, None)
    assert device_memory(["GL_NVX_gpu_memory_info"], nvidia, is_software=True) == (host_memory(), None)


def test_what_is_free_of_this_host_is_a_part_of_its_memory() -> None:
    assert 0 < free_host_memory() < host_memory()


@pytest.mark.slow
def test_this_host_says_what_it_has_and_offers_it(cli: RunCli, tmp_path: Path) -> None:
    found = find_device_apart(None)
    assert found.name
    assert not found.is_software or found.memory_bytes == host_memory()
    path = tmp_path / "report.json"
    path.write_text(json.dumps(report(found.name, 1 << 20)))
    offered = cli("rooms", "claim", str(path))
    assert offered.stdout.startswith('--resources=\'{"render_slot": ')
    assert f"gpu={label_text(found.name)}" in offered.stdout
    path.write_text(json.dumps(report("another", 1 << 20)))
    refused = cli("rooms", "claim", str(path))
    assert (refused.returncode, "are for another" in " ".join(refused.stderr.split())) == (2, True)
