"""Log lines of every process: structlog on stderr, because stdout is for data."""

import logging
import sys

import structlog

from deltalight.protocol.errors import DeltalightError


def configure_logging(level: str) -> None:
    """Send log lines of at least `level` to stderr.

    Raises:
        DeltalightError: the level is not one of debug, info, warning, error.
    """
    number = logging.getLevelNamesMapping().get(level.upper())
    if number is None:
        raise DeltalightError(f"'{level}' is no log level; use debug, info, warning or error.")
    structlog.configure(
        processors=[
            structlog.processors.add_log_level,
            structlog.processors.TimeStamper(fmt="%H:%M:%S", utc=False),
            structlog.dev.ConsoleRenderer(
                colors=sys.stderr.isatty(), exception_formatter=structlog.dev.plain_traceback
            ),
        ],
        wrapper_class=structlog.make_filtering_bound_logger(number),
        logger_factory=structlog.PrintLoggerFactory(sys.stderr),
    )
