"""Puts the built dashboard into wheels and source archives, or refuses to make one without it.

`python hatch_build.py` prints the fingerprint of the dashboard's sources.
"""

import hashlib
import os
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

DASHBOARD = Path(__file__).resolve().parent / "services" / "dashboard"
STAMP = DASHBOARD / "dist" / ".built"  # holds the fingerprint of the sources of what lies there
NOT_SOURCES = {"dist", "node_modules", "__pycache__"}


class DashboardHook(BuildHookInterface):
    """Builds the dashboard if it is absent or its sources changed; editable installations do without."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Build, or abort with a sentence."""
        del build_data
        if version == "editable" or (STAMP.is_file() and STAMP.read_text().strip() == fingerprint()):
            return
        npm = shutil.which("npm")
        if npm is None:
            self.app.abort("The dashboard is not built and npm is missing: install Node.js 20.19 or newer.")
        for command in ((npm, "ci"), (npm, "run", "build")):
            if subprocess.run(command, cwd=DASHBOARD, check=False).returncode != 0:
                self.app.abort(
                    f"The dashboard cannot be built: `npm {' '.join(command[1:])}` failed; see above."
                )
        STAMP.write_text(fingerprint())


def fingerprint() -> str:
    """Returns a hash of the names and contents of the dashboard's sources."""
    digest = hashlib.sha256()
    for path in sorted(_sources()):
        digest.update(f"{path.relative_to(DASHBOARD).as_posix()}\0".encode())
        digest.update(hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()


def _sources() -> Iterator[Path]:
    for folder, names, files in os.walk(DASHBOARD):
        names[:] = set(names) - NOT_SOURCES
        yield from (Path(folder) / name for name in files)


if __name__ == "__main__":
    print(fingerprint())
