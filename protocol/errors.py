"""The one exception type that is shown to users, and the command that installs what they lack."""

import shlex
import sys
from pathlib import Path
from typing import ClassVar


class DeltalightError(Exception):
    """A fault that the user can fix: the message says in one sentence what is wrong and what to do.

    The command line prints it without a traceback and exits with `exit_code`; notebooks show the sentence alone.
    """

    exit_code: ClassVar[int] = 2

    def _render_traceback_(self) -> list[str]:
        """Returns the lines that IPython shows in place of a traceback."""
        return [str(self)]


def unreachable(path: Path, reason: str | None) -> DeltalightError:
    """Returns the fault that the system does not let a path be used, to be raised."""
    return DeltalightError(f"'{path}' cannot be reached ({reason}); correct the path, or its permissions.")


def install_command(*requirements: str) -> str:
    """Returns the command that adds packages or extras to the Python that runs, which need not be the shell's."""
    return shlex.join([sys.executable, "-m", "pip", "install", *requirements])
