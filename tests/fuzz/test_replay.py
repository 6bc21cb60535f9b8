"""Replays what fuzzing found and what covers most: every decoder takes it, or refuses it in a sentence."""

from pathlib import Path

import pytest

from tests.fuzz.seeds import seeds
from tests.fuzz.targets import TARGETS, attempt

HERE = Path(__file__).parent


@pytest.mark.parametrize("target", TARGETS)
def test_the_corpus_and_all_kept_cases_are_taken_or_refused(target: str) -> None:
    corpus = sorted((HERE / "corpus" / target).iterdir())
    kept = sorted((HERE / "kept" / target).glob("*"))
    assert corpus
    taken = [attempt(target, path.read_bytes()) for path in [*corpus, *kept]]
    assert any(taken)


def test_every_target_takes_its_first_inputs() -> None:
    tried = [(target, attempt(target, data)) for target, data in seeds()]
    assert {target for target, taken in tried if taken} == set(TARGETS)


def test_the_corpus_stays_small() -> None:
    assert sum(path.stat().st_size for path in HERE.rglob("*/*/*") if path.suffix != ".pyc") < 200_000
