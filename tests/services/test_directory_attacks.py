"""The directory of rooms under nonsense, floods, slow readers and strangers: they are refused, and it goes on."""

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from random import Random

import pytest
import zmq

from deltalight.benchmarks.soak.nonsense import mutated
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.keys import Keys, create_keys, load_keys, trust
from deltalight.protocol.messages import ControlRequest
from deltalight.protocol.payloads import encode_control
from deltalight.protocol.rights import allow
from deltalight.protocol.sockets import open_context
from deltalight.services import ports
from deltalight.services.rooms.directory import (
    DRAIN,
    LIST,
    DirectoryClient,
    DirectoryServer,
    SilentDirectoryError,
)
from deltalight.services.rooms.keeper import RoomKeeper
from deltalight.services.storage.drained import Drained
from deltalight.services.storage.store import Store
from tests.services.api_samples import running_api
from tests.services.room_samples import StandInPlacer, plans, running

NONSENSE = 1000
FLOOD = 3000  # more than all queues between hold
AT_ONCE = 20


@dataclass(frozen=True)
class House:
    endpoint: str
    keeper: RoomKeeper

    def states(self) -> list[str]:
        """Of the rooms, as somebody else is told."""
        with closing(DirectoryClient(self.endpoint)) as other:
            return [room.state for room in other.rooms().rooms]


@pytest.fixture
def house(tmp_path: Path) -> Iterator[House]:
    placer = StandInPlacer()
    keeper = RoomKeeper(plans(tmp_path, "hall", "door"), placer)
    running(keeper, placer, "hall", "door")
    endpoint = ports.endpoint(ports.private_ports(1)[0])
    with closing(DirectoryServer(endpoint, keeper)):
        yield House(endpoint, keeper)


def order(op: str, number: int = 0, **payload: object) -> list[bytes]:
    return encode_control(ControlRequest(node="x", capture_ns=0, id=f"{op}-{number}", op=op, payload=payload))


@contextmanager
def sender(endpoint: str, *, kept_answers: int = 1000) -> Iterator["zmq.Socket[bytes]"]:
    """A socket that may send what it likes, when it likes, and need not take answers."""
    context = open_context()
    socket = context.socket(zmq.DEALER)
    socket.rcvhwm, socket.linger, socket.sndtimeo = kept_answers, 0, 10_000
    socket.connect(endpoint)
    try:
        yield socket
    finally:
        context.destroy(0)


def answers(socket: "zmq.Socket[bytes]", count: int) -> list[list[bytes]]:
    """The next answers; all that come within a while if they are fewer."""
    found: list[list[bytes]] = []
    while len(found) < count and socket.poll(5000):
        found.append(socket.recv_multipart())
    return found


def test_nonsense_gets_a_refusal_each_and_moves_no_room(house: House) -> None:
    dice, known = Random(1), [order(LIST), order("move", room="hall", slot="slot-9")]
    with sender(house.endpoint) as stranger:
        for _ in range(NONSENSE):
            stranger.send_multipart([b"", *mutated(dice, dice.choice(known))])
        assert len(answers(stranger, NONSENSE)) == NONSENSE
        for pieces in ([b""], [b"", b""], [b"", *[b""] * 10_000], [b"", b"request.x", b"\xc1" * 65_000]):
            stranger.send_multipart([b"", *pieces])
        assert len(answers(stranger, 4)) == 4
    assert house.states() == ["running", "running"]


def test_what_has_no_form_of_a_request_and_what_is_too_large_get_nothing(house: House) -> None:
    with sender(house.endpoint) as stranger:
        for pieces in ([b"no delimiter"], order(LIST), [b"", b"request", bytes(64 << 20)]):
            stranger.send_multipart(pieces)
        assert not stranger.poll(300)
    assert house.states() == ["running", "running"]


def test_orders_of_wrong_types_are_one_sentence(house: House) -> None:
    wrong: Sequence[object] = (None, 7, ["hall"], {"a": 1}, "", "x" * 500_000, "hall\0", "../hall", "HALL")
    with closing(DirectoryClient(house.endpoint)) as other:
        for op, key in ((DRAIN, "room"), ("start", "room"), ("drain-host", "host"), ("undrain-host", "host")):
            for value in wrong:
                with pytest.raises(DeltalightError) as refused:
                    other._ask(op, {key: value})
                assert not isinstance(refused.value, SilentDirectoryError), value
                assert len(str(refused.value)) <= 2000
    assert house.states() == ["running", "running"]


def test_who_takes_no_answers_and_sends_without_end_holds_up_nobody(house: House) -> None:
    with sender(house.endpoint, kept_answers=1) as greedy, sender(house.endpoint, kept_answers=1) as other:
        for number in range(FLOOD):
            greedy.send_multipart([b"", *order(LIST, number)])
            other.send_multipart([b"", *order("start", number, room="hall")])
            if number % 500 == 0:
                assert house.states() == ["running", "running"]


@dataclass(frozen=True)
class Hosts:
    keeper: Keys
    trusted: Keys
    stranger: Keys


@pytest.fixture
def hosts(tmp_path: Path) -> Hosts:
    def keys_of(name: str) -> Keys:
        create_keys(name, tmp_path / name)
        return replace(load_keys(name, tmp_path / name), on_loopback=True)

    made = Hosts(keys_of("keeper"), keys_of("trusted"), keys_of("stranger"))
    for other in (made.trusted, made.stranger):
        trust(made.keeper.folder / "keeper.key", other.folder)
    trust(made.trusted.folder / "trusted.key", made.keeper.folder)
    return made


def test_strangers_learn_and_move_nothing_and_trusted_hosts_what_their_key_allows(
    hosts: Hosts, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("deltalight.services.rooms.directory.ANSWER_TIMEOUT_S", 0.5)
    placer = StandInPlacer()
    keeper = RoomKeeper(plans(tmp_path, "hall"), placer)
    running(keeper, placer, "hall")
    endpoint = ports.endpoint(ports.private_ports(1)[0])
    of_keeper = endpoint.replace("tcp://", "tcp://keeper@")
    with closing(DirectoryServer(endpoint, keeper, hosts.keeper)):
        for found, keys in ((of_keeper, hosts.stranger), (endpoint, None)):
            with closing(DirectoryClient(found, keys)) as client, pytest.raises(SilentDirectoryError):
                client.command(DRAIN, "hall")
        monkeypatch.undo()
        with closing(DirectoryClient(of_keeper, hosts.trusted)) as client:
            assert client.rooms().rooms[0].state == "running"
            allow(hosts.keeper.folder, "trusted", ["stats"])
            refusal = until_refused(client.rooms)
            assert "allow" in refusal
            with pytest.raises(DeltalightError, match="allow"):
                client.command(DRAIN, "hall")
    assert keeper.status().rooms[0].state == "running"


def until_refused(ask: Callable[[], object]) -> str:
    """What is said once a change of rights, which holds within a second, does."""
    deadline_s = time.monotonic() + 20
    while time.monotonic() < deadline_s:
        try:
            ask()
        except DeltalightError as refusal:
            return str(refusal)
        time.sleep(0.05)
    pytest.fail("it was never refused")


def test_a_directory_with_another_key_is_not_followed(hosts: Hosts, tmp_path: Path) -> None:
    """Who listens at the address of a directory that is away is not taken for it."""
    endpoint = ports.endpoint(ports.private_ports(1)[0])
    impostor = DirectoryServer(endpoint, RoomKeeper(plans(tmp_path, "hall"), StandInPlacer()), hosts.stranger)
    trust(hosts.trusted.folder / "trusted.key", hosts.stranger.folder)
    of_keeper = endpoint.replace("tcp://", "tcp://keeper@")
    with (
        closing(impostor),
        closing(DirectoryClient(of_keeper, hosts.trusted)) as client,
        pytest.raises(SilentDirectoryError),
    ):
        client.rooms()


def test_twenty_callers_at_once_leave_what_the_last_of_them_were_told(tmp_path: Path) -> None:
    """Draining, starting and moving rooms, draining hosts and ending that, all at once, by REST."""
    placer = StandInPlacer(slot_names=("a/1", "a/2", "b/1"))
    with Store(tmp_path / "keeper") as store:
        keeper = RoomKeeper(plans(tmp_path, "hall", "door"), placer, memory=store.drained)
        endpoint = ports.endpoint(ports.private_ports(1)[0])
        running(keeper, placer, "hall", "door")
        with (
            closing(DirectoryServer(endpoint, keeper)),
            running_api(tmp_path / "data", rooms=endpoint) as api,
        ):
            statuses = flooded(
                lambda dice: api.client.request(*dice.choice(ORDERS), timeout=60).status_code, keeper, placer
            )
            assert set(statuses) <= {200, 404, 409, 503}
            assert statuses.count(200) > AT_ONCE
            for request in (("DELETE", "/hosts/a/drain"), ("DELETE", "/hosts/b/drain")):
                assert api.client.request(*request).status_code in (200, 409)
            for room in ("hall", "door"):
                api.client.post(f"/rooms/{room}/start").raise_for_status()
        assert store.drained.load() == Drained()
    for _ in range(4):
        keeper.poll()
        placer.report_all()
    assert [room.state for room in keeper.status().rooms] == ["running", "running"]
    assert sorted(each.room for each in placer.placed.values()) == ["door", "hall"], "none runs twice"


ORDERS = [
    ("POST", "/rooms/hall/drain"),
    ("POST", "/rooms/hall/start"),
    ("POST", "/rooms/door/start"),
    ("POST", "/hosts/a/drain"),
    ("DELETE", "/hosts/a/drain"),
    ("POST", "/hosts/b/drain"),
    ("DELETE", "/hosts/b/drain"),
    ("POST", "/rooms/cellar/drain"),
]


def flooded(ask: Callable[[Random], int], keeper: RoomKeeper, placer: StandInPlacer) -> list[int]:
    """Has callers ask at once, each some times, while the keeper goes on; returns all statuses."""
    statuses: list[int] = []

    def call(seed: int) -> None:
        dice = Random(seed)
        statuses.extend(ask(dice) for _ in range(5))

    threads = [threading.Thread(target=call, args=(seed,)) for seed in range(AT_ONCE)]
    for thread in threads:
        thread.start()
    while any(thread.is_alive() for thread in threads):
        placer.report_all()
        keeper.poll()
        time.sleep(0.01)
    assert len(statuses) == 5 * AT_ONCE, "each was answered"
    return statuses
