"""The rooms file: what it says, and what is refused by one sentence."""

from pathlib import Path

import pytest

from deltalight.protocol.errors import DeltalightError
from deltalight.services.ports import private_ports
from deltalight.services.rooms.rooms_file import RoomsFile, load_rooms
from tests.services.conftest import RunCli

GOOD = """
slots: [0, null]
nodes:
  desk: {source: take.mcap}
  shop: {source: synthetic}
  far: {found: garden}
rooms:
  hall: {nodes: [desk], scene: hall.json, title: The hall}
  door: {nodes: [desk, far]}
"""


def loaded(folder: Path, text: str) -> RoomsFile:
    path = folder / "rooms.yaml"
    path.write_text(text)
    return load_rooms(path)


def test_paths_are_relative_to_the_file_and_rooms_may_share_a_node(tmp_path: Path) -> None:
    (tmp_path / "hall.json").write_text("{}")
    rooms = loaded(tmp_path, GOOD)
    assert rooms.nodes["desk"].source == str(tmp_path / "take.mcap")
    assert rooms.nodes["shop"].source == "synthetic"
    assert rooms.rooms["hall"].scene == tmp_path / "hall.json"
    assert [room.nodes for room in rooms.rooms.values()] == [("desk",), ("desk", "far")]
    assert rooms.devices == (0, None)


def test_a_number_of_slots_is_so_many_on_the_first_device(tmp_path: Path) -> None:
    text = "slots: 3\nnodes: {desk: {source: synthetic}}\nrooms: {hall: {nodes: [desk]}}"
    assert loaded(tmp_path, text).devices == (None, None, None)


HALL = "nodes: {a: {%s}}\nrooms: {hall: {nodes: [a]%s}}"
BOMB = "a0: &a0 [x]\n" + "\n".join(f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]" for n in range(1, 9))


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (
            "nodes: {a: {source: s}}\nrooms: {hall: {nodes: [b]}}",
            "shows the unknown node b; write a instead.",
        ),
        ("nodes: {a: {source: s}}\nrooms: {hall: {nodes: [a]}, hall: {nodes: [a]}}", "`hall` appears twice"),
        ("nodes: {a: {source: s}, a: {source: t}}\nrooms: {hall: {nodes: [a]}}", "`a` appears twice"),
        ("nodes: {a: {source: s}}\nrooms: {a: {nodes: [a]}}", "a is both a node and a room"),
        ("nodes: {a: {source: s}}\nrooms: {hall: {nodes: [a, a]}}", "the room hall names a node twice"),
        ("nodes: {a: {}}\nrooms: {hall: {nodes: [a]}}", "give either the source of a node here"),
        ("nodes: {a: {source: s, endpoint: 'tcp://k@h:1'}}\nrooms: {hall: {nodes: [a]}}", "or an endpoint"),
        ("nodes: {a: {endpoint: 'udp://h:1'}}\nrooms: {hall: {nodes: [a]}}", "is not an endpoint"),
        ("nodes: {a: {source: s, found: t}}\nrooms: {hall: {nodes: [a]}}", "give either the source"),
        ("nodes: {a: {source: s}}\nrooms: {hall: {nodes: []}}", "`rooms.hall.nodes` is wrong"),
        ("nodes: {a: {source: s}}\nrooms: {}", "`rooms` is wrong"),
        ("nodes: {a: {source: s}}\nrooms: {ha/ll: {nodes: [a]}}", "is wrong"),
        ("slots: 0\nnodes: {a: {source: s}}\nrooms: {hall: {nodes: [a]}}", "`slots` is wrong"),
        ("slots: []\nnodes: {a: {source: s}}\nrooms: {hall: {nodes: [a]}}", "`slots` is wrong"),
        (
            "nodes: {a: {source: s}}\nrooms: {hall: {nodes: [a], scene: no.json}}",
            "of the room hall does not exist",
        ),
        ("nodes: {a: {source: s}}\nroom: {}", "the nearest known key is `rooms`"),
        ("- hall", "must hold keys and values"),
        (HALL % ("source: s", "") + f"\nslots: {[0] * 65}", "`slots` is wrong"),
        (HALL % ("source: s", "") + "\nslots: [1000000000000]", "`slots` is wrong"),
        (HALL % ("source: " + "s" * 2000, ""), "`nodes.a.source` is wrong"),
        (HALL % (f"endpoint: 'tcp://{'h' * 2000}:1'", ""), "`nodes.a.endpoint` is wrong"),
        (HALL % ("source: s", f", labels: {{a: {'v' * 64}}}"), "`rooms.hall.labels.a` is wrong"),
        (HALL % ("source: s", f", labels: {dict.fromkeys(range(33), 'v')}"), "`rooms.hall.labels"),
        (BOMB, "is not valid YAML"),
        ("nodes: " + "[" * 1000, "is not valid YAML"),
        ("nodes: {a: [", "is not valid YAML"),
    ],
)
def test_what_cannot_be_right_is_one_sentence(tmp_path: Path, text: str, sentence: str) -> None:
    with pytest.raises(DeltalightError) as refused:
        loaded(tmp_path, text)
    assert sentence in str(refused.value)
    assert "\n" not in str(refused.value)


def test_doubled_keys_of_json_are_refused_too(tmp_path: Path) -> None:
    path = tmp_path / "rooms.json"
    path.write_text(
        '{"nodes": {"a": {"source": "s"}}, "rooms": {"h": {"nodes": ["a"]}, "h": {"nodes": ["a"]}}}'
    )
    with pytest.raises(DeltalightError, match="`h` appears twice"):
        load_rooms(path)


ROOM = "nodes: {a: {source: synthetic}}\nrooms: {hall: {nodes: [a]%s}}\n%s"


@pytest.mark.parametrize(
    ("text", "options", "sentence"),
    [
        (ROOM % ("", "slots: [0, 1]"), ("--placer", "ray"), "give `slots` as a number"),
        (ROOM % (", labels: {network: east}", ""), (), "the room hall asks for labels"),
        (ROOM % ("", ""), ("--ray-address", "auto"), "--ray-address names the cluster of --placer ray"),
        (ROOM % ("", ""), ("--rooms-host", "10.0.0.1"), "--rooms-host is for web processes on other hosts"),
        (None, ("--placer", "ray"), "--placer ray runs the rooms of a rooms file"),
        (None, ("--source", "synthetic", "--ray-address", "auto"), "--ray-address names the cluster"),
        (ROOM % ("", ""), ("--placer", "ray", "--ray-address", "127.0.0.1:1"), "nobody answers"),
        (ROOM % ("", ""), ("--placer", "ray", "--ray-address", "here"), "nobody answers"),
    ],
)
def test_up_refuses_what_placers_cannot_do(
    cli: RunCli, tmp_path: Path, text: str | None, options: tuple[str, ...], sentence: str
) -> None:
    rooms = () if text is None else ("--rooms", str(tmp_path / "rooms.yaml"))
    (tmp_path / "rooms.yaml").write_text(text or "")
    page_port, rooms_port = map(str, private_ports(2))
    more = ("--port", page_port, "--rooms-port", rooms_port, "--data", str(tmp_path / "data"))
    refused = cli("up", *rooms, *options, *more)
    assert refused.returncode == 2
    assert sentence in " ".join(refused.stderr.split())
