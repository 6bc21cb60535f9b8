"""The demo: the shipped recording through node, render server and web process, each a process of its own."""

import os
import shutil
import sys
import webbrowser
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.method_names import with_method
from deltalight.protocol.scene import SceneDocument, load_scene
from deltalight.services import ports
from deltalight.services.files import make_output_folder
from deltalight.services.host import HostPlan
from deltalight.services.host_store import activate_document, session_file
from deltalight.services.process import Process
from deltalight.services.storage.store import Store
from deltalight.services.supervisor import Supervisor

ASSETS = Path(__file__).parent / "demo_assets"
RECORDING = ASSETS / "demo.mcap"
SCENE = ASSETS / "scene.json"
POSTER = ASSETS / "poster.jpg"
POSTER_BEFORE = ASSETS / "poster_before.jpg"
NAME = "Demo"
FRAME_BUDGET_MS = 125.0  # of what a viewer calls live: eight pictures a second


def demo_scene(method: str) -> SceneDocument:
    """Return the demo's scene with a method of `deltalight.protocol.method_names`.

    Raises:
        DeltalightError: the demo's files are missing.
    """
    if not all(path.is_file() for path in (RECORDING, SCENE, POSTER, POSTER_BEFORE)):
        raise DeltalightError(f"The demo's files are missing in {ASSETS}; install Deltalight again.")
    scene = load_scene(SCENE)
    return with_method(scene, method)


def run_live(method: str, *, port: int, with_browser: bool, spares: Mapping[str, Process]) -> None:
    """Run the demo with its dashboard until Ctrl-C; changes are not kept. `spares` become its processes, by name.

    Raises:
        DeltalightError: a port is in use, or a process died for good.
    """
    with TemporaryDirectory(prefix="deltalight-demo-") as data, _kept(method, Path(data)) as session:
        plan = demo_plan(session)
        taken = (plan.node_port, plan.composite_port, plan.control_port, port)
        (playback_port,) = ports.private_ports(1, avoid=taken)
        plan = replace(plan, data=Path(data), page_port=port, playback_port=playback_port)
        plan.require_free_ports()
        address = f"http://{ports.LOOPBACK}:{port}"
        with Supervisor(plan.specs(), spares=spares) as supervisor:
            supervisor.run(until=lambda: ports.answers(port))
            print(f"The dashboard is at {address} (press Ctrl-C to stop).", flush=True)
            if with_browser and _has_display():
                webbrowser.open(address)
            supervisor.run()


@contextmanager
def _kept(method: str, data: Path) -> Iterator[Path]:
    """Yield the session file of the demo's scene; a data folder stores the scene too, as the active one."""
    with Store(data) as store:
        scene = demo_scene(method)
        paced = scene.replaced(
            name=NAME,
            method=scene.method.replaced(quality="live"),
            output=scene.output.replaced(frame_budget_ms=FRAME_BUDGET_MS),
        )
        scene = activate_document(store, paced)
        shutil.copyfile(POSTER, store.poster)
        shutil.copyfile(POSTER_BEFORE, store.poster_before)
        folder = make_output_folder(store.recordings)
        (folder / RECORDING.name).symlink_to(RECORDING)  # replayed, the camera is moved by hand
    with session_file(scene) as session:
        yield session


def demo_plan(session: Path) -> HostPlan:
    """Return the demo's processes without the web process, connected by ports of their own."""
    node_port, composite_port, control_port = ports.private_ports(3)
    return HostPlan(
        str(RECORDING),
        session,
        node_port=node_port,
        composite_port=composite_port,
        control_port=control_port,
        allow_software=True,
        log_level="warning",
    )


def _has_display() -> bool:
    """Whether there is a display; without one, `webbrowser` would start a text browser in this terminal."""
    return sys.platform == "darwin" or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
