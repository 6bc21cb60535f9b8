"""Log lines: for people, or as JSON for programs that collect them."""

import json
from datetime import UTC, datetime, timedelta

import pytest
import structlog

from deltalight.protocol.errors import DeltalightError
from deltalight.services.logs import FORMAT_VARIABLE, configure_logging


def test_json_lines_have_date_zone_level_and_the_fault(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv(FORMAT_VARIABLE, "json")
    try:
        configure_logging("info")
        try:
            raise ValueError("too late")
        except ValueError as fault:
            structlog.get_logger().warning("not sent", fault=str(fault), exc_info=True)
        (line,) = capsys.readouterr().err.splitlines()
    finally:
        structlog.reset_defaults()
    said = json.loads(line)
    assert (said["level"], said["event"], said["fault"]) == ("warning", "not sent", "too late")
    assert "ValueError: too late" in said["exception"]
    moment = datetime.fromisoformat(said["timestamp"])
    assert moment.utcoffset() == timedelta(0)
    assert abs(datetime.now(UTC) - moment) < timedelta(minutes=5)


def test_an_unknown_format_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(FORMAT_VARIABLE, "xml")
    with pytest.raises(DeltalightError, match=r"set it to text or json"):
        configure_logging("info")
