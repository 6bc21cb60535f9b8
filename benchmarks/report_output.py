"""Where a command of `deltalight bench` puts its report."""

from collections.abc import Callable
from pathlib import Path

from deltalight.protocol.files import write_bytes


def put_report(json_text: str, show: Callable[[], object], *, out: Path | None, as_json: bool) -> None:
    """Writes a report to `out` if given, and prints it: as JSON, or by `show`."""
    if out is not None:
        write_bytes(out, json_text.encode())
    if as_json:
        print(json_text)
    else:
        show()
