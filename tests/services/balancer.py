"""A TCP load balancer in a thread: connections go to the backends in turn, past those that refuse them."""

import asyncio
import itertools
import threading
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress

from deltalight.services import ports

CHUNK_BYTES = 1 << 16


class Balancer:
    """Listens at `port` of loopback until `close`; `served` counts the connections of each backend's port."""

    def __init__(self, backends: Sequence[int]) -> None:
        self.served: Counter[int] = Counter()
        self._backends = itertools.cycle(backends)
        self._count = len(backends)
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, daemon=True)
        self._thread.start()
        listening = asyncio.start_server(self._serve, ports.LOOPBACK, 0)
        self._server = asyncio.run_coroutine_threadsafe(listening, self._loop).result()
        self.port = int(self._server.sockets[0].getsockname()[1])

    def close(self) -> None:
        asyncio.run_coroutine_threadsafe(self._end(), self._loop).result()
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    async def _end(self) -> None:
        self._server.close()
        connections = asyncio.all_tasks() - {asyncio.current_task()}
        for each in connections:
            each.cancel()
        await asyncio.gather(*connections, return_exceptions=True)

    async def _serve(self, client: asyncio.StreamReader, answers: asyncio.StreamWriter) -> None:
        for backend in itertools.islice(self._backends, self._count):
            with suppress(OSError):
                source, requests = await asyncio.open_connection(ports.LOOPBACK, backend)
                break
        else:
            answers.close()
            return
        self.served[backend] += 1
        try:
            await asyncio.wait(
                [
                    asyncio.ensure_future(_copy(client, requests)),
                    asyncio.ensure_future(_copy(source, answers)),
                ]
            )
        finally:
            requests.close()
            answers.close()


async def _copy(source: asyncio.StreamReader, target: asyncio.StreamWriter) -> None:
    with suppress(OSError):
        while data := await source.read(CHUNK_BYTES):
            target.write(data)
            await target.drain()
    target.close()
