"""The depthai package, imported in one place: quiet, without telemetry, without its signal handlers."""

import os
from importlib.metadata import PackageNotFoundError, version
from typing import Any

from deltalight.protocol.errors import DeltalightError, install_command

# The SDK reads these on import. Its log goes to standard output, where it would corrupt `--json`; its telemetry is on
# unless refused; its signal handlers would replace those of the supervisor; its own calibration would change what a
# station was calibrated with.
ENVIRONMENT = {
    "DEPTHAI_LEVEL": "error",
    "DEPTHAI_TELEMETRY": "0",
    "DEPTHAI_INSTALL_SIGNAL_HANDLER": "0",
    "DEPTHAI_AUTOCALIBRATION": "OFF",
}
OLDEST = (3, 12)  # as the extra `oak` in pyproject.toml, which clones do not carry with them
INSTALL_HINT = install_command(f"depthai>={'.'.join(map(str, OLDEST))}")  # by its own name, for clones too


def sdk_version() -> str | None:
    """Returns the version of the SDK; None if it is not installed."""
    try:
        return version("depthai")
    except PackageNotFoundError:
        return None


def load_depthai() -> Any:  # noqa: ANN401 - the SDK is optional, so its types are not at hand
    """Imports the SDK; the user's own environment variables take precedence.

    Raises:
        DeltalightError: it is not installed, or too old.
    """
    for name, value in ENVIRONMENT.items():
        os.environ.setdefault(name, value)
    try:
        import depthai
    except ImportError as error:
        raise DeltalightError(f"OAK cameras need depthai ({error}); run {INSTALL_HINT}.") from error
    if tuple(int(part) for part in depthai.__version__.split(".")[:2]) < OLDEST:
        raise DeltalightError(f"depthai {depthai.__version__} is too old; run {INSTALL_HINT}.")
    return depthai
