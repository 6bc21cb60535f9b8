"""The graph of stages: what runs when, in which order, and what it says of stages that do not fit together."""

import math
from collections.abc import Callable
from operator import eq
from typing import Any

import pytest

from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.timers import PassTimers
from deltalight.render_server.graph import Graph, GraphError, Resource

pytestmark = pytest.mark.usefixtures("clean_gl")


@pytest.fixture
def graph(gpu: GpuContext) -> Graph:
    return Graph(gpu)


class Calls:
    """Functions for stages that note when they are called."""

    def __init__(self) -> None:
        self.names: list[str] = []

    def __call__(
        self, name: str, function: Callable[..., Any] = lambda *values: sum(values)
    ) -> Callable[..., Any]:
        def noted(*values: object) -> object:
            self.names.append(name)
            return function(*values)

        return noted

    def taken(self) -> list[str]:
        names, self.names = self.names, []
        return names


@pytest.fixture
def calls() -> Calls:
    return Calls()


def diamond(graph: Graph, calls: Calls) -> tuple[Resource[int], Resource[int]]:
    """Sources a and b; c reads a, d reads b, e reads both."""
    a, b = graph.source("a", "world"), graph.source("b", "view")
    c, d = graph.stage("c", calls("c"), a), graph.stage("d", calls("d"), b)
    graph.stage("e", calls("e"), c, d)
    a.write(1)
    b.write(2)
    return a, b


# What runs


def test_only_what_a_change_reaches_runs_again(graph: Graph, calls: Calls) -> None:
    a, b = diamond(graph, calls)
    graph.run()
    assert calls.taken() == ["c", "d", "e"]
    assert graph["e"] == 3
    graph.run()
    assert calls.taken() == []
    b.write(5)
    graph.run()
    assert calls.taken() == ["d", "e"]
    assert graph["e"] == 6
    a.write(10)
    graph.run()
    assert calls.taken() == ["c", "e"]
    assert graph["e"] == 15


def test_versions_count_changes(graph: Graph, calls: Calls) -> None:
    a, _ = diamond(graph, calls)
    assert (a.version, graph.resource("c").version) == (1, 0)
    for count in (1, 2, 3):
        a.write(count)
        graph.run()
        assert (a.version, graph.resource("c").version, graph.resource("d").version) == (count + 1, count, 1)


def test_a_value_that_is_the_same_is_no_change(graph: Graph, calls: Calls) -> None:
    source = graph.source("source", "scene")
    rounded = graph.stage("rounded", calls("rounded", round), source, same=eq)
    graph.stage("shown", calls("shown", str), rounded)
    source.write(1.2)
    graph.run()
    assert calls.taken() == ["rounded", "shown"]
    source.write(0.9)
    graph.run()
    assert calls.taken() == ["rounded"]
    source.write(1.7)
    graph.run()
    assert calls.taken() == ["rounded", "shown"]
    assert graph["shown"] == "2"
    source.write(1.7, eq)
    graph.run()
    assert calls.taken() == []


def test_the_newest_of_same_values_is_kept(graph: Graph) -> None:
    """A value that equals the last may be another object, and what it replaces may be gone."""
    source: Resource[list[int]] = graph.source("source", "scene")
    source.write([1], eq)
    again = [1]
    source.write(again, eq)
    assert source.version == 1
    assert source.value is again


def test_the_first_value_is_a_change_whatever_it_equals(graph: Graph) -> None:
    source: Resource[None] = graph.source("source", "scene")
    source.write(None, eq)
    assert source.version == 1


def test_a_stage_without_inputs_runs_once(graph: Graph, calls: Calls) -> None:
    graph.stage("constant", calls("constant", lambda: 3))
    for _ in range(2):
        graph.run()
    assert calls.taken() == ["constant"]
    assert graph["constant"] == 3


def test_a_stage_of_several_outputs_writes_each(graph: Graph, calls: Calls) -> None:
    a = graph.source("a", "view")
    whole, rest = graph.stages(
        "split", calls("split", lambda value: divmod(value, 10)), a, outputs=("whole", "rest")
    )
    graph.stage("sum", calls("sum"), whole, rest)
    a.write(47)
    graph.run()
    assert (whole.value, rest.value, graph["sum"]) == (4, 7, 11)
    assert calls.taken() == ["split", "sum"]
    assert "split" not in graph


# Targets and polled sources


def test_only_what_the_targets_need_runs(graph: Graph, calls: Calls) -> None:
    a, b = diamond(graph, calls)
    graph.run(graph.resource("c"))
    assert calls.taken() == ["c"]
    graph.run(graph.resource("c"), graph.resource("d"))
    assert calls.taken() == ["d"]
    a.write(4)
    b.write(4)
    graph.run(graph.resource("d"))
    assert calls.taken() == ["d"]
    graph.run()
    assert calls.taken() == ["c", "e"]
    assert graph["e"] == 8


def test_a_polled_source_is_asked_before_each_run_that_needs_it(graph: Graph, calls: Calls) -> None:
    answers = iter([1, 1, 2, 2])
    asked: list[int] = []

    def ask() -> int:
        asked.append(next(answers))
        return asked[-1]

    polled = graph.polled("polled", "objects", ask, eq)
    graph.stage("reader", calls("reader"), polled)
    other = graph.stage("other", calls("other", lambda: 0))
    graph.run(other)
    assert asked == []
    calls.taken()
    graph.run()
    assert calls.taken() == ["reader"]
    graph.run()
    assert (asked, calls.taken()) == ([1, 1], [])
    graph.run(graph.resource("reader"))
    assert (asked, calls.taken()) == ([1, 1, 2], ["reader"])
    graph.run(polled)
    assert asked == [1, 1, 2, 2]


def test_a_polled_source_sees_sources_of_the_same_run(graph: Graph) -> None:
    source = graph.source("source", "objects")
    polled = graph.polled("doubled", "objects", lambda: 2 * source.value, eq)
    graph.stage("sum", lambda first, second: first + second, source, polled)
    for value in (1, 5):
        source.write(value)
        graph.run()
        assert graph["sum"] == 3 * value


# Order and clocks


def test_stages_run_in_the_order_of_their_declaration_where_inputs_leave_a_choice(
    graph: Graph, calls: Calls
) -> None:
    a = graph.source("a", "view")
    for name in ("z", "m", "b"):
        graph.stage(name, calls(name), a)
    a.write(1)
    graph.run()
    assert calls.taken() == ["z", "m", "b"]


def test_inputs_may_be_named_before_they_are_declared(graph: Graph, calls: Calls) -> None:
    graph.stage("last", calls("last"), "middle", "a")
    graph.stage("middle", calls("middle"), "a")
    a = graph.source("a", "view")
    a.write(2)
    graph.run()
    assert calls.taken() == ["middle", "last"]
    assert graph["last"] == 4


def test_a_stage_declared_after_a_run_joins_in(graph: Graph, calls: Calls) -> None:
    diamond(graph, calls)
    graph.run()
    calls.taken()
    graph.stage("f", calls("f"), "e")
    graph.run()
    assert calls.taken() == ["f"]


def test_a_resource_follows_the_clocks_of_all_that_it_was_made_from(graph: Graph) -> None:
    """Of inputs too that were named before they were declared; nothing has to run for that."""
    graph.stage("shaded", lambda *_: 0, "lit", "pixels")
    graph.stage("lit", lambda *_: 0, "voxels", "lamps")
    graph.stages("voxelize", lambda *_: (0, 0), "meshes", "settings", outputs=("voxels", "grid"))
    for name, clock in (
        ("pixels", "view"),
        ("meshes", "objects"),
        ("lamps", "lights"),
        ("settings", "scene"),
    ):
        graph.source(name, clock)  # type: ignore[arg-type]
    clocks = {stage.name: stage.clocks for stage in graph.report()}
    assert clocks == {
        "voxelize": ("scene", "objects"),
        "lit": ("scene", "lights", "objects"),
        "shaded": ("scene", "lights", "objects", "view"),
    }
    assert graph.resource("grid").clocks == {"scene", "objects"}


# Failures


def test_a_stage_that_raised_runs_again_with_what_leads_to_it_and_nothing_that_reads_it_did(
    graph: Graph, calls: Calls
) -> None:
    """It may have changed what it was given, in part."""
    broken = True

    def reciprocal(value: float) -> float:
        if broken:
            raise ZeroDivisionError("broken")
        return 1 / value

    a = graph.source("a", "view")
    graph.stage("before", calls("before"), a)
    graph.stage("beside", calls("beside"), a)
    graph.stage("reciprocal", calls("reciprocal", reciprocal), "before")
    graph.stage("after", calls("after"), "reciprocal")
    a.write(4)
    with pytest.raises(ZeroDivisionError) as caught:
        graph.run()
    assert caught.value.__notes__ == ["Stage `reciprocal` raised it."]
    assert calls.taken() == ["before", "beside", "reciprocal"]
    assert [graph.resource(name).version for name in ("before", "reciprocal", "after")] == [1, 0, 0]
    assert [stage.ran for stage in graph.report()] == [True, True, False, False]
    broken = False
    graph.run()
    assert calls.taken() == ["before", "reciprocal", "after"]
    assert graph["after"] == 0.25


def test_a_failure_keeps_the_old_values_and_versions(graph: Graph, calls: Calls) -> None:
    a = graph.source("a", "view")
    graph.stages("divide", lambda value: (1 / value, 2 / value), a, outputs=("one", "two"))
    graph.stage("sum", calls("sum"), "one", "two")
    a.write(2)
    graph.run()
    a.write(0)
    with pytest.raises(ZeroDivisionError):
        graph.run()
    assert [(graph[name], graph.resource(name).version) for name in ("one", "two", "sum")] == [
        (0.5, 1),
        (1.0, 1),
        (1.5, 1),
    ]
    with pytest.raises(
        ZeroDivisionError
    ):  # the reader asks for it again, though its own inputs are as they were
        graph.run(graph.resource("sum"))
    assert calls.taken() == ["sum"]


def test_a_wrong_number_of_values_writes_none_of_them(graph: Graph) -> None:
    values: tuple[int, ...] = (1,)
    graph.stages("pair", lambda: values, outputs=("left", "right"))
    with pytest.raises(GraphError, match="Stage `pair` returned 1 values for `left`, `right`"):
        graph.run()
    assert graph.resource("left").version == 0
    values = (1, 2, 3)
    with pytest.raises(GraphError, match="Stage `pair` returned 3 values for `left`, `right`"):
        graph.run()
    values = (1, 2)
    graph.run()
    assert (graph["left"], graph["right"]) == (1, 2)


def test_one_value_for_two_outputs_is_told(graph: Graph) -> None:
    graph.stages("pair", lambda: None, outputs=("left", "right"))
    with pytest.raises(GraphError, match="Stage `pair` returned 1 values for `left`, `right`"):
        graph.run()


# Stages and resources that do not fit together


def test_a_circle_of_stages_is_named(graph: Graph) -> None:
    graph.stage("before", lambda x: x, "a")
    graph.stages("a", lambda x: (x, x), "c", outputs=("a", "other"))
    graph.stage("b", lambda x: x, "other")
    graph.stage("c", lambda x: x, "b")
    circle = "`a` reads `c` of `c`, `c` reads `b` of `b`, `b` reads `other` of `a`"
    for _ in range(2):  # and again: nothing of the failed order is kept
        with pytest.raises(GraphError, match=f"in a circle: {circle}"):
            graph.run()


def test_a_stage_that_reads_itself_is_a_circle(graph: Graph) -> None:
    graph.stage("a", lambda x: x, "a")
    with pytest.raises(GraphError, match="in a circle: `a` reads `a` of `a`"):
        graph.report()


def test_a_resource_that_is_read_before_it_is_written_is_named_with_its_reader(graph: Graph) -> None:
    source = graph.source("lamps", "lights")
    graph.stage("maps", lambda x: x, source)
    with pytest.raises(GraphError, match="Stage `maps` reads `lamps` before it is written"):
        graph.run()
    with pytest.raises(GraphError, match="Resource `maps` is read before it is written"):
        graph["maps"]
    with pytest.raises(GraphError, match="Resource `lamps` is read before it is written"):
        _ = source.value


def test_an_input_that_no_stage_writes_is_named_with_the_nearest(graph: Graph) -> None:
    graph.source("shadow maps", "lights")
    graph.stage("direct light", lambda x: x, "shadow map")
    with pytest.raises(
        GraphError, match=r"Stage `direct light` reads `shadow map`, .*nearest is `shadow maps`"
    ):
        graph.run()
    with pytest.raises(GraphError, match="no resource `shadw maps`; the nearest is `shadow maps`"):
        graph.resource("shadw maps")
    with pytest.raises(GraphError, match=r"no resource `xyz`\.$"):
        graph["xyz"]


def test_an_input_of_another_graph_is_refused(gpu: GpuContext, graph: Graph) -> None:
    other = Graph(gpu).source("a", "view")
    with pytest.raises(GraphError, match="Stage `reader` reads `a` of another graph"):
        graph.stage("reader", lambda x: x, other)
    graph.source("a", "view")
    with pytest.raises(GraphError, match="Stage `reader` reads `a` of another graph"):
        graph.stage("reader", lambda x: x, other)


def test_a_resource_has_one_writer(graph: Graph) -> None:
    graph.source("a", "view")
    graph.stage("b", lambda: 0)
    with pytest.raises(GraphError, match="`a` is written by a source and by stage `c`"):
        graph.stages("c", lambda: (0, 0), outputs=("new", "a"))
    assert "new" not in graph
    with pytest.raises(GraphError, match="`b` is written by stage `b` and by stage `c`"):
        graph.stages("c", lambda: (0, 0), outputs=("b", "new"))
    with pytest.raises(GraphError, match="`b` is written by stage `b` and by a source"):
        graph.source("b", "view")
    with pytest.raises(GraphError, match="`new` is written by stage `c` and by stage `c`"):
        graph.stages("c", lambda: (0, 0), outputs=("new", "new"))
    graph.stages("c", lambda: (1, 2), outputs=("new", "newer"))
    graph.run(graph.resource("newer"))
    assert graph["newer"] == 2


def test_a_stage_has_a_name_and_an_output_of_its_own(graph: Graph) -> None:
    graph.stages("a", lambda: (0, 0), outputs=("b", "c"))
    with pytest.raises(GraphError, match="There is a stage `a` already"):
        graph.stage("a", lambda: 0)
    with pytest.raises(GraphError, match="Stage `d` writes no resource"):
        graph.stages("d", lambda: (), outputs=())


# Report and release


def test_the_report_tells_what_ran_how_long_and_how_large_it_is(gpu: GpuContext) -> None:
    timers = PassTimers(gpu)
    graph = Graph(gpu, timers)
    a, b = graph.source("a", "world"), graph.source("b", "view")
    grid = graph.stage("grid", lambda _: [gpu.ctx.buffer(reserve=16) for _ in range(2)], a)
    graph.stages("pair", lambda _, held: (held, 0), b, grid, outputs=("left", "right"))
    unread = graph.report()
    assert [(stage.name, stage.ran, stage.size_bytes, stage.time_ms) for stage in unread] == [
        ("grid", False, 0, None),
        ("pair", False, 0, None),
    ]
    a.write(0)
    for value, ran in ((0, [True, True]), (1, [False, True])):
        b.write(value)
        graph.run()
        timers.end_frame()
        timers.wait()
        report = graph.report()
        assert [stage.ran for stage in report] == ran
        assert set(timers.times_ms) == {stage.name for stage in report if stage.ran}
        assert all(stage.time_ms is not None and math.isfinite(stage.time_ms) for stage in report)
    assert (report[1].inputs, report[1].outputs, report[1].clocks) == (
        ("b", "grid"),
        ("left", "right"),
        ("world", "view"),
    )
    assert [stage.size_bytes for stage in report] == [32, 0]  # each byte once, where it was made


class Owner:
    """What stages are methods of."""

    def __init__(self, released: list["Owner"]) -> None:
        self._released = released

    def make(self) -> int:
        return 0

    def change(self, value: int) -> int:
        return value + 1

    def release(self) -> None:
        self._released.append(self)


def test_the_graph_releases_what_its_stages_are_methods_of_once_and_in_reverse(graph: Graph) -> None:
    released: list[Owner] = []
    first, second, given = Owner(released), Owner(released), Owner(released)
    graph.stage("a", first.make)
    graph.stage("b", second.change, "a")
    graph.stage("c", first.change, "b")
    graph.stage("d", lambda x: x, "c")
    graph.own(given)
    graph.own(object())
    graph.run()
    assert graph["d"] == 2
    graph.release()
    assert released == [given, second, first]
    graph.release()
    assert len(released) == 3


def test_views_share_the_stages_that_do_not_follow_them(gpu: GpuContext) -> None:
    graph, ran = Graph(gpu), list[str]()

    class World:
        def double(self, value: int) -> int:
            ran.append("double")
            return 2 * value

    def shown(world: int, view: int) -> int:
        ran.append("shown")
        return world + view

    sources, results = [], []
    for number in range(2):
        with graph.of_view(number):
            world, view = graph.source("world", "world"), graph.source("view", "view")
            doubled = graph.stage("double", graph.shared("world", World).double, world)
            results.append(graph.stage("shown", shown, "double", view))
            sources.append(view)
            assert graph.resource("shown") is results[-1]
            assert graph.resource("double") is doubled
    assert [stage.name for stage in graph.report()] == ["double", "shown", "shown (view 2)"]
    world.write(10)
    for number, source in enumerate(sources):
        source.write(number)
    graph.run()
    assert ran == ["double", "shown", "shown"]
    assert [result.value for result in results] == [20, 21]
    sources[1].write(5)
    graph.run()
    assert ran[3:] == ["shown"]
    assert results[1].value == 25
