"""Discovery of this machine's cameras without opening one, and of what other kinds still need."""

from pathlib import Path

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.plugins import Plugin
from deltalight.sensor_node.cameras.driver import Discovery, FoundCamera, MissingSupport
from deltalight.sensor_node.cameras.drivers import load_drivers


def list_cameras() -> list[FoundCamera]:
    """Returns the live cameras of this machine; takes about a second where the OAK SDK is installed."""
    return list(discover().cameras)


def discover(root: Path = Path("/")) -> Discovery:
    """Asks every driver for its cameras, which it finds in the file system below `root` or through its SDK."""
    drivers = load_drivers()
    cameras: list[FoundCamera] = []
    missing: list[MissingSupport] = []
    for kind, (plugin, driver) in drivers.values.items():
        try:
            with plugin.blamed():
                found = _unsearched(plugin) if driver.find is None else driver.find(root)
        except DeltalightError as fault:
            missing.append(_unusable(kind, str(fault)))
        else:
            cameras += found.cameras
            missing += found.missing
    missing += [_unusable(plugin.name, fault) for plugin, fault in drivers.faults.items()]
    return Discovery(tuple(cameras), tuple(missing))


def _unsearched(plugin: Plugin) -> Discovery:
    details = f"the driver of package {plugin.package} cannot search for cameras"
    return Discovery(missing=(MissingSupport(plugin.name, details, f"name one as `{plugin.name}:...`"),))


def _unusable(kind: str, sentence: str) -> MissingSupport:
    """Sentences say what is wrong, a semicolon, and what to do."""
    details, _, hint = sentence.rstrip(".").rpartition("; ")
    return MissingSupport(kind, details or hint, hint if details else "")
