"""`deltalight graph`, and what the documentation shows of it."""

import json
from collections.abc import Callable
from pathlib import Path
from xml.etree import ElementTree

import pytest

from deltalight.benchmarks import frame_docs
from deltalight.render_server.graph_report import CLOCKS
from deltalight.services import frame_account
from deltalight.services.frame_account import FrameAccount, account_frame
from deltalight.services.graph_drawing import draw_graph
from deltalight.services.graph_layout import lay_out
from tests.services.conftest import RunCli

SVG = "{http://www.w3.org/2000/svg}"


@pytest.fixture(scope="module")
def account() -> FrameAccount:
    return account_frame("dvct", lambda _: None)


@pytest.fixture
def known_account(account: FrameAccount, monkeypatch: pytest.MonkeyPatch) -> FrameAccount:
    """What the command renders, rendered before."""

    def known(method: str, watch: Callable[[str], None]) -> FrameAccount:
        assert method == account.method
        watch("rendering")
        return account

    monkeypatch.setattr(frame_account, "account_frame", known)
    return account


def titles(svg: str) -> list[str]:
    """Names of the boxes."""
    boxes = ElementTree.fromstring(svg).iterfind(f"{SVG}g/{SVG}title")
    return [(box.text or "").split(":")[0] for box in boxes]


def words(svg: str) -> str:
    """Everything that is written in a picture."""
    lines = ElementTree.fromstring(svg).iter(f"{SVG}text")
    return " ".join(" ".join("".join(line.itertext()).split()) for line in lines)


def test_table_and_picture_of_a_real_frame(cli: RunCli, tmp_path: Path) -> None:
    done = cli("graph", "--method", "paper", "--svg", tmp_path / "graph.svg")
    assert done.returncode == 0, done.stderr
    assert "compiles" in done.stderr
    rows = [
        [cell.strip() for cell in line.split("│")[1:-1]] for line in done.stdout.splitlines() if "│" in line
    ]
    stages = {row[0]: row for row in rows}
    assert stages["shadow maps real"][1].startswith("light views real")
    assert stages["voxelize real"][2:4] == ["voxelize real", "world objects"]
    assert float(stages["voxelize real"][4]) > 1
    assert stages["voxelize real"][5].endswith(" ms")
    assert stages["voxelize real"][6] == "skipped"
    assert stages["split inject"][6] == "ran"
    assert "stages ran" in done.stdout
    assert {"split inject", "real surface", "composite"} <= set(titles((tmp_path / "graph.svg").read_text()))


def test_json_has_every_stage_and_source(cli: RunCli, known_account: FrameAccount) -> None:
    done = cli("graph", "--json")
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["method"] == "dvct"
    assert [stage["name"] for stage in found["stages"]] == [stage.name for stage in known_account.stages]
    cones = next(stage for stage in found["stages"] if stage["name"] == "cones real")
    assert cones["clocks"] == list(CLOCKS)
    assert cones["ran"]
    assert cones["time_ms"] > 0
    assert {source["clock"] for source in found["sources"]} == set(CLOCKS)


@pytest.mark.usefixtures("known_account")
def test_picture_is_xml_that_names_all_stages(cli: RunCli, account: FrameAccount, tmp_path: Path) -> None:
    done = cli("graph", "--svg", tmp_path / "graph.svg")
    assert done.returncode == 0, done.stderr
    svg = (tmp_path / "graph.svg").read_text()
    assert set(titles(svg)) == {stage.name for stage in account.stages if not stage.is_value}
    for stage in account.stages:
        assert stage.name in words(svg)
    for clock in CLOCKS:
        assert clock in words(svg)


def test_picture_fades_what_did_not_run(account: FrameAccount) -> None:
    drawn = ElementTree.fromstring(draw_graph("a frame", account.sources, account.stages))
    faded = {
        (box.findtext(f"{SVG}title") or "").split(":")[0]
        for box in drawn.iterfind(f"{SVG}g")
        if any("stroke-dasharray" in rect.attrib for rect in box.iterfind(f"{SVG}rect"))
    }
    assert faded == {stage.name for stage in account.stages if not (stage.ran or stage.is_value)}
    assert "voxelize real" in faded


def test_no_boxes_overlap_and_all_arrows_lead_on(account: FrameAccount) -> None:
    layout = lay_out(account.stages)
    assert len({(box.band, box.column, box.row) for box in layout.boxes}) == len(layout.boxes)
    occupied = {(box.band, box.column, box.row) for box in layout.boxes}
    for arrow in layout.arrows:
        start, end = arrow.start, arrow.end
        assert (start.band, start.column) < (end.band, end.column)
        if arrow.row is not None:
            between = range(start.column + 1, end.column)
            assert not {(start.band, column, arrow.row) for column in between} & occupied


def test_stage_follows_the_longest_path_of_its_section(account: FrameAccount) -> None:
    columns = {box.stage.name: box.column for box in lay_out(account.stages).boxes}
    chain = (
        "voxelize real",
        "light real voxels",
        "filter mu",
        "bounces real",
        "light joint voxels",
        "filter rho",
    )
    assert [columns[name] - columns[chain[0]] for name in chain] == list(range(len(chain)))


def test_wrong_method_is_one_sentence_with_the_nearest_name(cli: RunCli) -> None:
    done = cli("graph", "--method", "dlvp")
    assert done.returncode == 2
    assert "'dlvp' is not a method; the nearest is dlpv" in done.stderr
    assert len(done.stderr.splitlines()) == 1


def test_a_picture_that_cannot_be_written_is_told_at_once(cli: RunCli, tmp_path: Path) -> None:
    folder = tmp_path / "file"
    folder.touch()
    done = cli("graph", "--svg", folder / "frame.svg")
    assert done.returncode == 2
    assert done.stderr.splitlines() == [f"deltalight: The output folder '{folder}' is a file; name a folder."]


def test_page_has_the_table_of_the_graph(account: FrameAccount) -> None:
    page = frame_docs.PAGE.read_text(encoding="utf-8")
    assert frame_docs.with_table(page, account) == page, "run `python -m deltalight.benchmarks.frame_docs`"


def test_pages_picture_is_that_of_the_graph(account: FrameAccount) -> None:
    committed = frame_docs.PICTURE.read_text(encoding="utf-8")
    assert committed == frame_docs.picture(account), "run `python -m deltalight.benchmarks.frame_docs`"
    assert frame_docs.PICTURE.name in frame_docs.PAGE.read_text(encoding="utf-8")
    for stage in account.stages:
        assert stage.name in words(committed)


def test_every_stage_says_what_it_does(account: FrameAccount) -> None:
    assert not [stage.name for stage in account.stages if len(stage.summary.split()) < 3]
