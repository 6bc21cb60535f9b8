"""The protected pictures beside their goldens, on all cores; those that failed come into one picture."""

from collections.abc import Iterable
from math import isfinite
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from deltalight.benchmarks.gpu_check.beside_tests import (
    ComparedPicture,
    Picture,
    compare_picture,
    protected_cases,
)
from deltalight.benchmarks.gpu_check.processes import Done, guarded, opened_context, process_context, spread
from deltalight.benchmarks.gpu_check.record import Findings
from deltalight.protocol.files import write_png

if TYPE_CHECKING:
    from deltalight.render_server.gpu.context import GpuContext

SHEET = "failed_pictures.png"
LABEL_WIDTH = 240
WHITE = (255, 255, 255)
GAIN = 8  # of the difference, so that a code or two can be seen


def compare_pictures(findings: Findings, processes: int) -> str:
    """Renders and compares every case; notes those that differ, and shows them in a picture."""
    cases = protected_cases()
    if processes > 1:
        return _note(findings, spread(compare_here, cases, processes), len(cases))
    with opened_context() as gpu:
        compared = (Done(case, *guarded(lambda one: _compare(gpu, one), case)) for case in cases)
        return _note(findings, compared, len(cases))


def _note(findings: Findings, compared: "Iterable[Done[Any, ComparedPicture]]", total: int) -> str:
    shown, psnr_db = FailedPictures(findings.out), dict[str, float]()
    for count, done in enumerate(compared, start=1):
        one = done.result
        if one is None:
            findings.fault(f"{done.item}: {done.fault}")
        else:
            if isfinite(one.psnr_db):  # neither the same to the bit nor without a golden
                psnr_db[one.name] = round(one.psnr_db, 2)
            if not one.is_alike:
                shown.add(one)
                findings.fault(f"{one.name}: {one.complaint}")
        findings.keep(f"{count} of {total} pictures compared", compared=count, psnr_db=psnr_db)
    return f"{total - len(findings.record.faults)} of {total} pictures agree with their goldens"


def compare_here(case: Any) -> ComparedPicture:  # noqa: ANN401 (of the tests, as `protected_cases`)
    """Renders and compares a case in this process's context."""
    return _compare(process_context(), case)


def _compare(gpu: "GpuContext", case: Any) -> ComparedPicture:  # noqa: ANN401
    with TemporaryDirectory() as folder:
        return compare_picture(gpu, case, Path(folder))


class FailedPictures:
    """Writes SHEET into a folder anew with every picture that is added."""

    def __init__(self, out: Path) -> None:
        self._path = out / SHEET
        self._rows: list[Picture] = []

    def add(self, one: ComparedPicture) -> None:
        """Adds a row: label, picture, golden (black where missing), difference eight times as strong."""
        golden = np.zeros_like(one.picture) if one.golden is None else one.golden
        difference = np.abs(one.picture.astype(int) - golden) * GAIN
        clipped = np.minimum(difference, 255).astype(np.uint8)
        self._rows.append(np.hstack([_label(one), one.picture, golden, clipped]))
        write_png(self._path, np.vstack(self._rows))


def _label(one: ComparedPicture) -> Picture:
    label = np.zeros((one.picture.shape[0], LABEL_WIDTH, 3), np.uint8)
    for line, text in enumerate((one.name, one.complaint.split(",")[0])):
        cv2.putText(label, text, (6, 24 + 24 * line), cv2.FONT_HERSHEY_SIMPLEX, 0.4, WHITE, 1, cv2.LINE_AA)
    return label
