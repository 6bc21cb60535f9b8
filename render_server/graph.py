"""The frame as a graph: stages that read and write versioned resources and rerun only when an input changed.

A method declares its stages once; every frame sets the sources and runs the graph. Each resource inherits the
clocks of all that it is computed from, so the graph shows what a moving camera costs before anything is
drawn.
"""

import time
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from difflib import get_close_matches
from typing import Any, TypeVar

from deltalight.protocol.plugins import Plugin, blamed
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Dispatch, watched
from deltalight.render_server.gpu.textures import gpu_objects, sizes_bytes
from deltalight.render_server.gpu.timers import PassTimers
from deltalight.render_server.graph_report import CLOCKS, Clock, SourceReport, StageReport, summary
from deltalight.render_server.lag import Lag
from deltalight.render_server.stages import (
    GraphError,
    Resource,
    Same,
    Stage,
    complete_clocks,
    in_order,
    needed_for,
    require_kinds,
)

__all__ = ["Graph", "GraphError", "Resource", "Stage"]

T = TypeVar("T")
UNTIMED = nullcontext()
_Polled = tuple[Resource[Any], Callable[[], Any], Same]


class Graph:
    """Stages in the order in which they run, and the resources between them.

    The graph owns the objects whose methods its stages call, and releases them. With `checks`, it is an error if a
    stage's kernel writes what belongs to another stage (slow; for tests).
    """

    def __init__(self, gpu: GpuContext, timers: PassTimers | None = None, *, checks: bool = False) -> None:
        self.gpu = gpu
        self.timers = timers
        self._checks = checks
        self._sections: list[tuple[int, str]] = []
        self._values: set[str] = set()
        self._runs, self._first_run = 0, 0  # so many so far, and the number of the frame's first
        self._begun: dict[Resource[Any], int] = {}  # versions of the sources when the frame began
        self._resources: dict[str, Resource[Any]] = {}
        self._sources: list[Resource[Any]] = []
        self._stages: list[Stage] = []
        self._named: dict[Stage, list[str]] = {}
        self._order: list[Stage] | None = None
        self._polled: list[_Polled] = []
        # By targets of a run: the stages that make them and the sources to ask, until more is declared.
        self._needed: dict[tuple[Resource[Any], ...], tuple[list[Stage], list[_Polled]]] = {}
        self._owned: list[Any] = []
        self._plugin: Plugin | None = None
        self._view = 0
        self._shared: dict[str, Any] = {}
        self._lags: list[Lag] = []
        self._lag: Lag | None = None

    def source(self, name: str, clock: Clock, *, of_each_view: bool | None = None) -> Resource[Any]:
        """Declares a resource that is set from outside (`Resource.write`).

        `of_each_view`: each view declares its own, instead of one for all; default: if its clock is `view`.
        """
        own = clock == "view" if of_each_view is None else of_each_view
        if self._view and not own and name in self._resources:
            return self._resources[name]
        (made,) = self._declare((_of_view(name, self._view),), None, frozenset([clock]))
        self._sources.append(made)
        return made

    def polled(self, name: str, clock: Clock, ask: Callable[[], Any], same: Same) -> Resource[Any]:
        """Declares a source whose value `ask` returns before every run that needs it."""
        resource = self.source(name, clock, of_each_view=True)
        self._polled.append((resource, ask, same))
        return resource

    def stage(
        self,
        name: str,
        function: Callable[..., Any],
        *inputs: Resource[Any] | str,
        same: Same | None = None,
    ) -> Resource[Any]:
        """Declares a stage that writes one resource, named like the stage.

        Inputs may be named before they are declared. `same` compares the old value with the new one; readers of
        the resource do not rerun if it holds.
        """
        return self._add(name, function, inputs, (name,), same)[0]

    def value(
        self, name: str, function: Callable[..., Any], *inputs: Resource[Any] | str, same: Same | None = None
    ) -> Resource[Any]:
        """Declares a stage that only combines values.

        It runs no kernel and is not timed, and pictures of the graph show it with the stage that it serves.
        """
        resource = self.stage(name, function, *inputs, same=same)
        assert resource.stage is not None
        self._values.add(resource.stage.name)
        return resource

    def section(self, name: str) -> None:
        """Begins a named section, for readers of the graph: it contains all stages declared from here on."""
        self._sections.append((len(self._stages), name))

    @contextmanager
    def of_plugin(self, plugin: Plugin | None) -> Iterator[None]:
        """Context whose stages are a plugin's: when one of them fails, the plugin is named."""
        self._plugin = plugin
        try:
            yield
        finally:
            self._plugin = None

    @contextmanager
    def of_view(self, number: int) -> Iterator[None]:
        """Context whose stages belong to one of several views of one world, counted from 0.

        A stage with the function and the inputs of one of the first view is not declared again: that one runs once
        for all views. Other stages and resources carry the view's number in their names, and an input that is given
        by name is the view's own resource if it has one.
        """
        self._view = number
        try:
            yield
        finally:
            self._view = 0

    def shared(self, name: str, make: Callable[[], T]) -> T:
        """Returns the object that `make` made for the first view, so that all views share its stages."""
        if not self._view:
            self._shared[name] = make()
        made: T = self._shared[name]
        return made

    @contextmanager
    def lagging(self, turns: int, *behind: Resource[Any]) -> Iterator[None]:
        """Context whose stages follow changes of `behind` only in one of `turns` frames (`Lag`)."""
        if turns == 1:
            yield
            return
        self._lag = Lag(frozenset(behind), turns)
        self._lags.append(self._lag)
        try:
            yield
        finally:
            self._lag = None

    @property
    def is_lagging(self) -> bool:
        """Whether a stage lags, so that the next frame may differ from this one although nothing changes."""
        return any(lag.is_waiting for lag in self._lags)

    def stages(
        self,
        name: str,
        function: Callable[..., Any],
        *inputs: Resource[Any] | str,
        outputs: Sequence[str],
        same: Same | None = None,
    ) -> tuple[Resource[Any], ...]:
        """Declares a stage whose function returns one value for each of the `outputs`."""
        return self._add(name, function, inputs, tuple(outputs), same)

    def _add(
        self,
        name: str,
        function: Callable[..., Any],
        inputs: Sequence[Resource[Any] | str],
        outputs: tuple[str, ...],
        same: Same | None,
    ) -> tuple[Resource[Any], ...]:
        known = self._same_stage(name, function, inputs)
        if known is not None:
            return known.outputs
        name, outputs = _of_view(name, self._view), tuple(_of_view(each, self._view) for each in outputs)
        if any(stage.name == name for stage in self._stages):
            raise GraphError(f"There is a stage `{name}` already; give this one another name.")
        if not outputs:
            raise GraphError(f"Stage `{name}` writes no resource, so that nothing would run it.")
        for item in inputs:
            if isinstance(item, Resource) and item is not self._resources.get(item.name):
                raise GraphError(f"Stage `{name}` reads `{item.name}` of another graph.")
        stage = Stage(name, function, (), (), same, self._plugin, self._lag, self._view)
        stage.outputs = self._declare(outputs, stage)
        self._stages.append(stage)
        self._named[stage] = [item if isinstance(item, str) else item.name for item in inputs]
        self._order = None
        self.own(getattr(function, "__self__", None))
        return stage.outputs

    def _same_stage(
        self, name: str, function: Callable[..., Any], inputs: Sequence[Resource[Any] | str]
    ) -> Stage | None:
        """Returns the first view's stage that computes the same; None if this view needs one of its own."""
        if not self._view:
            return None
        named = [
            self._name_in_view(item, self._view) if isinstance(item, str) else item.name for item in inputs
        ]
        found = (stage for stage in self._stages if stage.name == name and not stage.view)
        return next(
            (stage for stage in found if stage.function == function and self._named[stage] == named), None
        )

    def _name_in_view(self, name: str, view: int) -> str:
        """Returns a resource's name, that of the view's own if it has one."""
        own = _of_view(name, view)
        return own if own in self._resources else name

    def _declare(
        self, names: tuple[str, ...], stage: Stage | None, clocks: frozenset[Clock] = frozenset()
    ) -> tuple[Resource[Any], ...]:
        """Declares all of the resources or, if one has a writer already, none."""
        for name in names:
            if name in self._resources or names.count(name) > 1:
                writer = self._resources[name].stage if name in self._resources else stage
                by = " and by ".join(
                    f"stage `{each.name}`" if each else "a source" for each in (writer, stage)
                )
                raise GraphError(f"Resource `{name}` is written by {by}; a resource has one writer.")
        made = tuple(Resource[Any](name, clocks, stage) for name in names)
        self._resources.update(zip(names, made, strict=True))
        self._needed.clear()
        return made

    def own(self, item: object) -> None:
        """Releases `item` with the graph if it has a `release` method."""
        if hasattr(item, "release") and not any(item is other for other in self._owned):
            self._owned.append(item)

    def resource(self, name: str) -> Resource[Any]:
        """Returns the resource of that name.

        Raises:
            GraphError: there is none.
        """
        name = self._name_in_view(name, self._view)
        if name not in self._resources:
            raise GraphError(f"There is no resource `{name}`{self._nearest(name)}.")
        return self._resources[name]

    def _nearest(self, name: str) -> str:
        close = get_close_matches(name, self._resources, 1)
        return f"; the nearest is `{close[0]}`" if close else ""

    def __getitem__(self, name: str) -> Any:  # noqa: ANN401 (as its stage made it)
        """Returns the value of a resource."""
        return self.resource(name).value

    def __contains__(self, name: str) -> bool:
        return name in self._resources

    def run(self, *targets: Resource[Any], until_s: float | None = None) -> bool:
        """Brings the `targets` (all resources if none is named) up to date; returns whether they are.

        No stage is begun after `until_s` (time.monotonic()): the next run goes on from there. What a stage raises is
        raised here; the stage, all that lead to it and those that read them run again the next time.

        Raises:
            GraphError: stages read each other in a circle, read what nobody writes, or write what they did not
                declare.
        """
        self._runs += 1
        if targets not in self._needed:
            self._needed[targets] = self._needed_for(targets or self._resources.values())
        stages, polled = self._needed[targets]
        for resource, ask, same in polled:
            resource.write(ask(), same)
        for stage in stages:
            if until_s is not None and time.monotonic() >= until_s:
                return False
            self._update(stage)
        return True

    def _sorted(self) -> list[Stage]:
        """Returns the stages in topological order; declaration order breaks ties."""
        if self._order is None:
            for stage, names in self._named.items():
                with blamed(stage.plugin):
                    stage.inputs = tuple(self._read(stage, name) for name in names)
            self._order = in_order(self._stages)
            complete_clocks(self._order)
            read = {item for stage in self._order for item in stage.inputs}
            for stage in self._order:
                stage.is_read = not read.isdisjoint(stage.outputs)
        return self._order

    def _read(self, stage: Stage, name: str) -> Resource[Any]:
        name = self._name_in_view(name, stage.view)
        if name not in self._resources:
            raise GraphError(
                f"Stage `{stage.name}` reads `{name}`, which no stage writes{self._nearest(name)}."
            )
        return self._resources[name]

    def _needed_for(self, targets: Iterable[Resource[Any]]) -> tuple[list[Stage], list[_Polled]]:
        """Returns the stages that make the targets, in order, and the polled sources that they depend on."""
        order = self._sorted()
        needed = needed_for(targets)
        stages = [stage for stage in order if not needed.isdisjoint(stage.outputs)]
        return stages, [each for each in self._polled if each[0] in needed]

    def _update(self, stage: Stage) -> None:
        """Runs a stage if the version of any input differs from the one that it saw last."""
        versions = tuple([item.version for item in stage.inputs])
        if versions == stage.input_versions or (
            stage.lag is not None and stage.lag.holds(stage.inputs, stage.input_versions, versions)
        ):
            return
        if 0 in versions:
            name = stage.inputs[versions.index(0)].name
            raise GraphError(f"Stage `{stage.name}` reads `{name}` before it is written.")
        try:
            values = self._call(stage)
        except Exception:
            _forget(stage)
            raise
        for output, value in zip(stage.outputs, values, strict=True):
            output.write(value, stage.same)
        stage.input_versions, stage.ran_in = versions, self._runs

    def _call(self, stage: Stage) -> Sequence[Any]:
        """Runs a stage's function, timed; returns a value for each output."""
        dispatches: list[Dispatch] = []
        try:
            with self._around(stage, dispatches):
                found = stage.call()
                results = (found,) if len(stage.outputs) == 1 else _several(stage, found)
                if stage.plugin is not None:
                    require_kinds(stage, results)
        except Exception as error:
            error.add_note(f"Stage `{stage.name}` raised it.")
            raise
        if dispatches:
            self._require_declared(stage, results, dispatches)
        return results

    def _around(self, stage: Stage, dispatches: list[Dispatch]) -> AbstractContextManager[object]:
        """Returns a context that times a stage, blames its plugin, and lists its `dispatches` if they are checked."""
        timers = None if stage.name in self._values else self.timers
        timed = UNTIMED if timers is None else timers.measure(stage.name)
        if stage.plugin is None and not self._checks:
            return timed
        around = ExitStack()
        if stage.plugin is not None:
            around.enter_context(stage.plugin.blamed(f"stage `{stage.name}`"))
        around.enter_context(timed)
        if self._checks:
            around.enter_context(watched(self.gpu, dispatches.append))
        return around

    def _require_declared(self, stage: Stage, results: Sequence[Any], dispatches: Sequence[Dispatch]) -> None:
        """Raises if a kernel wrote what another stage made, unless this stage returns it."""
        own = {id(item) for value in results for item in gpu_objects(value)}
        written = [
            (run.kernel, name, item)
            for run in dispatches
            for name, item in run.written.items()
            if id(item) not in own
        ]
        if not written:  # to look through all that the others made takes longer than a frame
            return
        for other in self._resources.values():
            if other.stage is stage or other.version == 0:
                continue
            held = {id(item) for item in gpu_objects(other.value)}
            for kernel, name, item in written:
                if id(item) in held:
                    raise GraphError(
                        f"Stage `{stage.name}` writes `{other.name}` (kernel {kernel}, `{name}`), which it did not "
                        "declare."
                    )

    def begin_frame(self) -> None:
        """Begins a frame. Reports describe what ran and changed since then; lagging stages take their turn."""
        for lag in self._lags:
            lag.begin_frame()
        self._first_run = self._runs + 1
        self._begun = {item: item.version for item in self._sources}

    def reused_times_ms(self, ran: Container[str]) -> dict[str, float]:
        """Returns the last times of stages whose results the frame reuses, ms; `ran` names the stages that ran.

        Stages whose results no stage reads are left out: they serve estimates of light.
        """
        last_ms = {} if self.timers is None else self.timers.last_ms
        kept = [stage for stage in self._sorted() if stage.name not in ran and stage.name in last_ms]
        return {
            stage.name: last_ms[stage.name]
            for stage in kept
            if stage.is_read and stage.input_versions is not None
        }

    def invalidate(self) -> None:
        """Makes every stage run again with the next run that needs it."""
        for stage in self._stages:
            stage.input_versions = None

    def report(self) -> list[StageReport]:
        """Every stage in the order in which they run, as the frame left it."""
        times: Mapping[str, float] = {} if self.timers is None else self.timers.last_ms
        sizes = self._sizes()
        return [
            StageReport(
                stage.name,
                tuple(item.name for item in stage.inputs),
                tuple(item.name for item in stage.outputs),
                tuple(clock for clock in CLOCKS if clock in stage.clocks),
                sum(sizes[item] for item in stage.outputs),
                times.get(stage.name),
                0 < (self._first_run or self._runs) <= stage.ran_in,
                self._section_of(stage),
                stage.name in self._values,
                summary(stage.function),
                stage.function.__module__.removeprefix("deltalight.").replace(".", "/") + ".py",
            )
            for stage in self._sorted()
        ]

    def report_sources(self) -> list[SourceReport]:
        """Every source in the order in which they were declared, as the frame left it."""
        sizes = self._sizes()
        return [
            SourceReport(
                item.name, next(iter(item.clocks)), sizes[item], item.version != self._begun.get(item, 0)
            )
            for item in self._sources
        ]

    def _sizes(self) -> dict[Resource[Any], int]:
        """GPU memory of each resource."""
        items = list(self._resources.values())
        sizes = sizes_bytes([item.value if item.version else None for item in items])
        return dict(zip(items, sizes, strict=True))

    def _section_of(self, stage: Stage) -> str:
        index = self._stages.index(stage)
        return next((name for first, name in reversed(self._sections) if first <= index), "")

    def release(self) -> None:
        """Frees everything that the stages own."""
        for item in reversed(self._owned):
            item.release()
        self._owned.clear()


def _several(stage: Stage, found: Any) -> Sequence[Any]:  # noqa: ANN401 (as the stage's function returns)
    """Returns the values of a stage's several outputs.

    Raises:
        GraphError: there are fewer or more.
    """
    count = len(found) if isinstance(found, tuple | list) else 1
    if count != len(stage.outputs):
        names = ", ".join(f"`{item.name}`" for item in stage.outputs)
        raise GraphError(f"Stage `{stage.name}` returned {count} values for {names}.")
    values: Sequence[Any] = found
    return values


def _forget(stage: Stage) -> None:
    """Makes a stage that failed run again, and all that lead to it: it may have changed a part of what they made."""
    for item in needed_for(stage.outputs):
        if item.stage is not None:
            item.stage.input_versions = None


def _of_view(name: str, view: int) -> str:
    """Returns a stage's or resource's name in a view; in the first view it is the plain name."""
    return f"{name} (view {view + 1})" if view else name
