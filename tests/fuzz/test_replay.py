"""Replays what fuzzing found and what covers most: every decoder takes it, or refuses it in a sentence."""

import pytest

from tests.fuzz.seeds import CORPUS, KEPT, corpus, kept, seeds
from tests.fuzz.targets import TARGETS, attempt

LARGEST_BYTES = 200_000


@pytest.mark.filterwarnings(
    "ignore::RuntimeWarning", "ignore::UserWarning"
)  # of libraries, about such inputs
@pytest.mark.parametrize("target", TARGETS)
def test_the_corpus_and_all_kept_cases_are_taken_or_refused(target: str) -> None:
    taken = [attempt(target, data) for data in corpus(target) + kept(target)]
    assert len(taken) > 8
    assert not all(taken)


def test_every_target_takes_its_first_inputs() -> None:
    tried = [(target, attempt(target, data)) for target, data in seeds()]
    assert {target for target, taken in tried if taken} == set(TARGETS)


def test_the_corpus_stays_small() -> None:
    files = [path for folder in (CORPUS, KEPT) for path in folder.rglob("*") if path.is_file()]
    assert sum(path.stat().st_size for path in files) < LARGEST_BYTES
