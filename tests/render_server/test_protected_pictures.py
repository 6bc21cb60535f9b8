"""Every method's pictures, protected to the bit on the machine that recorded them and within 60 dB elsewhere; and
what was dispatched to make them: how much for each frame, and for plain scenes every kernel with its workgroups. In
some of the scenes the graph checks that no stage writes what it did not declare.

`DELTALIGHT_REGENERATE_GOLDENS=1 pytest tests/render_server/test_protected_pictures.py` records them anew: look at the
sheets (goldens/protected_*.png; a column a kind of scene, a row a kind of geometry) and at what changed before they
are committed.
"""

import fcntl
import hashlib
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Dispatch
from tests.render_server.protected_scenes import (
    FOLDER,
    GEOMETRIES,
    KINDS,
    LEAST_PSNR_DB,
    METHODS,
    PICTURE,
    SHOWN,
    Case,
    cases,
    golden_of,
    pictures_of,
    sheet_path,
    tile,
)
from tests.render_server.scenes import psnr_db

pytestmark = pytest.mark.usefixtures("clean_gl")
RECORD = FOLDER / "protected.json"
TRACE = FOLDER / "dispatches.json"
CHECKED = {  # kinds whose stages' writes are checked: the frames differ in the real scene, in objects, in light
    "mirror": "depth",
    "animated": "model",
    "estimated": "depth",
}
REGENERATE = os.environ.get("DELTALIGHT_REGENERATE_GOLDENS") == "1"
CLEARS = ("clear_buffer", "clear_volume")
CPU_FLAGS = ("avx", "avx2", "fma", "avx512f")  # that change the last bits of what llvmpipe and numpy compute


def made_with(gpu: GpuContext) -> dict[str, Any]:
    """What decides the last bits of a picture."""
    info = Path("/proc/cpuinfo")
    flags = set(info.read_text().split()) if info.exists() else set()
    return {
        "renderer": gpu.renderer_name,
        "version": gpu.version,
        "cpu": [flag for flag in CPU_FLAGS if flag in flags],
        "blas": os.environ.get("OPENBLAS_CORETYPE", ""),
    }


def digest(picture: np.ndarray) -> str:
    return hashlib.sha256(np.ascontiguousarray(picture).tobytes()).hexdigest()


def described(trace: list[list[Dispatch]]) -> list[list[str]]:
    """Shader and size of each dispatch of each frame, without clears.

    Whether a buffer is cleared by a kernel or by the CPU is a matter of speed (gpu/kernel.py), and no work of a pass.
    """
    shown = [[one for one in part if one.kernel not in CLEARS] for part in trace]
    return [[" ".join([one.kernel.split(" ")[0], *map(str, one.size)]) for one in part] for part in shown]


def kernels(trace: list[list[str]]) -> list[list[str]]:
    """The same without sizes, which follow the number of surfels, and so the last bits of positions."""
    return [[line.split(" ")[0] for line in part] for part in trace]


def recorded(path: Path) -> dict[str, Any]:
    return dict(json.loads(path.read_text())) if path.exists() else {}


@contextmanager
def folder_held() -> Iterator[None]:
    """Other processes that record wait."""
    folder = os.open(FOLDER, os.O_RDONLY)
    try:
        fcntl.flock(folder, fcntl.LOCK_EX)
        yield
    finally:
        os.close(folder)


class Recording:
    """What was recorded, and what this run adds when it records anew."""

    def __init__(self) -> None:
        self.old, trace = recorded(RECORD), recorded(TRACE)
        self.counts: dict[str, list[int]] = trace.get("counts", {})
        self.traces: dict[str, list[list[str]]] = trace.get("traces", {})
        self.pictures: dict[Case, list[np.ndarray]] = {}
        self.made: dict[Case, list[list[str]]] = {}

    def add(self, case: Case, pictures: list[np.ndarray], trace: list[list[str]]) -> None:
        self.pictures[case], self.made[case] = pictures, trace

    def store(self, gpu: GpuContext) -> None:
        """Adds to what is recorded by now; a run records some cases, or its workers each a part of them."""
        with folder_held():
            digests = {str(case): list(map(digest, shown)) for case, shown in self.pictures.items()}
            pictures = {**recorded(RECORD).get("pictures", {}), **digests}
            record = {"made_with": made_with(gpu), "pictures": pictures}
            RECORD.write_text(json.dumps(record, indent=1, sort_keys=True) + "\n")
            self._store_traces()
            for method in {case.method for case in self.pictures}:
                self._store_sheet(method)

    def _store_traces(self) -> None:
        old, plain = recorded(TRACE), [c for c in self.made if c.kind == "plain" and c.geometry != "fused"]
        counts = {str(case): [len(part) for part in trace] for case, trace in self.made.items()}
        traces = {str(case): self.made[case][:2] for case in plain}
        new = {"counts": old.get("counts", {}) | counts, "traces": old.get("traces", {}) | traces}
        TRACE.write_text(json.dumps(new, indent=0, sort_keys=True) + "\n")

    def _store_sheet(self, method: str) -> None:
        path = sheet_path(method)
        size = len(GEOMETRIES) * PICTURE["height"], len(KINDS) * PICTURE["width"], 3
        sheet = np.array(Image.open(path).convert("RGB")) if path.exists() else np.zeros(size, np.uint8)
        for case, pictures in self.pictures.items():
            if case.method == method:
                sheet[tile(case)] = pictures[SHOWN]
        Image.fromarray(sheet).save(path, optimize=True)


@pytest.fixture(scope="module")
def recording(gpu: GpuContext) -> Iterator[Recording]:
    record = Recording()
    yield record
    if REGENERATE:
        record.store(gpu)


def parameters() -> list[Any]:
    """Every case; those that `./run test` leaves to `./run test --all` are slow."""
    quick = [
        case.geometry == "depth" and (case.kind == "plain" or case.method == "exact") for case in cases()
    ]
    marks = [() if is_quick else (pytest.mark.slow,) for is_quick in quick]
    return [pytest.param(case, id=str(case), marks=mark) for case, mark in zip(cases(), marks, strict=True)]


def test_blas_has_the_kernels_of_the_record(gpu: GpuContext) -> None:
    """Where the processor has them: NumPy must not be loaded before they are chosen."""
    made, old = made_with(gpu), recorded(RECORD)["made_with"]
    assert made["blas"] == (old["blas"] if "avx512f" in made["cpu"] else "")


@pytest.mark.parametrize("case", parameters())
def test_pictures_and_dispatches_are_the_recorded_ones(
    gpu: GpuContext, recording: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, case: Case
) -> None:
    monkeypatch.setenv("DELTALIGHT_CACHE", str(tmp_path / "cache"))
    checks = CHECKED.get(case.kind) == case.geometry
    pictures, dispatches = pictures_of(gpu, case, tmp_path, checks=checks)
    assert any(run.written for run in dispatches[1])
    trace = described(dispatches)
    if REGENERATE:
        recording.add(case, pictures, trace)
        return
    same_machine = recording.old["made_with"] == made_with(gpu)
    if same_machine:
        assert [digest(picture) for picture in pictures] == recording.old["pictures"][str(case)]
    else:
        assert psnr_db(pictures[SHOWN], golden_of(case)) >= LEAST_PSNR_DB, recording.old["made_with"]
    if gpu.is_software:
        assert [len(part) for part in trace] == recording.counts[str(case)]
        recorded = recording.traces.get(str(case), trace[:2])
        assert kernels(trace[:2]) == kernels(recorded)
        assert not same_machine or trace[:2] == recorded


@pytest.mark.skipif(REGENERATE, reason="the record is being written")
def test_the_record_is_small_and_complete() -> None:
    record = json.loads(RECORD.read_text())
    assert set(record["pictures"]) == {str(case) for case in cases()}
    assert set(json.loads(TRACE.read_text())["counts"]) == set(record["pictures"])
    assert {path.name for path in FOLDER.glob("protected_*.png")} == {sheet_path(m).name for m in METHODS}
    assert all(path.stat().st_size < 500_000 for path in FOLDER.glob("protected_*.png"))
