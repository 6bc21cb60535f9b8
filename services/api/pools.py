"""Pools of threads for requests that may take long: one for each thing that they wait for.

The framework runs all other requests in one pool of 40 threads. What waits for a child process, a lock or the render
server would fill that one, and stop requests that have nothing to do with it.
"""

import asyncio
from collections.abc import Callable, Mapping
from math import ceil
from typing import Literal, TypeVar

from anyio import CapacityLimiter, to_thread

from deltalight.services.api.problems import ProblemError

PoolName = Literal[
    "render server",
    "replay",
    "recordings",
    "recording uploads",
    "assets",
    "asset files",
    "thumbnails",
    "cameras",
    "documents",
]
Answer = TypeVar("Answer")


class Pool:
    """Runs at most `threads` calls at a time; the others wait for `patience_s` without a thread (one event loop)."""

    def __init__(self, name: PoolName, threads: int, patience_s: float) -> None:
        self.patience_s = patience_s
        self.name = name
        self._places = asyncio.Semaphore(threads)

    async def run(self, call: Callable[[], Answer]) -> Answer:
        """Returns the result of `call`, which runs in a thread.

        Raises:
            ProblemError: earlier calls took too long.
        """
        try:
            async with asyncio.timeout(self.patience_s):
                await self._places.acquire()
        except TimeoutError:
            sentence = f"Too many requests wait for the {self.name}; try again soon."
            raise ProblemError(503, "busy", sentence, {"Retry-After": str(ceil(self.patience_s))}) from None
        try:
            return await to_thread.run_sync(call, limiter=CapacityLimiter(1))
        finally:
            self._places.release()


def make_pools() -> Mapping[PoolName, Pool]:
    """Returns the pools of one service."""
    pools = (
        Pool("render server", 8, patience_s=10.0),
        Pool("replay", 4, patience_s=10.0),
        Pool("recordings", 4, patience_s=10.0),
        Pool("recording uploads", 2, patience_s=60.0),  # the check of one may take minutes
        Pool("assets", 4, patience_s=60.0),  # the check of one may take a minute
        Pool("asset files", 8, patience_s=10.0),  # which may have to be brought here
        Pool("thumbnails", 4, patience_s=10.0),
        Pool("cameras", 2, patience_s=10.0),
        Pool("documents", 1, patience_s=10.0),  # threads that parse would only take turns
    )
    return {pool.name: pool for pool in pools}
