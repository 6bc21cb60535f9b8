"""The simulated fleet against closed forms: queues, Little's law, availability; and what must hold of every run."""

import random
from dataclasses import replace
from math import factorial
from statistics import mean

import pytest

from deltalight.benchmarks.fleet import (
    DAY_S,
    Costs,
    Events,
    Fleet,
    FleetSimulation,
    Servers,
    directory_load,
    loads,
    rack_traffic_gbit_s,
)
from deltalight.benchmarks.fleet_costs import kept

COSTS = Costs((1.0,), (1.0,), 1e5, 5e4, 0.0, 2e-5, 350.0, 0.004, 0.0, 0.002, 0.001)
NOTHING_FAILS = Fleet(crashes=0.0, gpu_failures=0.0, host_failures=0.0, rooms_per_keeper=1000)


def queue(servers: int, arrivals_per_s: float, service_s: float, customers: int) -> tuple[Servers, float]:
    """A queue with exponential times between arrivals and of services, and the mean number of customers in it."""
    events, chance = Events(), random.Random(3)
    station = Servers(events, servers)
    present, area, last_s = 0, 0.0, 0.0

    def count(change: int) -> None:
        nonlocal present, area, last_s
        area += present * (events.now_s - last_s)
        present, last_s = present + change, events.now_s

    def arrive(left: int) -> None:
        count(1)
        station.ask(chance.expovariate(1 / service_s), lambda: count(-1))
        if left > 1:
            events.after(chance.expovariate(arrivals_per_s), lambda: arrive(left - 1))

    events.after(0.0, lambda: arrive(customers))
    events.run(2 * customers / arrivals_per_s)
    return station, area / last_s


def erlang_c_wait_s(servers: int, arrivals_per_s: float, service_s: float) -> float:
    """Mean wait of M/M/c (Erlang's C formula)."""
    load = arrivals_per_s * service_s
    share = load / servers
    waiting = load**servers / factorial(servers) / (1 - share)
    waits = waiting / (sum(load**k / factorial(k) for k in range(servers)) + waiting)
    return waits * service_s / (servers * (1 - share))


@pytest.mark.parametrize(("servers", "arrivals_per_s"), [(1, 0.5), (1, 0.8), (3, 2.4), (8, 6.0)])
def test_waits_are_those_of_erlang_and_littles_law_holds(servers: int, arrivals_per_s: float) -> None:
    station, in_it = queue(servers, arrivals_per_s, 1.0, 60_000)
    assert mean(station.waits_s) == pytest.approx(erlang_c_wait_s(servers, arrivals_per_s, 1.0), rel=0.1)
    assert in_it == pytest.approx(arrivals_per_s * mean(station.sojourns_s), rel=0.02)
    assert len(station.sojourns_s) == 60_000


def test_a_start_of_all_rooms_takes_as_many_rounds_as_the_hosts_have_rooms_for_each_place() -> None:
    outcome = FleetSimulation(NOTHING_FAILS, COSTS).run(1)
    rooms_per_host = NOTHING_FAILS.rooms / NOTHING_FAILS.hosts
    assert outcome.first_start_s == pytest.approx(rooms_per_host / NOTHING_FAILS.starts_at_once)
    assert outcome.losses == {"crash": 0, "gpu": 0, "host": 0}
    assert outcome.gaps_s == ()


def test_crashes_are_as_many_as_their_rate_says_and_each_gap_is_detection_and_start() -> None:
    fleet = replace(NOTHING_FAILS, crashes=0.1, starts_at_once=1000)
    outcome = FleetSimulation(fleet, COSTS).run(100)
    expected = fleet.crashes * fleet.rooms * 100
    assert outcome.losses["crash"] == pytest.approx(expected, rel=4 / expected**0.5)
    assert outcome.gaps_s == pytest.approx([fleet.crash_detection_s + 1.0] * len(outcome.gaps_s))


def test_a_room_without_another_gpu_is_away_as_long_as_repairs_take() -> None:
    fleet = replace(NOTHING_FAILS, rooms=1, gpus=1, slots_per_gpu=1, gpu_failures=0.5, repair_h=12)
    outcome = FleetSimulation(fleet, COSTS).run(20_000)
    # A GPU that is broken may fail again, and is repaired when the last of its repairs is done: M/G/infinity.
    away = 1 - 2.718281828 ** -(fleet.gpu_failures * fleet.repair_h / 24)
    assert outcome.downtime_share == pytest.approx(away, rel=0.05)


def test_rooms_wait_where_slots_are_short_and_not_where_there_are_enough() -> None:
    scarce = replace(Fleet(), rooms=160, rooms_per_keeper=160, gpus=32, slots_per_gpu=5, host_failures=0.02)
    outcome = FleetSimulation(scarce, COSTS).run(60)
    assert outcome.most_waiting >= 40
    plenty = FleetSimulation(replace(scarce, slots_per_gpu=50), COSTS).run(60)
    assert plenty.downtime_share < outcome.downtime_share
    assert plenty.most_waiting == 0


def test_a_seed_gives_the_same_run_and_another_seed_another() -> None:
    first, again, other = (FleetSimulation(Fleet(), COSTS, seed).run(30) for seed in (5, 5, 6))
    assert first == again
    assert first != other


def test_the_directory_is_loaded_by_the_square_of_the_fleet_and_racks_are_not() -> None:
    fleet = Fleet(rooms=1000, rooms_per_keeper=2000)
    twice = replace(fleet, rooms=2000, gpus=400)
    assert directory_load(twice, COSTS) == pytest.approx(4 * directory_load(fleet, COSTS))
    assert directory_load(fleet, COSTS) == pytest.approx(25 * 5 * 1000 * 2e-5)
    assert rack_traffic_gbit_s(twice, COSTS) == rack_traffic_gbit_s(fleet, COSTS)
    assert loads(fleet, COSTS)["slots"] == pytest.approx(1000 / 1200)


def test_a_keeper_without_slots_has_rooms_that_wait_although_others_have_free_ones() -> None:
    """Three hosts of 48 slots for 128 rooms: one keeper has enough of them, of two the second has 64 for one host."""
    together = replace(NOTHING_FAILS, rooms=128, gpus=24)
    apart = replace(together, rooms_per_keeper=64)
    assert [fleet.keepers for fleet in (together, apart)] == [1, 2]
    assert [fleet.slots_of_keeper for fleet in (together, apart)] == [144, 48]
    assert [FleetSimulation(fleet, COSTS).run(1).most_waiting for fleet in (together, apart)] == [0, 16]
    assert loads(apart, COSTS)["slots of the keeper with the fewest"] == pytest.approx(64 / 48)


def test_a_hundred_starts_at_once_wait_for_ray_to_create_their_actors() -> None:
    fleet = replace(NOTHING_FAILS, rooms=100, starts_at_once=1000)
    costs = replace(COSTS, gcs_s_per_actor=0.1)
    assert FleetSimulation(fleet, costs).run(1).first_start_s == pytest.approx(100 * 0.1 + 1.0)
    two_keepers = FleetSimulation(replace(fleet, rooms_per_keeper=50), costs).run(1)
    assert two_keepers.first_start_s == pytest.approx(50 * 0.1 + 1.0)
    assert loads(fleet, costs)["Ray's control process, a core"] == pytest.approx(0.002 + 25 * 0.001)


def test_what_follows_rooms_grows_with_those_of_its_keeper_alone() -> None:
    fleet = Fleet(rooms=1000)
    assert (fleet.keepers, fleet.rooms_of_keeper) == (16, 63)
    found = loads(fleet, COSTS)
    assert found == loads(replace(fleet, rooms=2000, rooms_per_keeper=63), COSTS) | {
        key: found[key] for key in found if "slots" in key
    } | {"Ray's control process, a core": found["Ray's control process, a core"]}
    assert found["web process, a core for following rooms"] == pytest.approx(63 * 0.004)


def test_measured_costs_are_in_the_reports_and_of_what_they_say() -> None:
    costs = Costs.measured()
    assert 0 < mean(costs.warm_starts_s) < mean(costs.cold_starts_s) < DAY_S
    assert 0 < costs.picture_bytes < costs.node_frame_bytes
    assert all(room.endpoints is not None for room in kept(3).status().rooms)
