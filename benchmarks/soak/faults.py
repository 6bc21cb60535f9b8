"""The faults that a soaked station is put to: what is done, and what came of it."""

import os
import signal
import time
import uuid
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from random import Random
from typing import Any

import httpx
import numpy as np
from jaxtyping import UInt8

from deltalight.benchmarks.soak.crowd import BEHAVIOURS, Crowd, Seen
from deltalight.benchmarks.soak.link import SHAPES, LoopThread
from deltalight.benchmarks.soak.nonsense import send_nonsense
from deltalight.benchmarks.soak.peers import peers_on
from deltalight.benchmarks.soak.profiles import Profile
from deltalight.benchmarks.soak.spares import wait_for_spare
from deltalight.benchmarks.soak.station import SERVER, WEB, Station, camera_of
from deltalight.benchmarks.soak.takes_killed import kill_recorder
from deltalight.protocol.documents import nearest
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.messages import ControlRequest
from deltalight.protocol.request import RequestClient
from deltalight.services import ports

PATIENCE_S = 90.0
SETTLE_S = 20.0  # after a start the picture may still refine
POLL_S = 0.05
CUT_S = 5.0
LARGEST_DIFFERENCE = 2.0  # mean of a picture's codes: noise and JPEG are below 1, a missing object is above

Outcome = dict[str, Any]
Pictures = dict[str, UInt8[np.ndarray, "h w 3"]]  # newest ones, by camera


@dataclass(frozen=True)
class Run:
    """What faults act on."""

    station: Station
    crowd: Crowd
    profile: Profile
    dice: Random
    thread: LoopThread


class Fault(ABC):
    """One kind of fault."""

    @abstractmethod
    def run(self, run: Run) -> Outcome:
        """Does it and waits until the station has recovered; returns figures.

        Raises:
            DeltalightError: the picture did not come back.
        """


@dataclass(frozen=True)
class Kill(Fault):
    """SIGKILL of a process: when the picture is back, and whether the scene is the same by document and by pixels.

    By pixels only where no camera moves.

    It ends when the next spare is ready: until then the station has more to do than without a fault.

    Of a node its own camera's picture, of another process those of all cameras.
    """

    process: str

    def run(self, run: Run) -> Outcome:
        """Does it, and waits for a picture captured later."""
        station = run.station
        name = _chosen(self.process, run)
        documents, pictures = _documents(station), _pictures(run)
        restarts, spare = station.restarts()[name], station.spare_id(name)
        killed_ns, killed_s = time.time_ns(), time.monotonic()
        station.kill(name)
        _wait(run, lambda: station.restarts()[name] > restarts)
        _wait(run, lambda: _is_back(run, name, killed_ns, killed_s))
        back_s = time.monotonic() - killed_s
        by_spare = station.process_id(name) == spare
        same_document, difference = _documents(station) == documents, _settled_difference(run, pictures)
        return {
            "process": name,
            "back_s": back_s,
            "by_spare": by_spare,
            "same_document": same_document,
            "difference": difference,
            **_until_spare(run, name),
        }


@dataclass(frozen=True)
class Stop(Fault):
    """SIGSTOP of a process for a while: how soon after it goes on the picture is back."""

    process: str

    def run(self, run: Run) -> Outcome:
        """Does it, and waits for a picture captured after it went on."""
        name = _chosen(self.process, run)
        process_id = run.station.process_id(name)
        os.kill(process_id, signal.SIGSTOP)
        try:
            time.sleep(run.profile.stop_s)
        finally:
            os.kill(process_id, signal.SIGCONT)
        resumed_ns, resumed_s = time.time_ns(), time.monotonic()
        _wait(run, lambda: _is_back(run, name, resumed_ns, resumed_s))
        return {
            "process": name,
            "stopped_s": run.profile.stop_s,
            "back_s": time.monotonic() - resumed_s,
            "restarted": run.station.process_id(name) != process_id,
        }


@dataclass(frozen=True)
class Viewers(Fault):
    """Viewers that are slow, silent or never acknowledge; others' rate and age before, meanwhile and after."""

    def run(self, run: Run) -> Outcome:
        """Has one of each watch for a while."""
        with _compared(run, calm_s=run.profile.load_s) as outcome:
            leave = [run.crowd.join(behaviour) for behaviour in BEHAVIOURS]
            time.sleep(run.profile.load_s)
            for each in leave:
                each()
        return outcome


@dataclass(frozen=True)
class Churn(Fault):
    """Many viewers that join and leave; others' rate and age before, meanwhile and after."""

    def run(self, run: Run) -> Outcome:
        """Has them do so for a while."""
        with _compared(run, calm_s=run.profile.churn_s) as outcome:
            leave = run.crowd.come_and_go(run.profile.viewers, run.dice.randrange(2**32))
            time.sleep(run.profile.churn_s)
            leave()
        return {"viewers": run.profile.viewers, **outcome}


@dataclass(frozen=True)
class Nonsense(Fault):
    """A node that sends mutated messages; others' rate and age before, meanwhile and after."""

    def run(self, run: Run) -> Outcome:
        """Has it send for a while."""
        with _compared(run, calm_s=run.profile.load_s) as outcome:
            sent = send_nonsense(run.station.places.stranger, run.profile.load_s, run.dice)
        return {"sent": sent, **outcome}


@dataclass(frozen=True)
class BadLink(Fault):
    """A bad network between all nodes and the render server; peers that render nothing have one each too."""

    shape: str

    def run(self, run: Run) -> Outcome:
        """Has it so for a while."""
        profile, shape, seed = run.profile, SHAPES[self.shape], run.dice.randrange(2**32)
        with _compared(run) as outcome:
            try:
                for link in run.station.links:
                    link.shape = shape
                peers = peers_on(run.thread, shape, profile, seed)
            finally:
                for link in run.station.links:
                    link.shape = None
        return {**outcome, **{name: vars(flow) for name, flow in peers.items()}}


@dataclass(frozen=True)
class Cut(Fault):
    """All links are cut for 5 s: how soon after that the picture is back; the links of peers are cut, too."""

    def run(self, run: Run) -> Outcome:
        """Does it, waits for a picture captured after it, and then until the peers have sent for a while."""
        seed = run.dice.randrange(2**32)
        with _compared(run) as outcome, ThreadPoolExecutor(1) as pool:
            peers = pool.submit(peers_on, run.thread, None, run.profile, seed, cut_s=CUT_S)
            back_s = self._back_s(run)
            flows = peers.result()
        return {
            "cut_s": CUT_S,
            "back_s": back_s,
            **outcome,
            **{name: vars(flow) for name, flow in flows.items()},
        }

    def _back_s(self, run: Run) -> float:
        links = run.station.links
        try:
            for link in links:
                link.cut(True)
            time.sleep(CUT_S)
        finally:
            for link in links:
                link.cut(False)
        mended_ns, mended_s = time.time_ns(), time.monotonic()
        _wait(run, lambda: _all_seen(run, run.crowd.cameras, mended_ns, mended_s))
        return time.monotonic() - mended_s


@dataclass(frozen=True)
class KilledRecorder(Fault):
    """SIGKILL of a recorder of the first node: how much is lost, and whether the file can be closed."""

    def run(self, run: Run) -> Outcome:
        """Does it."""
        return kill_recorder(run.station.places.nodes[0], run.dice)


FAULTS: dict[str, Fault] = {
    "kill-node": Kill("node"),
    "kill-server": Kill(SERVER),
    "kill-web": Kill(WEB),
    "kill-recorder": KilledRecorder(),
    "stop-node": Stop("node"),
    "stop-server": Stop(SERVER),
    "stop-web": Stop(WEB),
    "viewers": Viewers(),
    "churn": Churn(),
    "nonsense": Nonsense(),
    "link-arm": BadLink("arm"),
    "link-foxglove": BadLink("foxglove"),
    "link-lossy": BadLink("lossy"),
    "link-reorder": BadLink("reorder"),
    "cut": Cut(),
}


def parse_faults(text: str) -> list[str]:
    """Returns names of FAULTS: of `all`, `none`, or names separated by commas.

    Raises:
        DeltalightError: there is no such fault.
    """
    if text in ("all", "none"):
        return list(FAULTS) if text == "all" else []
    names = [name.strip() for name in text.split(",")]
    for name in names:
        if name not in FAULTS:
            hint = nearest(name, FAULTS) or ", ".join(FAULTS)
            raise DeltalightError(f"There is no fault '{name}'; did you mean {hint}?")
    return list(dict.fromkeys(names))


@contextmanager
def _compared(run: Run, *, calm_s: float = 0.0) -> Iterator[Outcome]:
    """Yields an outcome that holds, after the block, the flow of pictures before it and during it.

    With `calm_s`, that before is of so many seconds, and there is one of as many after it: the rate wanders without
    any fault, and how far shows in what two calm spans differ by.
    """
    outcome: Outcome = {}
    time.sleep(max(0.0, calm_s - run.profile.calm_s))  # as long as the profile says it has been calm already
    began_s = time.monotonic()
    yield outcome
    ended_s = time.monotonic()
    spans = {"before": (began_s - (calm_s or run.profile.calm_s), began_s), "during": (began_s, ended_s)}
    if calm_s:
        time.sleep(calm_s)
        spans["after"] = (ended_s, ended_s + calm_s)
    outcome |= {name: vars(run.crowd.flow(*span)) for name, span in spans.items()}


def _until_spare(run: Run, name: str) -> Outcome:
    """Waits until the next spare of a process is ready; returns how long that took, and the flow meanwhile."""
    if not run.profile.spare_s:
        return {}
    began_s = time.monotonic()
    ready_s = wait_for_spare(run.station, name, run.profile.spare_s)
    ended_s = time.monotonic() if ready_s is None else began_s + ready_s
    return {"spare_ready_s": ready_s, "meanwhile": vars(run.crowd.flow(began_s, ended_s))}


def _chosen(process: str, run: Run) -> str:
    return run.dice.choice(run.station.node_names) if process == "node" else process


def _since(run: Run, began_s: float) -> list[Seen]:
    return run.crowd.between(began_s, float("inf"))


def _is_back(run: Run, name: str, after_ns: int, after_s: float) -> bool:
    """Whether pictures captured later have come: of a node, which has to report too, or of all."""
    if name not in run.station.node_names:
        return _all_seen(run, run.crowd.cameras, after_ns, after_s)
    is_seen = _all_seen(run, [camera_of(name)], after_ns, after_s)
    return is_seen and _reports(run.station, camera_of(name), after_s)


def _all_seen(run: Run, cameras: Sequence[str], after_ns: int, after_s: float) -> bool:
    """Whether a picture captured later has come of each of these cameras."""
    return {each.camera for each in _since(run, after_s) if each.capture_ns > after_ns}.issuperset(cameras)


def _reports(station: Station, topic: str, after_s: float) -> bool:
    """Whether a node has reported since then."""
    try:
        known = station.client.get("/nodes").raise_for_status().json()
    except httpx.HTTPError:
        return False
    ages_s = [each["age_s"] for each in known if each["name"] == topic]
    return any(age_s < time.monotonic() - after_s for age_s in ages_s)


def _documents(station: Station) -> tuple[object, object]:
    """Returns the scene that is stored and the one that is rendered."""
    stored = station.client.get("/active-scene").raise_for_status().json()["document"]
    client = RequestClient(ports.endpoint(station.places.control))
    try:
        reply = client.request(ControlRequest(node="soak", id=uuid.uuid4().hex, op="get_scene"), PATIENCE_S)
    finally:
        client.close()
    return stored, reply.payload.get("scene")


def _pictures(run: Run) -> Pictures:
    found = run.crowd.pictures()
    if len(found) < len(run.crowd.cameras):
        raise DeltalightError("There is no picture yet to which a later one could be compared.")
    return found


def _settled_difference(run: Run, before: Pictures) -> float | None:
    """Returns the greatest mean difference of codes from the pictures before, once it is small or time is up.

    None where the camera moves.
    """
    if run.profile.is_synthetic:
        return None
    deadline_s = time.monotonic() + SETTLE_S
    while True:
        now = _pictures(run)
        found = max(_difference(now[name], each) for name, each in before.items())
        if found <= LARGEST_DIFFERENCE or time.monotonic() > deadline_s:
            return found
        time.sleep(0.2)


def _difference(one: UInt8[np.ndarray, "h w 3"], other: UInt8[np.ndarray, "h w 3"]) -> float:
    return np.inf if one.shape != other.shape else float(np.abs(one.astype(int) - other).mean())


def _wait(run: Run, condition: Callable[[], bool]) -> None:
    deadline_s = time.monotonic() + PATIENCE_S
    while not condition():
        run.station.check()
        if time.monotonic() > deadline_s:
            last = run.station.lines[-1] if run.station.lines else "nothing was logged"
            raise DeltalightError(
                f"No picture came back within {PATIENCE_S:.0f} s; the last line was: {last}"
            )
        time.sleep(POLL_S)
