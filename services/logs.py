"""Log lines of every process: structlog on stderr, because stdout is for data."""

import logging
import os
import sys
from typing import Final

import structlog

from deltalight.protocol.errors import DeltalightError

FORMAT_VARIABLE: Final = "DELTALIGHT_LOG_FORMAT"  # inherited by child processes


def configure_logging(level: str) -> None:
    """Sends log lines of at least `level` to stderr: for people, or as JSON where the environment asks for it.

    Raises:
        DeltalightError: the level is not one of debug, info, warning, error, or the format not text or json.
    """
    number = logging.getLevelNamesMapping().get(level.upper())
    if number is None:
        raise DeltalightError(f"'{level}' is not a log level; use debug, info, warning or error.")
    structlog.configure(
        processors=[structlog.processors.add_log_level, *_renderers(os.environ.get(FORMAT_VARIABLE, "text"))],
        wrapper_class=structlog.make_filtering_bound_logger(number),
        logger_factory=structlog.PrintLoggerFactory(sys.stderr),
    )


def _renderers(wanted: str) -> list[structlog.typing.Processor]:
    """Returns what makes lines: JSON with date and zone (ISO 8601, UTC), or text with the time of day."""
    if wanted == "json":
        return [
            structlog.processors.TimeStamper(fmt="iso", utc=True),
            structlog.processors.format_exc_info,
            structlog.processors.JSONRenderer(default=str),
        ]
    if wanted != "text":
        raise DeltalightError(f"{FORMAT_VARIABLE} is '{wanted}'; set it to text or json.")
    return [
        structlog.processors.TimeStamper(fmt="%H:%M:%S", utc=False),
        structlog.dev.ConsoleRenderer(
            colors=sys.stderr.isatty(), exception_formatter=structlog.dev.plain_traceback
        ),
    ]
