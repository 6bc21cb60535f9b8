"""Fixtures that every room's tests share."""

import signal
from pathlib import Path

import pytest

# A shell starts what it puts into the background with SIGINT ignored, and children inherit that: no test of Ctrl-C
# could pass.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of real captures beside the project; tests that need it are skipped where it is absent."""
    folder = Path(__file__).resolve().parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("the shared real captures are not beside this checkout")
    return folder
