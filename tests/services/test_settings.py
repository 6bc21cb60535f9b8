"""Settings: file, environment, command line; where each value comes from; faults as sentences."""

import json
import os
from pathlib import Path

import pytest

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.keys import KeySettings
from deltalight.render_server.server.process import ServerSettings
from deltalight.sensor_node.node import NodeConfig
from deltalight.services.settings import load_configuration
from tests.services.conftest import RunCli


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty current folder, without settings of the user or the environment."""
    for name in [name for name in os.environ if name.startswith("DELTALIGHT_")]:
        monkeypatch.delenv(name)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    return tmp_path / "here"


def write(folder: Path, text: str) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "deltalight.toml"
    path.write_text(text)
    return path


def test_without_a_file_commands_are_as_they_were(place: Path) -> None:
    configuration = load_configuration()
    assert configuration.path is None
    node = configuration.section("node", NodeConfig)
    assert node == NodeConfig(loop=False)
    server = configuration.section("server", ServerSettings)
    assert server.subscribe == ("tcp://127.0.0.1:5601",)
    assert (server.publish, server.control) == ("tcp://127.0.0.1:5602", "tcp://127.0.0.1:5603")
    assert place.is_dir()


def test_the_command_line_beats_the_environment_which_beats_the_file(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write(
        place,
        '[node]\nname = "a"\nsource = "folder"\nloop = true\njpeg_quality = 50\n[node.depth]\nedge_sigmas = 2.5\n',
    )
    monkeypatch.setenv("DELTALIGHT_NODE__NAME", "b")
    monkeypatch.setenv("DELTALIGHT_NODE__SOURCE", "7")  # text, although it looks like a number
    monkeypatch.setenv("DELTALIGHT_NODE__DEPTH__FILTER_RADIUS_PX", "2")
    monkeypatch.setenv("DELTALIGHT_SERVER__SUBSCRIBE", '["tcp://127.0.0.1:1", "tcp://127.0.0.1:2"]')
    monkeypatch.setenv("DELTALIGHT_KEYS__ON_LOOPBACK", "true")
    configuration = load_configuration()
    config = configuration.section("node", NodeConfig, {"name": "c"})
    assert (config.name, config.source, config.loop, config.jpeg_quality) == ("c", "7", True, 50)
    assert (config.depth.edge_sigmas, config.depth.filter_radius_px) == (2.5, 2)
    server = configuration.section("server", ServerSettings)
    assert server.subscribe == ("tcp://127.0.0.1:1", "tcp://127.0.0.1:2")
    assert configuration.section("keys", KeySettings).on_loopback
    _, origins = configuration.explained("node", NodeConfig)
    assert origins["name"] == "DELTALIGHT_NODE__NAME"
    assert origins["jpeg_quality"] == "deltalight.toml"
    assert origins["depth.edge_sigmas"] == "deltalight.toml"
    assert origins["depth.filter_radius_px"] == "DELTALIGHT_NODE__DEPTH__FILTER_RADIUS_PX"
    assert origins["depth.fill_area_px"] == origins["endpoint"] == "default"


def test_a_table_may_be_completed_by_a_later_layer(place: Path) -> None:
    write(place, "[node.fisheye]\nsettle_frames = 5\n")
    config = load_configuration().section("node", NodeConfig, {"fisheye": {"source": "uvc:2"}})
    assert config.fisheye is not None
    assert (config.fisheye.source, config.fisheye.settle_frames) == ("uvc:2", 5)
    with pytest.raises(
        DeltalightError, match=r"deltalight.toml \[node\]: the key `fisheye.source` is missing"
    ):
        load_configuration().section("node", NodeConfig)


def test_the_named_file_comes_before_the_folders_and_that_before_the_users(
    place: Path, tmp_path: Path
) -> None:
    write(tmp_path / "config" / "deltalight", '[node]\nname = "user"\n')
    assert load_configuration().section("node", NodeConfig).name == "user"
    write(place, '[node]\nname = "folder"\n')
    assert load_configuration().section("node", NodeConfig).name == "folder"
    named = write(tmp_path / "other", '[node]\nname = "named"\n')
    assert load_configuration(named).section("node", NodeConfig).name == "named"
    with pytest.raises(DeltalightError, match="cannot be read"):
        load_configuration(tmp_path / "absent.toml")


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("[nod]\nname = 'a'\n", "deltalight.toml: unknown key `nod`; the nearest known key is `node`"),
        ("[node]\nnmae = 'a'\n", r"\[node\]: unknown key `nmae`; the nearest known key is `name`"),
        ("[node.depth]\nedge_sigma = 2\n", "unknown key `depth.edge_sigma`.*`edge_sigmas`"),
        ("[node]\njpeg_quality = 'high'\n", r"\[node\]: `jpeg_quality` is wrong"),
        ("node = 3\n", "`node` is wrong"),
        ("[node\n", "not valid TOML"),
        ("[node.camera]\nloop = true\n", "write `loop` into the node's settings"),
    ],
)
def test_a_wrong_file_is_a_sentence_that_names_the_place(place: Path, text: str, sentence: str) -> None:
    write(place, text)
    with pytest.raises(DeltalightError, match=sentence):
        load_configuration().section("node", NodeConfig)


def test_a_wrong_variable_is_told_of_the_environment(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write(place, '[node]\nname = "a"\n')
    monkeypatch.setenv("DELTALIGHT_NODE__NMAE", "b")
    with pytest.raises(
        DeltalightError, match=r"^environment: unknown key `nmae`; the nearest known key is `name`"
    ):
        load_configuration().section("node", NodeConfig)
    monkeypatch.delenv("DELTALIGHT_NODE__NMAE")
    monkeypatch.setenv("DELTALIGHT_SERVER__SUBSCRIBE", "[tcp")
    with pytest.raises(DeltalightError, match="DELTALIGHT_SERVER"):
        load_configuration().section("server", ServerSettings)
    with pytest.raises(DeltalightError, match=r"^command line: `jpeg_quality`"):
        load_configuration().section("node", NodeConfig, {"jpeg_quality": 0})


def test_what_config_prints_is_a_configuration_file_that_says_the_same(place: Path, cli: RunCli) -> None:
    text = (
        '[node]\nname = "desk"\nsource = "a \\"b\\" \\\\ ü"\n'
        '[node.fisheye]\nsource = "oak"\nexposures_s = [0.001, 0.02]\n'
        '[node.pose_filter]\nbeta = 2\n[server]\nsubscribe = ["tcp://gpu@10.0.0.5:5601"]\n'
    )
    write(place, text)
    before = load_configuration()
    done = cli("config")
    assert done.returncode == 0, done.stderr
    printed = done.stdout
    assert 'name = "desk"' in printed
    assert "# deltalight.toml" in printed
    write(place, printed)
    after = load_configuration()
    for section, model in (("node", NodeConfig), ("server", ServerSettings), ("keys", KeySettings)):
        assert after.section(section, model) == before.section(section, model)
    data = json.loads(cli("config", "--json").stdout)
    assert data["values"]["node"]["fisheye"]["exposures_s"] == [0.001, 0.02]
    assert data["origins"]["node.pose_filter.beta"] == "deltalight.toml"
