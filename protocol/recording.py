"""Recordings (docs/formats.md 2): one `.mcap` file per take."""

from protocol.recording_reader import RecordingReader
from protocol.recording_writer import RecordingWriter

__all__ = ["RecordingReader", "RecordingWriter"]
