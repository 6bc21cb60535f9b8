"""The frame as a graph: stages that read and write versioned resources and rerun only when an input changed.

A method declares its stages once; every frame sets the sources and runs the graph. Each resource inherits the
clocks of all that it is computed from, so the graph shows what a moving camera costs before anything is
drawn.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from difflib import get_close_matches
from typing import Any, Final, Generic, Literal, TypeVar, get_args

from render_server.gpu.context import GpuContext
from render_server.gpu.kernel import Dispatch
from render_server.gpu.memory import gpu_objects, size_bytes
from render_server.gpu.timers import PassTimers

Clock = Literal["scene", "lights", "world", "objects", "view"]
CLOCKS: Final[tuple[Clock, ...]] = get_args(Clock)
T = TypeVar("T")
Same = Callable[[Any, Any], bool]


class GraphError(RuntimeError):
    """Stages and resources do not fit together."""


@dataclass(eq=False)
class Resource(Generic[T]):
    """A named texture, buffer or plain value with a version that counts its changes (0: never written).

    `clocks` make it change: its source's own, or those of everything that its stage reads.
    """

    name: str
    clocks: frozenset[Clock]
    stage: "Stage | None" = None
    version: int = 0
    _value: T | None = field(default=None, repr=False)

    @property
    def value(self) -> T:
        """The last value written.

        Raises:
            GraphError: nothing was written yet.
        """
        if self.version == 0:
            raise GraphError(f"Resource `{self.name}` is read before it is written.")
        return self._value  # type: ignore[return-value]

    def write(self, value: T, same: Same | None = None) -> None:
        """Replaces the value; the version stays if `same` finds the new value equal to the old one."""
        if self.version == 0 or same is None or not same(self._value, value):
            self.version += 1
        self._value = value


@dataclass(eq=False)
class Stage:
    """A function of resources. `ran`: whether the last run of the graph called it."""

    name: str
    function: Callable[..., Any]
    inputs: tuple[Resource[Any], ...]
    outputs: tuple[Resource[Any], ...]
    same: Same | None
    seen: tuple[int, ...] | None = None
    ran: bool = False

    @property
    def clocks(self) -> frozenset[Clock]:
        """The clocks that make it run."""
        return self.outputs[0].clocks


@dataclass(frozen=True)
class StageReport:
    """The state of one stage after the last run; `size_bytes` is the GPU memory of its outputs."""

    name: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    clocks: tuple[Clock, ...]
    size_bytes: int
    time_ms: float | None
    ran: bool


class Graph:
    """Stages in execution order, and the resources between them.

    The graph owns the objects whose methods are its stages, and releases them with itself. With `checks` it
    verifies after every kernel that the running stage may write what the kernel wrote (slow; for tests).
    """

    def __init__(self, gpu: GpuContext, timers: PassTimers | None = None, *, checks: bool = False) -> None:
        self.gpu = gpu
        self.timers = timers
        self._checks = checks
        self._resources: dict[str, Resource[Any]] = {}
        self._stages: list[Stage] = []
        self._named: dict[Stage, list[str]] = {}
        self._order: list[Stage] | None = None
        self._polled: list[tuple[Resource[Any], Callable[[], Any], Same]] = []
        self._owned: list[Any] = []
        self._running: Stage | None = None

    def source(self, name: str, clock: Clock) -> Resource[Any]:
        """Declares a resource that is set from outside (`Resource.write`)."""
        return self._declare(name, frozenset([clock]), None)

    def polled(self, name: str, clock: Clock, ask: Callable[[], Any], same: Same) -> Resource[Any]:
        """Declares a source whose value is requested before every run."""
        resource = self._declare(name, frozenset([clock]), None)
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

    def stages(
        self, name: str, function: Callable[..., Any], *inputs: Resource[Any] | str, outputs: Sequence[str]
    ) -> tuple[Resource[Any], ...]:
        """Declares a stage whose function returns one value for each of the `outputs`."""
        return self._add(name, function, inputs, tuple(outputs), None)

    def _add(
        self,
        name: str,
        function: Callable[..., Any],
        inputs: Sequence[Resource[Any] | str],
        outputs: tuple[str, ...],
        same: Same | None,
    ) -> tuple[Resource[Any], ...]:
        if any(stage.name == name for stage in self._stages):
            raise GraphError(f"There is a stage `{name}` already; give this one another name.")
        names = [item if isinstance(item, str) else item.name for item in inputs]
        known = [self._resources[item] for item in names if item in self._resources]
        clocks = frozenset(clock for item in known for clock in item.clocks)
        stage = Stage(name, function, (), (), same)
        stage.outputs = tuple(self._declare(output, clocks, stage) for output in outputs)
        self._stages.append(stage)
        self._named[stage] = names
        self._order = None
        self.own(getattr(function, "__self__", None))
        return stage.outputs

    def _declare(self, name: str, clocks: frozenset[Clock], stage: Stage | None) -> Resource[Any]:
        if name in self._resources:
            writer = self._resources[name].stage
            by = f"stage `{writer.name}`" if writer else "a source"
            raise GraphError(f"Resource `{name}` is written by {by} already; a resource has one writer.")
        self._resources[name] = Resource(name, clocks, stage)
        return self._resources[name]

    def own(self, item: object) -> None:
        """Releases `item` with the graph if it has a `release` method."""
        if hasattr(item, "release") and not any(item is other for other in self._owned):
            self._owned.append(item)

    def resource(self, name: str) -> Resource[Any]:
        """Returns the resource of that name.

        Raises:
            GraphError: there is none.
        """
        if name not in self._resources:
            close = get_close_matches(name, self._resources, 1)
            hint = f"; the nearest is `{close[0]}`" if close else ""
            raise GraphError(f"There is no resource `{name}`{hint}.")
        return self._resources[name]

    def __getitem__(self, name: str) -> Any:  # noqa: ANN401 (as its stage made it)
        """Returns the value of a resource."""
        return self.resource(name).value

    def __contains__(self, name: str) -> bool:
        return name in self._resources

    def run(self, *targets: Resource[Any]) -> None:
        """Brings the `targets` (by default all resources) up to date.

        Raises:
            GraphError: stages depend on each other in a cycle, read a resource that nothing writes, or write
                one that they did not declare.
        """
        for resource, ask, same in self._polled:
            resource.write(ask(), same)
        wanted = self._needed_for(targets) if targets else None
        for stage in self._sorted():
            stage.ran = False
            if wanted is None or stage in wanted:
                self._update(stage)

    def _sorted(self) -> list[Stage]:
        """Returns the stages in topological order; declaration order breaks ties."""
        if self._order is None:
            for stage, names in self._named.items():
                stage.inputs = tuple(self._read(stage, name) for name in names)
            self._order = []
            for stage in self._stages:
                self._place(stage, [])
            self._complete_clocks()
        return self._order

    def _place(self, stage: Stage, waiting: list[Stage]) -> None:
        """Appends a stage to the order, after everything that it reads."""
        assert self._order is not None
        if stage in self._order:
            return
        if stage in waiting:
            circle = [*waiting[waiting.index(stage) :], stage]
            names = " reads ".join(f"`{each.name}`" for each in circle)
            shared = circle[1].outputs[0].name
            self._order = None
            raise GraphError(f"Stages read each other in a circle, through `{shared}` first: {names}.")
        for item in stage.inputs:
            if item.stage is not None:
                self._place(item.stage, [*waiting, stage])
                assert self._order is not None
        self._order.append(stage)

    def _read(self, stage: Stage, name: str) -> Resource[Any]:
        if name not in self._resources:
            close = get_close_matches(name, self._resources, 1)
            hint = f"; the nearest is `{close[0]}`" if close else ""
            raise GraphError(f"Stage `{stage.name}` reads `{name}`, which no stage writes{hint}.")
        return self._resources[name]

    def _complete_clocks(self) -> None:
        """Completes the clocks of resources that were named before their declaration."""
        assert self._order is not None
        for stage in self._order:
            clocks = frozenset(clock for item in stage.inputs for clock in item.clocks)
            for output in stage.outputs:
                output.clocks = clocks

    def _needed_for(self, targets: Sequence[Resource[Any]]) -> set[Stage]:
        self._sorted()
        needed: set[Stage] = set()
        open_ = [item.stage for item in targets if item.stage is not None]
        while open_:
            stage = open_.pop()
            if stage not in needed:
                needed.add(stage)
                open_ += [item.stage for item in stage.inputs if item.stage is not None]
        return needed

    def _update(self, stage: Stage) -> None:
        """Runs a stage if the version of any input differs from the one that it saw last."""
        versions = tuple(item.version for item in stage.inputs)
        if versions == stage.seen:
            return
        for item in stage.inputs:
            if item.version == 0:
                raise GraphError(f"Stage `{stage.name}` reads `{item.name}` before it is written.")
        with self._measured(stage):
            found = stage.function(*(item.value for item in stage.inputs))
        results = found if len(stage.outputs) > 1 else (found,)
        if len(results) != len(stage.outputs):
            raise GraphError(
                f"Stage `{stage.name}` returned {len(results)} values for {len(stage.outputs)} outputs."
            )
        for output, value in zip(stage.outputs, results, strict=True):
            output.write(value, stage.same)
        stage.seen, stage.ran = versions, True

    @contextmanager
    def _measured(self, stage: Stage) -> Iterator[None]:
        """Times a stage and, with `checks`, watches what it writes."""
        timer = self.timers.measure(stage.name) if self.timers is not None else nullcontext()
        self._running = stage
        if self._checks:
            self.gpu.watchers.append(self._check)
        try:
            with timer:
                yield
        finally:
            self._running = None
            if self._checks:
                self.gpu.watchers.remove(self._check)

    def _check(self, dispatch: Dispatch) -> None:
        """Raises if a kernel of the running stage writes a resource of another stage."""
        stage = self._running
        assert stage is not None
        own = {id(item) for output in stage.outputs if output.version for item in gpu_objects(output.value)}
        for other in self._resources.values():
            if other.stage in (stage, None) or other.version == 0:
                continue
            held = {id(item) for item in gpu_objects(other.value)} - own
            for name, item in dispatch.written.items():
                if id(item) in held:
                    raise GraphError(
                        f"Stage `{stage.name}` writes `{other.name}` (kernel {dispatch.kernel}, `{name}`), "
                        "which it did not declare."
                    )

    def report(self) -> list[StageReport]:
        """Reports on every stage in execution order, as of the last run."""
        times: Mapping[str, float] = {} if self.timers is None else self.timers.times_ms
        return [
            StageReport(
                stage.name,
                tuple(item.name for item in stage.inputs),
                tuple(item.name for item in stage.outputs),
                tuple(clock for clock in CLOCKS if clock in stage.clocks),
                sum(size_bytes(item.value) for item in stage.outputs if item.version),
                times.get(stage.name),
                stage.ran,
            )
            for stage in self._sorted()
        ]

    def release(self) -> None:
        """Frees everything that the stages own."""
        for item in reversed(self._owned):
            item.release()
        self._owned.clear()
