"""Free memory is given back once many streams have ended, not for each of them."""

import asyncio

import pytest

from deltalight.services.api import memory_return
from deltalight.services.api.memory_return import MANY_STREAMS, MemoryReturn


def test_many_ended_streams_bring_one_return(monkeypatch: pytest.MonkeyPatch) -> None:
    async def returns_after(ended: int) -> int:
        given: list[None] = []
        monkeypatch.setattr(memory_return, "give_back_freed_memory", lambda: given.append(None))
        memory = MemoryReturn()
        for _ in range(ended):
            memory.note_ended()
        for _ in range(1000):
            await asyncio.sleep(0.001)
            if given:
                break
        return len(given)

    monkeypatch.setattr(memory_return, "DELAY_S", 0.0)
    assert asyncio.run(returns_after(MANY_STREAMS - 1)) == 0
    assert asyncio.run(returns_after(3 * MANY_STREAMS)) == 1
