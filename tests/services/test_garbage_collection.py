"""Imports without garbage collection."""

import gc
from collections.abc import Iterator

import pytest

from deltalight.services.garbage_collection import no_garbage_collection


@pytest.fixture(autouse=True)
def thawed() -> Iterator[None]:
    yield
    gc.unfreeze()


def test_nothing_is_collected_meanwhile_and_what_was_made_is_kept_out_later() -> None:
    before = gc.get_freeze_count()
    with no_garbage_collection():
        assert not gc.isenabled()
        made: list[list[int]] = [[] for _ in range(10_000)]
    assert gc.isenabled()
    assert gc.get_freeze_count() >= before + len(made)


def test_collection_goes_on_after_an_import_that_fails() -> None:
    with pytest.raises(ModuleNotFoundError), no_garbage_collection():
        __import__("no_such_module")
    assert gc.isenabled()
