"""Stages that may lag behind what keeps changing."""

from operator import add, eq

import pytest

from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.graph import Graph, Resource

pytestmark = pytest.mark.usefixtures("clean_gl")


@pytest.fixture
def graph(gpu: GpuContext) -> Graph:
    return Graph(gpu)


def lagging(graph: Graph, turns: int) -> tuple[Resource[int], Resource[int]]:
    """`late` and `later`, which may lag behind the source `moves` but not behind `other`; `shown` reads all."""
    moves, other = graph.source("moves", "objects"), graph.source("other", "world")
    with graph.lagging(turns, moves):
        late = graph.stage("late", add, moves, other)
        later = graph.stage("later", lambda value: value, late)
    graph.stage("shown", add, moves, later)
    moves.write(0)
    other.write(0)
    graph.begin_frame()
    graph.run()
    return moves, other


def shown_frames(graph: Graph, moves: Resource[int], values: list[int]) -> list[int]:
    """What each frame shows of sources that are written before it: 2 moves if nothing lags."""
    found = []
    for value in values:
        graph.begin_frame()
        moves.write(value, eq)
        graph.run()
        found.append(graph["shown"])
    return found


@pytest.mark.parametrize(
    ("turns", "expected"),
    [(1, [2, 4, 6, 8, 10]), (2, [2, 3, 6, 7, 10]), (3, [2, 3, 4, 8, 9])],
)
def test_stages_may_lag_behind_what_keeps_changing(graph: Graph, turns: int, expected: list[int]) -> None:
    moves, _ = lagging(graph, turns)
    assert shown_frames(graph, moves, [1, 2, 3, 4, 5]) == expected


@pytest.mark.parametrize("turns", [2, 3])
def test_stages_that_lag_catch_up_in_the_next_frame_without_a_change(graph: Graph, turns: int) -> None:
    moves, _ = lagging(graph, turns)
    assert shown_frames(graph, moves, [1, 2]) == [2, 3]
    assert graph.is_lagging
    assert shown_frames(graph, moves, [2]) == [4]
    assert not graph.is_lagging
    assert shown_frames(graph, moves, [2]) == [4]
    assert not any(stage.ran for stage in graph.report())
    assert shown_frames(graph, moves, [5]) == [10]  # the first change after rest shows at once


def test_stages_that_lag_wait_through_all_runs_of_a_frame(graph: Graph) -> None:
    moves, _ = lagging(graph, 3)
    assert shown_frames(graph, moves, [1, 2]) == [2, 3]
    graph.run()
    assert graph["shown"] == 3
    assert shown_frames(graph, moves, [3]) == [4]


def test_stages_lag_behind_nothing_else(graph: Graph) -> None:
    moves, other = lagging(graph, 2)
    assert shown_frames(graph, moves, [1]) == [2]
    graph.begin_frame()
    moves.write(2)
    other.write(10)
    graph.run()
    assert graph["shown"] == 2 + 2 + 10
