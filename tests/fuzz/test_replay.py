"""Every decoder takes what fuzzing found, what covers most, and new mutations of it, or refuses it in a sentence."""

from importlib.util import find_spec
from pathlib import Path

import pytest

from tests.fuzz.__main__ import NO_ATHERIS, run_fuzzer, told_figure, write_seeds
from tests.fuzz.seeds import CORPUS, KEPT, corpus, kept, seeds
from tests.fuzz.targets import TARGETS, attempt

LARGEST_BYTES = 200_000
MUTATIONS, SEED = 2_000, 1  # the same in every run, so that only a change of the code finds something new


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


@pytest.mark.slow(seconds=8)
@pytest.mark.skipif(find_spec("atheris") is None, reason=NO_ATHERIS)
@pytest.mark.parametrize("target", TARGETS)
def test_mutations_that_reach_new_code_are_taken_or_refused(target: str, tmp_path: Path) -> None:
    grown, kept = tmp_path / target, tmp_path / "kept"
    for folder in (grown, kept):
        folder.mkdir()
    write_seeds(target, grown)
    code, told = run_fuzzer(target, grown, kept, f"-runs={MUTATIONS}", f"-seed={SEED}")
    found = [path.name for path in kept.iterdir() if not path.name.startswith("slow")]  # tests time nothing
    assert (code, found) == (0, []), told[-3000:]
    assert told_figure(told, "number_of_executed_units") >= MUTATIONS
