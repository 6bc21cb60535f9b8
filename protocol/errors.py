"""The one exception type that is shown to users, and the command that installs what they lack."""

import shlex
import sys
from typing import ClassVar


class DeltalightError(Exception):
    """A fault that the user can fix: the message says in one sentence what is wrong and what to do.

    The command line prints it without a traceback and exits with `exit_code`; notebooks show the sentence alone.
    """

    exit_code: ClassVar[int] = 2

    def _render_traceback_(self) -> list[str]:
        """Returns the lines that IPython shows in place of a traceback."""
        return [str(self)]


def install_command(*requirements: str) -> str:
    """Return the command that adds packages or extras to the Python that runs, which need not be the shell's."""
    return shlex.join([sys.executable, "-m", "pip", "install", *requirements])
