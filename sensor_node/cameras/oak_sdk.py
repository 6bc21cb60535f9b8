"""The depthai package, imported in one place: quiet, without telemetry, without its signal handlers."""

import os
from importlib.metadata import PackageNotFoundError, version
from typing import Any

from protocol.errors import DeltalightError

# The SDK reads these when it is imported. Its log goes to standard output, where it would spoil `--json`;
# its telemetry is on unless it is refused; its signal handlers would replace those of the supervisor.
ENVIRONMENT = {
    "DEPTHAI_LEVEL": "error",
    "DEPTHAI_TELEMETRY": "0",
    "DEPTHAI_INSTALL_SIGNAL_HANDLER": "0",
}
INSTALL_HINT = "pip install 'deltalight[oak]'"


def sdk_version() -> str | None:
    """Version of the SDK; None where it is not installed."""
    try:
        return version("depthai")
    except PackageNotFoundError:
        return None


def load_depthai() -> Any:  # noqa: ANN401 - the SDK is optional, so its types are not at hand
    """Import the SDK; what the user has set in the environment is kept.

    Raises:
        DeltalightError: it is not installed, or not version 3.
    """
    for name, value in ENVIRONMENT.items():
        os.environ.setdefault(name, value)
    try:
        import depthai
    except ImportError as error:
        raise DeltalightError(f"OAK cameras need depthai ({error}); run {INSTALL_HINT}.") from error
    if int(depthai.__version__.split(".")[0]) < 3:
        raise DeltalightError(f"depthai {depthai.__version__} is too old; run {INSTALL_HINT}.")
    return depthai
