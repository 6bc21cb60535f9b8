"""Which packages this Python lacks. Nothing but the standard library is imported here."""

from importlib.util import find_spec
from pathlib import Path

from deltalight.protocol.errors import DeltalightError

FIRST = ("numpy", "cv2", "jaxtyping")
"""Modules without which no step can start."""
PACKAGES = {
    "numpy": "numpy",
    "cv2": "opencv-contrib-python-headless",
    "cv2/ximgproc": "opencv-contrib-python-headless",  # the tests of matting compare with it
    "jaxtyping": "jaxtyping",
    "pydantic": "pydantic",
    "pydantic_settings": "pydantic-settings",
    "structlog": "structlog",
    "rich": "rich",
    "yaml": "pyyaml",
    "msgpack": "msgpack",
    "zmq": "pyzmq",
    "zeroconf": "zeroconf",
    "blosc2": "blosc2",
    "zstandard": "zstandard",
    "mcap": "mcap",
    "mcap_protobuf": "mcap-protobuf-support",
    "foxglove_schemas_protobuf": "foxglove-schemas-protobuf",
    "google": "protobuf",
    "moderngl": "moderngl",
    "trimesh": "trimesh",
    "sqlalchemy": "sqlalchemy",  # of services/storage, which the demo needs
    "scipy": "scipy",
    "PIL": "pillow",
    "OpenEXR": "OpenEXR",
    "embreex": "embreex",
    "httpx": "httpx",  # blosc2 imports it
    "numexpr": "numexpr",  # and this
    "pytest": "pytest",
    "hypothesis": "hypothesis",
    "xdist": "pytest-xdist",
}
"""Modules that the steps import, or that the tests run faster with, and the packages that bring them.

After a slash: a folder of the module, which some builds of it lack.
"""


def missing_packages() -> list[str]:
    """Returns the packages of PACKAGES that are not installed.

    Raises:
        DeltalightError: one that brings a module of FIRST is among them.
    """
    missing = {module: package for module, package in PACKAGES.items() if not _is_there(module)}
    needed = [missing[module] for module in FIRST if module in missing]
    if needed:
        raise DeltalightError(
            f"gpu-check cannot start without {', '.join(needed)}; install them, or put them into PYTHONPATH."
        )
    return list(dict.fromkeys(missing.values()))


def _is_there(module: str) -> bool:
    name, _, folder = module.partition("/")
    spec = find_spec(name)
    return spec is not None and any(
        (Path(place) / folder).is_dir() for place in spec.submodule_search_locations or [""]
    )
