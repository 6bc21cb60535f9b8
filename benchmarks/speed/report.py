"""The report of `bench speed`, as it is printed, written and compared."""

from collections.abc import Sequence
from pathlib import Path
from typing import Final, Literal, Self

import numpy as np

from deltalight.protocol.documents import StrictModel, read_mapping, validate
from deltalight.protocol.errors import DeltalightError

REPORT: Final = "deltalight bench speed"
LEAST_FLOOR_MS = 0.0005


class Spread(StrictModel):
    """Of a time, milliseconds."""

    median: float
    p95: float

    @classmethod
    def of(cls, values: Sequence[float]) -> Self:
        """Of at least one value."""
        return cls(median=float(np.median(values)), p95=float(np.percentile(values, 95)))


class StageFigures(StrictModel):
    """One stage, over the frames in which it ran.

    `runs` is their fraction of all. `submit_ms` is what the CPU takes to issue it. `moved_bytes` are the sizes of
    all that it reads and writes; None for what is no stage of the graph. `bench roofline` adds `flops` and
    `special_functions`, medians of what its shaders execute (`flop_weights`), and `arithmetic_floor_ms`, what both
    take at the machine's peak. `floor_ms` is that, or what moving the bytes takes if it is longer or the only one
    known.
    """

    ms: Spread
    runs: float
    submit_ms: Spread | None = None
    moved_bytes: int | None = None
    flops: int | None = None
    special_functions: int | None = None
    arithmetic_floor_ms: float | None = None
    floor_ms: float | None = None

    @property
    def times_floor(self) -> float | None:
        """Median as a multiple of the floor; None if the floor is too small to be a measure."""
        if self.floor_ms is None or self.floor_ms < LEAST_FLOOR_MS:
            return None
        return self.ms.median / self.floor_ms


class MotionFigures(StrictModel):
    """One motion by one method.

    `frame_ms` runs from the change of the scene to the finished picture, `picture_ms` from submitting the frame,
    `submit_ms` until submitting returns. `stages_ms` is the sum of a frame's stages, `outside_ms` the rest of the
    frame. `late`: frames that took longer than the budget.
    """

    frame_ms: Spread
    picture_ms: Spread
    submit_ms: Spread
    stages_ms: Spread
    outside_ms: Spread
    late: int
    stages: dict[str, StageFigures]


class EndToEnd(StrictModel):
    """Camera to viewer through all processes; `settled_...`: the later half of the pictures (`summarize`)."""

    frames_per_s: float
    settled_frames_per_s: float | None = None
    age_median_ms: float
    settled_age_median_ms: float | None = None
    age_p95_ms: float
    drops: dict[str, int]


class MethodFigures(StrictModel):
    """One method; `notices` are the renderer's sentences on the demo, among them the memory of its volumes."""

    motions: dict[str, MotionFigures]
    notices: list[str]
    end_to_end: EndToEnd | None = None


class Peaks(StrictModel):
    """What the machine reached in kernels that do nothing else."""

    bytes_per_s: float
    flops_per_s: float


class SpeedReport(StrictModel):
    """A whole run; `size` in pixels, `frames` of each motion, `version` of Deltalight."""

    report: Literal["deltalight bench speed"] = REPORT
    version: str
    renderer: str
    cpus: int
    size: tuple[int, int]
    frames: int
    budget_ms: float
    peaks: Peaks
    methods: dict[str, MethodFigures]

    @property
    def machine(self) -> str:
        """Names the machine as far as the report knows it."""
        return f"{self.renderer}, {self.cpus} CPUs"


def read_report(path: Path) -> SpeedReport:
    """Reads a report that `bench speed --out` wrote.

    Raises:
        DeltalightError: the file cannot be read, or is something else.
    """
    data = read_mapping(path)
    if data.get("report") != REPORT:
        raise DeltalightError(
            f"{path} is not a report of this version's `bench speed`; write one with `bench speed --out FILE`."
        )
    return validate(SpeedReport, data, str(path))
