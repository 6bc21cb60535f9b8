"""`deltalight bench rooms`: its table, and each act once on this host."""

import json
from pathlib import Path

import pytest

from deltalight.benchmarks.rooms.acts import ACTS, LOCAL_ACTS, ActRecord
from deltalight.benchmarks.rooms.command import run_rooms
from deltalight.benchmarks.rooms.report import RoomsReport, all_figures
from deltalight.services.cli import run
from deltalight.services.demo import RECORDING, SCENE


def record(**changed: object) -> ActRecord:
    known = {"placer": "ray", "act": "kill-host", "gap_s": 2.0, "by_spare": True, "same_picture": True}
    return ActRecord.model_validate({**known, "epoch_before": 1, "epoch_after": 2, "load": 0.0, **changed})


def test_figures_meet_their_bars_or_not() -> None:
    records = [record(), record(gap_s=15.1), record(act="move", same_picture=False, epoch_after=1)]
    records.append(record(act="kill-host-cold", by_spare=False))
    figures = {each.what: each for each in all_figures(ACTS, records)}
    assert {what: each.is_met for what, each in figures.items()} == {
        "ray: kill -9 of its host's raylet": False,
        "ray: kill -9 of its host's raylet, as soon as another host has started": True,
        "ray: move to another host": True,
        "ray: picture equal": False,
        "ray: epoch newer": False,
        "ray: taken over by a spare": True,
    }
    assert figures["ray: kill -9 of its host's raylet"].result == "2 to 15.1 s"


def test_wrong_options_are_sentences(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["bench", "rooms", "--placer", "slurm"]) == 2
    assert "'slurm' is not one of 'local', 'ray', 'both'" in capsys.readouterr().err


@pytest.mark.slow(seconds=60)
@pytest.mark.skipif(
    not (RECORDING.is_file() and SCENE.is_file()), reason="the demo's recording is not in this checkout"
)
def test_each_act_leaves_the_same_picture_of_a_newer_epoch(tmp_path: Path) -> None:
    """Nothing here depends on how fast the machine is."""
    said: list[str] = []
    report = run_rooms(["local"], 1, tmp_path, said.append)
    assert [each.act for each in report.acts] == list(LOCAL_ACTS)
    assert all(each.same_picture and each.by_spare for each in report.acts), said
    assert all(each.epoch_after > each.epoch_before for each in report.acts)
    assert all(each.gap_s > 0 for each in report.acts)
    assert report.machine.renderer
    written = RoomsReport.model_validate(json.loads((tmp_path / "rooms.json").read_text()))
    assert written == report
    assert "| local | kill-server |" in (tmp_path / "rooms.md").read_text()
