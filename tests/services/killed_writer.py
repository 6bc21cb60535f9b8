"""A process that writes in a loop and tells of each thing that is done, killed (SIGKILL) at any point of its work."""

import multiprocessing
import os
import random
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any

CYCLES = 50


@dataclass(frozen=True)
class KilledWriter:
    """`write` gets the pipe for what it acknowledges, then the arguments of `run`.

    It is killed after 1 to `most_awaited` acknowledgements and up to `longest_delay_s` more, which is about what
    one thing takes, so that the kill falls at any point of one.
    """

    write: Callable[..., None]
    most_awaited: int
    longest_delay_s: float

    def run(self, seed: int, *arguments: object) -> list[Any]:
        """Kills one at a random moment; returns what it had acknowledged."""
        context = multiprocessing.get_context("forkserver")
        context.set_forkserver_preload([self.write.__module__])
        choice = random.Random(seed)
        receiver, sender = context.Pipe(duplex=False)
        process = context.Process(target=self.write, args=(sender, *arguments))
        process.start()
        sender.close()
        acknowledged = [receiver.recv() for _ in range(choice.randint(1, self.most_awaited))]
        time.sleep(choice.uniform(0, self.longest_delay_s))
        assert process.pid is not None
        os.kill(process.pid, signal.SIGKILL)
        process.join()
        assert process.exitcode == -signal.SIGKILL
        return acknowledged + _rest(receiver)


def _rest(receiver: Connection) -> list[Any]:
    rest = []
    try:
        while True:
            rest.append(receiver.recv())
    except EOFError:
        return rest
