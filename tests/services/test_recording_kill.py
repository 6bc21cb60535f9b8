"""A recorder loses nothing that it has written: one that writes in a loop is killed 50 times at any point."""

import multiprocessing
import os
import random
import signal
import time
from dataclasses import replace
from multiprocessing.connection import Connection
from pathlib import Path

import pytest

from deltalight.protocol.files import ACTIVE_SUFFIX
from deltalight.protocol.recording_reader import RecordingReader
from deltalight.protocol.recording_writer import RecordingWriter
from deltalight.services.recording_copies import recover_recording
from tests.services.record_samples import BOARD, PERIOD_NS, STARTED_NS, frames

pytestmark = pytest.mark.slow
CYCLES = 50
MOST_AWAITED = 6
LONGEST_DELAY_S = 0.01  # some frames: the kill falls at any point of one
SOURCE = frames(2)


def record_until_killed(path: Path, acknowledge: Connection) -> None:
    """Writes frames as fast as it can; tells of each when the writer has taken it."""
    writer, number = RecordingWriter(path, board=BOARD), 0
    while True:
        captured_ns = STARTED_NS + number * PERIOD_NS
        writer.add(replace(SOURCE[number % 2], frame_id=number, timestamp_ns=captured_ns))
        acknowledge.send(number)
        number += 1


def run_and_kill(context: multiprocessing.context.ForkServerContext, path: Path, seed: int) -> int:
    """Kills a recording process at a random moment of its work; returns how many frames it had written."""
    choice = random.Random(seed)
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=record_until_killed, args=(path, sender))
    process.start()
    sender.close()
    taken = [receiver.recv() for _ in range(choice.randint(1, MOST_AWAITED))]
    time.sleep(choice.uniform(0, LONGEST_DELAY_S))
    assert process.pid is not None
    os.kill(process.pid, signal.SIGKILL)
    process.join()
    assert process.exitcode == -signal.SIGKILL
    try:
        while True:
            taken.append(receiver.recv())
    except EOFError:
        return len(taken)


def test_every_frame_that_was_written_is_in_the_closed_recording(tmp_path: Path) -> None:
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["tests.services.test_recording_kill"])
    for seed in range(CYCLES):
        path = tmp_path / f"{seed}.mcap"
        written = run_and_kill(context, path, seed)
        assert not path.exists()
        done = recover_recording(path.with_name(path.name + ACTIVE_SUFFIX), path, iter)
        assert done is not None
        assert done.lost == 0
        numbers = [frame.frame_id for frame in RecordingReader(path)]
        assert numbers == list(range(len(numbers)))
        assert written <= len(numbers) <= written + 1  # one may be written and not told
        assert recover_recording(path, tmp_path / "again.mcap", iter) is None  # nothing is left to recover
