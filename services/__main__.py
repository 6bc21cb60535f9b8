"""Where the `deltalight` command begins: signals end it without a traceback while its modules are imported, too."""

import signal
import sys

from deltalight.services.signals import Terminated, raise_signals


def main() -> None:
    """Runs the command line of this process and exit with its code."""
    raise_signals()
    try:
        from deltalight.services import cli
    except Terminated:
        sys.exit(128 + signal.SIGTERM)
    except KeyboardInterrupt:
        sys.exit(128 + signal.SIGINT)
    cli.main()


if __name__ == "__main__":
    main()
