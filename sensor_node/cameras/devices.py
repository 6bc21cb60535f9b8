"""Devices as Linux describes them in files, below a root that tests lay out themselves."""

from collections.abc import Iterator
from pathlib import Path


def usb_devices(root: Path, vendor: str) -> Iterator[Path]:
    """Folders that describe the USB devices of a vendor."""
    folder = root / "sys/bus/usb/devices"
    yield from (path for path in sorted(folder.glob("*")) if file_text(path / "idVendor") == vendor)


def file_text(path: Path) -> str:
    """Content of a small file, empty where it cannot be read."""
    try:
        return path.read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return ""
