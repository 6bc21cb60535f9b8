"""Fixtures of the protocol's tests."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any

import pytest


@pytest.fixture
def opened() -> Iterator[Callable[[Any], Any]]:
    """`opened(resource)` gives the resource back and closes it at the end of the test."""
    with ExitStack() as stack:

        def register(resource: Any) -> Any:  # noqa: ANN401 - whatever has a `close`
            stack.callback(resource.close)
            return resource

        yield register
