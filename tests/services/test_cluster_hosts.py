"""What hosts of a cluster say of themselves is taken within limits; Ray is a stand-in."""

from typing import Any

from deltalight.services.rooms.ray_cluster import RayCluster
from deltalight.services.rooms.rooms_file import MAX_ROOMS


class Ray:
    """Knows these nodes."""

    def __init__(self, *nodes: dict[str, Any]) -> None:
        self.nodes = lambda: list(nodes)


def node(name: str, slots: object = 1, **labels: str) -> dict[str, Any]:
    return {
        "Alive": True,
        "NodeID": name.encode().hex()[:12].ljust(12, "0"),
        "NodeName": name,
        "NodeManagerHostname": "localhost",
        "NodeManagerAddress": "10.0.0.1",
        "Resources": {} if slots is None else {"render_slot": slots},
        "Labels": labels,
    }


def cluster(*nodes: dict[str, Any]) -> RayCluster:
    made = RayCluster.__new__(RayCluster)
    made.ray = Ray(*nodes)
    return made


def test_a_host_has_no_more_slots_than_there_may_be_rooms() -> None:
    offered = (1e300, float("inf"), float("nan"), 10**9, 3.7, 0.5, 0, -4, None)
    hosts = cluster(*(node(f"host-{number}", slots) for number, slots in enumerate(offered))).hosts()
    assert [host.slots for host in hosts] == [MAX_ROOMS] * 4 + [3]


def test_a_name_that_writes_to_terminals_or_fits_no_address_is_ray_s_id() -> None:
    names = ["gpu-a", "\x1b[2Jgpu", "a/1", "x" * 300, "", "gpu\nb"]
    found = [host.name for host in cluster(*(node(name) for name in names)).hosts()]
    assert "gpu-a" in found
    assert len(found) == len(set(found)) == len(names)
    assert sum(name.startswith("host-") for name in found) == 5


def test_the_address_as_a_name_is_the_host_s_own() -> None:
    assert [host.name for host in cluster(node("10.0.0.1")).hosts()] == ["localhost"]
