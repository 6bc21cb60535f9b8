"""Usage reported by a web process while it is measured: pictures that arrived, processor time used."""

import time
from dataclasses import dataclass, field

import httpx

from deltalight.protocol.errors import DeltalightError

WEB, CLIENTS = "web process", "clients"  # the clients are this process
POLL_S = 0.05
PATIENCE_S = 120.0
_FRAMES, _CPU_S = "deltalight_live_frames_received_total", "process_cpu_seconds_total"


@dataclass(frozen=True)
class Sample:
    """Counts at a moment: pictures from the render server so far, and processor time used."""

    at_s: float
    frames: float
    cpu_s: dict[str, float]


@dataclass
class Usage:
    """Totals over rounds of some work."""

    wall_s: float = 0.0
    cpu_s: dict[str, float] = field(default_factory=lambda: {WEB: 0.0, CLIENTS: 0.0})
    _frames: float = 0.0
    _frames_s: float = 0.0

    def add(self, started: Sample, ended: Sample, last: Sample) -> None:
        """Counts a round: processor time until it `ended`, pictures until the `last` one."""
        self.wall_s += ended.at_s - started.at_s
        for name in self.cpu_s:
            self.cpu_s[name] += ended.cpu_s[name] - started.cpu_s[name]
        self._frames += last.frames - started.frames
        self._frames_s += last.at_s - started.at_s

    @property
    def frames_per_s(self) -> float:
        """Pictures per second."""
        return self._frames / self._frames_s

    @property
    def cores(self) -> dict[str, float]:
        """Number of cores that each process kept busy."""
        return {name: used_s / self.wall_s for name, used_s in self.cpu_s.items()}


def sample(client: httpx.Client) -> Sample:
    """Returns the current counts; the client's base address is that of the API."""
    lines = client.get("/metrics").raise_for_status().text.splitlines()
    values = dict(line.rsplit(" ", 1) for line in lines if not line.startswith("#"))
    cpu_s = {WEB: float(values[_CPU_S]), CLIENTS: time.process_time()}
    return Sample(time.perf_counter(), float(values[_FRAMES]), cpu_s)


def next_picture(client: httpx.Client) -> Sample:
    """Returns the counts at the arrival of the next picture.

    Rates are measured from one picture to another: a fixed time would be off by one of its twenty pictures.

    Raises:
        DeltalightError: none arrives.
    """
    before, deadline_s = sample(client), time.monotonic() + PATIENCE_S
    while (now := sample(client)).frames == before.frames:
        if time.monotonic() > deadline_s:
            raise DeltalightError("No picture comes from the render server any more; see the lines above.")
        time.sleep(POLL_S)
    return now
