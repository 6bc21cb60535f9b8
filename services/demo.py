"""The demo: the shipped recording, its scene, and the processes that play and relight it."""

from pathlib import Path

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.method_names import with_method
from deltalight.protocol.scene import SceneDocument, load_scene
from deltalight.services import ports
from deltalight.services.host import HostPlan

ASSETS = Path(__file__).parent / "demo_assets"
RECORDING = ASSETS / "demo.mcap"
SCENE = ASSETS / "scene.json"
POSTER = ASSETS / "poster.jpg"
POSTER_BEFORE = ASSETS / "poster_before.jpg"
NAME = "Demo"


def demo_scene(method: str) -> SceneDocument:
    """Returns the demo's scene with a method of `deltalight.protocol.method_names`.

    Raises:
        DeltalightError: the demo's files are missing.
    """
    if not all(path.is_file() for path in (RECORDING, SCENE, POSTER, POSTER_BEFORE)):
        raise DeltalightError(f"The demo's files are missing in {ASSETS}; install Deltalight again.")
    scene = load_scene(SCENE)
    return with_method(scene, method)


def demo_plan(session: Path) -> HostPlan:
    """Returns the demo's processes without the web process, connected by ports of their own."""
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
