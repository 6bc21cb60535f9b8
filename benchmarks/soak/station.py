"""The station that is soaked: nodes with what they replay, render server, web process, and links between them."""

import os
import signal
import threading
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import httpx
import numpy as np
import structlog

from deltalight.benchmarks.soak.link import Link, LoopThread
from deltalight.benchmarks.soak.profiles import Profile
from deltalight.benchmarks.speed.motions import STANDING
from deltalight.protocol.documents import validate
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import SensorFrame
from deltalight.protocol.recording_reader import RecordingReader
from deltalight.protocol.recording_writer import RecordingWriter
from deltalight.protocol.scene import SceneDocument
from deltalight.sensor_node.cameras.drivers import SYNTHETIC
from deltalight.services import ports
from deltalight.services.child import ChildSpec
from deltalight.services.demo import RECORDING, demo_scene
from deltalight.services.host import HostPlan
from deltalight.services.host_store import activate_document
from deltalight.services.session_file import session_file
from deltalight.services.storage.store import Store
from deltalight.services.supervisor import Supervisor

SERVER, WEB = "render server", "web process"
REQUEST_TIMEOUT_S = 10.0
MOST_RESTARTS = 10**6  # the faults are ours

log = structlog.get_logger()


@dataclass(frozen=True)
class Ports:
    """Where the processes listen; `stranger` is the endpoint's of a node that only sends nonsense."""

    nodes: Sequence[int]
    links: Sequence[int]
    stranger: int
    composite: int
    control: int
    page: int

    @classmethod
    def private(cls, nodes: int) -> "Ports":
        """Chooses free ones."""
        found = ports.private_ports(2 * nodes + 4)
        return cls(found[:nodes], found[nodes : 2 * nodes], *found[2 * nodes :])


class Station:
    """Processes that run; `links` lie between nodes and the others, `ids` are all processes there ever were."""

    def __init__(
        self, places: Ports, supervisor: Supervisor, links: Sequence[Link], node_names: Sequence[str]
    ) -> None:
        self.places = places
        self.links = links
        self.node_names = node_names
        self.ids: set[int] = set()
        self.kills: dict[str, int] = {}
        self.fault: Exception | None = None
        self.lines: list[str] = []
        self._supervisor = supervisor
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._supervise, name="supervisor", daemon=True)
        self.client = httpx.Client(
            base_url=f"http://{ports.LOOPBACK}:{places.page}/api/v1", timeout=REQUEST_TIMEOUT_S
        )

    def start(self) -> None:
        """Starts to watch the processes."""
        self._thread.start()

    def close(self) -> None:
        """Stops watching them, before their supervisor ends them."""
        self._ending.set()
        self._thread.join()
        self.client.close()

    @property
    def cameras(self) -> list[str]:
        """Names of the nodes' cameras, in the order of the nodes."""
        return [camera_of(name) for name in self.node_names]

    @property
    def names(self) -> list[str]:
        """Names of all processes."""
        return [*self.node_names, SERVER, WEB]

    def process_id(self, name: str) -> int:
        """Returns the id of the process of that name which was started last."""
        return self._supervisor.process_ids()[name]

    def spare_id(self, name: str) -> int | None:
        """Returns the id of the spare that waits to take the place of a process, None if there is none."""
        return self._supervisor.spare_ids().get(name)

    def restarts(self) -> dict[str, int]:
        """Returns how often each process was started again."""
        return self._supervisor.restarts()

    def deaths(self) -> dict[str, int]:
        """Returns how often each process died that nobody killed."""
        return {name: count - self.kills.get(name, 0) for name, count in self.restarts().items()}

    def kill(self, name: str) -> None:
        """Kills a process at once (SIGKILL)."""
        self.kills[name] = self.kills.get(name, 0) + 1
        os.kill(self.process_id(name), signal.SIGKILL)

    def check(self) -> None:
        """Raises what ended the supervisor.

        Raises:
            DeltalightError: a process refused its input.
        """
        if self.fault is not None:
            raise self.fault

    def _supervise(self) -> None:
        try:
            self._supervisor.run(until=self._note_ids)
        except DeltalightError as fault:
            self.fault = fault

    def _note_ids(self) -> bool:
        self.ids.update(self._supervisor.process_ids().values())
        self.ids.update(self._supervisor.spare_ids().values())
        return self._ending.is_set()


@contextmanager
def running_station(profile: Profile, thread: LoopThread, seed: int) -> Iterator[Station]:
    """Starts a station with a data folder of its own; all of it ends with the block.

    Raises:
        DeltalightError: no OpenGL, missing demo files, or no free ports.
    """
    with ExitStack() as stack:
        folder = Path(stack.enter_context(TemporaryDirectory(prefix="deltalight-soak-")))
        source, configuration = source_of(profile, folder)
        with Store(folder / "data") as store:
            shown = activate_document(store, soaked_scene(profile))
        session = stack.enter_context(session_file(shown))
        places = Ports.private(profile.nodes)
        links = [
            Link(port, node, seed + number)
            for number, (port, node) in enumerate(zip(places.links, places.nodes, strict=True))
        ]
        for link in links:
            thread.start(link.serve())
        plan = HostPlan(source, session, data=folder / "data", config=configuration)
        specs = _specs(places, plan)
        lines: list[str] = []
        supervisor = Supervisor(specs, forward=lines.append, maximum_restarts=MOST_RESTARTS)
        stack.enter_context(supervisor)
        station = Station(places, supervisor, links, [spec.name for spec in specs[: profile.nodes]])
        station.lines = lines
        stack.callback(station.close)
        station.start()
        yield station


def write_take(
    path: Path, size: tuple[int, int], frames_per_s: float, frames: Sequence[int] = STANDING
) -> None:
    """Writes what the nodes replay: frames of the demo in which nothing moves but noise, at another size and rate.

    Pictures before and after a fault can be compared. `frames` are their numbers in the demo's recording.

    Raises:
        DeltalightError: the demo's recording is missing, or the file cannot be written.
    """
    reader = RecordingReader(RECORDING)
    began_ns, period_ns = reader.timestamps_ns[0], round(1e9 / frames_per_s)
    with RecordingWriter(path, board=reader.board, extrinsics=reader.extrinsics) as writer:
        for number, shown in enumerate(frames):
            now_ns = began_ns + number * period_ns
            frame = resized(reader[shown], size)
            writer.add(replace(frame, frame_id=number, timestamp_ns=now_ns, depth_timestamp_ns=now_ns))


def resized(frame: SensorFrame, size: tuple[int, int]) -> SensorFrame:
    """Returns a frame whose colour and registered depth have another size (width, height, pixels)."""
    camera, depth = frame.camera.resized(*size), frame.depth
    color = cv2.resize(frame.color, size, interpolation=cv2.INTER_AREA)
    if depth is not None:
        depth = replace(depth.resized(*size), camera=camera)
    return replace(frame, color=color.astype(np.uint8), camera=camera, depth=depth, color_jpeg=None)


def soaked_scene(profile: Profile) -> SceneDocument:
    """Returns the demo's scene as the profile changes it."""
    scene = demo_scene("dvct")
    document = scene.model_dump(mode="json")
    document["method"] |= profile.method
    document["output"] |= profile.output
    changed = validate(SceneDocument, document, "the soaked scene")
    return scene.replaced(method=changed.method, output=changed.output)


def source_of(profile: Profile, folder: Path) -> tuple[str, Path]:
    """Returns what the nodes show, and the configuration file of all processes."""
    if not profile.is_synthetic:
        take = folder / "take.mcap"
        write_take(take, profile.size, profile.frames_per_s)
        return str(take), Path(os.devnull)
    (width, height), configuration = profile.size, folder / "deltalight.toml"
    camera = f"{{width = {width}, height = {height}, fps = {profile.frames_per_s}}}"
    configuration.write_text(f"[node]\ncamera = {camera}\n", encoding="utf-8")
    return SYNTHETIC, configuration


def _specs(places: Ports, plan: HostPlan) -> list[ChildSpec]:
    """Returns the nodes, the render server, which reads them all, and the web process."""
    plan = replace(
        plan,
        node_port=places.links[0],
        composite_port=places.composite,
        control_port=places.control,
        page_port=places.page,
        allow_software=True,
        log_level="warning",
        spares=True,
    )
    *_, server, web = plan.specs()
    others = [*places.links[1:], places.stranger]
    read = [option for port in others for option in ("--subscribe", ports.endpoint(port))]
    return [
        *(_node(plan, number, port) for number, port in enumerate(places.nodes, start=1)),
        replace(server, arguments=(*server.arguments, *read)),
        replace(web, arguments=(*web.arguments, *read)),
    ]


def _node(plan: HostPlan, number: int, port: int) -> ChildSpec:
    spec = replace(plan, node_port=port).specs()[0]
    name = f"node {number}"
    return replace(spec, name=name, arguments=(*spec.arguments, "--name", camera_of(name)))


def camera_of(node_name: str) -> str:
    """Returns the name in a node's topics, which is also that of its camera, by the name of its process."""
    return node_name.replace(" ", "")
