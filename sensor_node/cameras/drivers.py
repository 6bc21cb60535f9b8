"""The camera drivers: the project's own and those of installed plugins, loaded when they are needed."""

from importlib.metadata import EntryPoint

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.plugins import LoadedPlugins, Plugin, installed_plugins, load_plugins
from deltalight.sensor_node.cameras.driver import CameraDriver

GROUP = "deltalight.cameras"
SYNTHETIC = "synthetic"
BUILT_IN = {
    "oak": "deltalight.sensor_node.cameras.oak:DRIVER",
    "uvc": "deltalight.sensor_node.cameras.uvc:DRIVER",
    "orbbec": "deltalight.sensor_node.cameras.rgbd:ORBBEC",
    "openni2": "deltalight.sensor_node.cameras.rgbd:OPENNI2",
}


def driver_plugins() -> list[Plugin]:
    """All drivers, none of them loaded."""
    own = [Plugin(EntryPoint(name, place, GROUP)) for name, place in BUILT_IN.items()]
    return [*own, *installed_plugins(GROUP)]


def load_drivers() -> LoadedPlugins[tuple[Plugin, CameraDriver]]:
    """Loads all drivers."""
    return load_plugins(driver_plugins(), _accept, [SYNTHETIC])


def load_driver(kind: str) -> tuple[Plugin, CameraDriver]:
    """Loads the driver of a kind of camera.

    Raises:
        DeltalightError: there is none, or it cannot be used.
    """
    loaded = load_plugins([each for each in driver_plugins() if each.name == kind], _accept, [SYNTHETIC])
    if kind not in loaded.values:
        raise DeltalightError(
            loaded.fault(kind) or f"There is no camera driver `{kind}`; install its package."
        )
    return loaded.values[kind]


def driver_title(kind: str) -> str:
    """What people call cameras of a kind."""
    try:
        return load_driver(kind)[1].title
    except DeltalightError:
        return kind


def _accept(plugin: Plugin, found: object) -> tuple[Plugin, CameraDriver]:
    if not isinstance(found, CameraDriver):
        raise plugin.fault("it names no CameraDriver")
    return plugin, found
