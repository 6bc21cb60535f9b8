"""A recorder loses nothing that it has written: one that writes in a loop is killed 50 times at any point."""

from dataclasses import replace
from multiprocessing.connection import Connection
from pathlib import Path

import pytest

from deltalight.protocol.files import ACTIVE_SUFFIX
from deltalight.protocol.recording_reader import RecordingReader
from deltalight.protocol.recording_writer import RecordingWriter
from deltalight.services.recording_copies import recover_recording
from tests.services.killed_writer import CYCLES, KilledWriter
from tests.services.record_samples import BOARD, PERIOD_NS, STARTED_NS, frames

pytestmark = pytest.mark.slow(seconds=30)
SOURCE = frames(2)


def record_until_killed(acknowledge: Connection, path: Path) -> None:
    """Writes frames as fast as it can; tells of each when the writer has taken it."""
    writer, number = RecordingWriter(path, board=BOARD), 0
    while True:
        captured_ns = STARTED_NS + number * PERIOD_NS
        writer.add(replace(SOURCE[number % 2], frame_id=number, timestamp_ns=captured_ns))
        acknowledge.send(number)
        number += 1


def test_every_frame_that_was_written_is_in_the_closed_recording(tmp_path: Path) -> None:
    writer = KilledWriter(record_until_killed, most_awaited=6, longest_delay_s=0.01)
    for seed in range(CYCLES):
        path = tmp_path / f"{seed}.mcap"
        written = len(writer.run(seed, path))
        assert not path.exists()
        done = recover_recording(path.with_name(path.name + ACTIVE_SUFFIX), path, iter)
        assert done is not None
        assert done.lost == 0
        numbers = [frame.frame_id for frame in RecordingReader(path)]
        assert numbers == list(range(len(numbers)))
        assert written <= len(numbers) <= written + 1  # one may be written and not told
        assert recover_recording(path, tmp_path / "again.mcap", iter) is None  # nothing is left to recover
