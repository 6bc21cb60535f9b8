"""Which packages this Python lacks. Nothing but the standard library is imported here."""

from importlib.util import find_spec

from protocol.errors import DeltalightError

FIRST = ("numpy", "cv2", "jaxtyping")
"""Modules without which no step can start."""
MODULES = (
    *FIRST,
    *("pydantic", "pydantic_settings", "structlog", "rich", "yaml", "msgpack", "zmq", "zeroconf"),
    *("blosc2", "zstandard", "mcap", "mcap_protobuf", "foxglove_schemas_protobuf", "google"),
    *("moderngl", "trimesh", "scipy", "PIL", "OpenEXR", "embreex"),
    *("pytest", "pytest_timeout", "xdist"),
)
"""What the steps import, with what the tests run faster with."""


def missing_modules() -> list[str]:
    """Return those of MODULES that are not installed.

    Raises:
        DeltalightError: one of FIRST is among them.
    """
    missing = [name for name in MODULES if find_spec(name) is None]
    needed = [name for name in missing if name in FIRST]
    if needed:
        raise DeltalightError(
            f"gpu-check needs the Python modules {', '.join(needed)}; install them, or put them into PYTHONPATH."
        )
    return missing
