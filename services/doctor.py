"""Checks of this machine: each ends in one line with a hint."""

import json
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version
from typing import Literal

from deltalight.protocol.errors import install_command
from deltalight.services import ports

PROBE_TIMEOUT_S = 60
MAXIMUM_DEVICES = 16
PACKAGES = {
    "to render": ("moderngl", "trimesh", "scipy", "OpenEXR"),
    "to serve": ("fastapi", "uvicorn", "websockets", "sqlalchemy", "prometheus-client"),
}

CONTAINER_HINT = (
    "EGL sees no device: apt-get install --no-install-recommends libegl1 libgl1; in a container with an"
    " NVIDIA GPU set NVIDIA_DRIVER_CAPABILITIES=graphics,compute,utility"
)

_PROBE = """
import json, sys
from deltalight.render_server.gpu.context import create_context
gpu = create_context(int(sys.argv[1]))
print(json.dumps([gpu.renderer_name, gpu.version, gpu.is_software]))
"""

State = Literal["ok", "note", "missing"]


@dataclass(frozen=True)
class Check:
    """One finding: `missing` makes the command exit with 1; `note` does not."""

    name: str
    state: State
    detail: str
    hint: str = ""

    def as_dict(self) -> dict[str, str]:
        """Returns the check as plain data."""
        return asdict(self)


def examine() -> Iterator[Check]:
    """Runs all checks, one after the other."""
    yield Check("python", "ok", sys.version.split()[0])
    yield from _packages()
    yield _opencv()
    yield from _renderers()
    yield from _methods()
    yield from _cameras()
    yield from _ports()


def _packages() -> Iterator[Check]:
    for use, names in PACKAGES.items():
        missing = [name for name in names if _version(name) is None]
        if missing:
            what = f"not installed: {', '.join(missing)}"
            yield Check(f"packages {use}", "missing", what, install_command(*missing))
        else:
            found = ", ".join(f"{name} {_version(name)}" for name in names)
            yield Check(f"packages {use}", "ok", found)


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _opencv() -> Check:
    import cv2

    modules = {"aruco": hasattr(cv2, "aruco"), "ximgproc": hasattr(cv2, "ximgproc")}
    absent = [name for name, present in modules.items() if not present]
    if absent:
        hint = (
            "pip uninstall opencv-python, then pip install --force-reinstall opencv-contrib-python-headless"
        )
        state: State = "missing" if "aruco" in absent else "note"  # tests alone need the other
        return Check("OpenCV", state, f"{cv2.__version__} lacks {', '.join(absent)}", hint)
    return Check("OpenCV", "ok", f"{cv2.__version__} with {', '.join(modules)}")


def _renderers() -> Iterator[Check]:
    """Probes each EGL device in a child, because a broken driver ends the process."""
    only_software = True
    for device in range(MAXIMUM_DEVICES):
        probe = _probe(device)
        output = (probe.stderr.strip().splitlines() or [f"the driver ended the probe ({probe.returncode})"])[
            -1
        ]
        if probe.returncode != 0 and device > 0 and "requested device" in output:
            break
        if probe.returncode != 0:
            # The last line of a traceback is `module.DeltalightError: what is wrong: what to do`.
            detail = output.partition("DeltalightError: ")[2] or output
            yield Check(
                f"OpenGL device {device}", "missing", detail, CONTAINER_HINT if "0 devices" in output else ""
            )
            break
        renderer, gl_version, is_software = json.loads(probe.stdout)
        only_software &= is_software
        yield Check(f"OpenGL device {device}", "ok", f"{renderer}, OpenGL {gl_version}")
    if only_software:
        hint = "render, demo and bench work slowly without a GPU; server and up need --allow-software"
        yield Check("GPU", "note", "none found through EGL", hint)


def _probe(device: int) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-P", "-c", _PROBE, str(device)]
    try:
        return subprocess.run(command, capture_output=True, text=True, timeout=PROBE_TIMEOUT_S, check=False)
    except subprocess.TimeoutExpired:
        return subprocess.CompletedProcess(command, 1, "", f"no answer within {PROBE_TIMEOUT_S} s")


def _methods() -> Iterator[Check]:
    """Every relighting method of a plugin, one line each."""
    from deltalight.protocol.methods import PLUGINS

    for name, method in PLUGINS.values.items():
        yield Check(f"method {name}", "ok", f"of package {method.plugin.package}")
    for plugin, fault in PLUGINS.faults.items():
        detail, _, hint = fault.rstrip(".").rpartition("; ")
        yield Check(f"method {plugin.name}", "note", detail, hint)


def _cameras() -> Iterator[Check]:
    """Reports every camera that was found, one line each, then the kinds without any."""
    from deltalight.sensor_node.cameras.discovery import discover
    from deltalight.sensor_node.cameras.drivers import driver_title

    found = discover()
    for camera in found.cameras:
        detail = f"{camera.name} ({camera.details})"
        yield Check(f"camera {camera.source}", "note" if camera.hint else "ok", detail, camera.hint)
    for kind in found.missing:
        yield Check(f"{driver_title(kind.kind)} cameras", "note", kind.details, kind.hint)


def _ports() -> Iterator[Check]:
    uses = {
        "node": ports.NODE_PORT,
        "composite": ports.COMPOSITE_PORT,
        "control": ports.CONTROL_PORT,
        "page": ports.PAGE_PORT,
    }
    for use, port in uses.items():
        if ports.is_free(port):
            yield Check(f"port {port}", "ok", f"free ({use})")
        else:
            yield Check(f"port {port}", "note", f"in use ({use})", "stop that program or choose another port")
