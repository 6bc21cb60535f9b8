"""Output folders of commands; files are written there atomically (protocol/files.py)."""

import os
from pathlib import Path

from protocol.errors import DeltalightError
from protocol.files import replacing, write_bytes, write_png

__all__ = ["make_output_folder", "replacing", "write_bytes", "write_png"]


def make_output_folder(folder: Path) -> Path:
    """Create `folder` if missing, and verify that files can be written into it.

    Raises:
        DeltalightError: it is a file, or cannot be created or written.
    """
    if folder.exists() and not folder.is_dir():
        raise DeltalightError(f"The output '{folder}' is a file; name a folder with --out.")
    probe = folder / f".write-test-{os.getpid()}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe.touch()
        probe.unlink()
    except OSError as fault:
        raise DeltalightError(
            f"The output folder '{folder}' cannot be written ({fault.strerror}); choose another with --out."
        ) from fault
    return folder
