"""The frame as a graph: stages that read and write versioned resources and rerun only where an input changed.

A method declares its stages once; every frame sets the sources and runs the graph. Each resource follows the clocks
of all that it was made from, so that what a moving camera costs can be read from the graph before anything is drawn.
"""

import inspect
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from difflib import get_close_matches
from typing import Any, Final, Generic, Literal, TypeVar, get_args

from render_server.gpu.context import GpuContext
from render_server.gpu.kernel import Dispatch
from render_server.gpu.memory import gpu_objects, sizes_bytes
from render_server.gpu.timers import PassTimers

Clock = Literal["scene", "lights", "world", "objects", "view"]
CLOCKS: Final[tuple[Clock, ...]] = get_args(Clock)
T = TypeVar("T")
Same = Callable[[Any, Any], bool]


class GraphError(RuntimeError):
    """Stages and resources that do not fit together."""


@dataclass(eq=False)
class Resource(Generic[T]):
    """A named texture, buffer or plain value, and a number that counts its changes; 0: never written.

    `clocks` are what makes it change: those of its source, or of everything that its stage reads.
    """

    name: str
    clocks: frozenset[Clock]
    stage: "Stage | None" = None
    version: int = 0
    _value: T | None = field(default=None, repr=False)

    @property
    def value(self) -> T:
        """What was written last.

        Raises:
            GraphError: nothing was.
        """
        if self.version == 0:
            raise GraphError(f"Resource `{self.name}` is read before it is written.")
        return self._value  # type: ignore[return-value]

    def write(self, value: T, same: Same | None = None) -> None:
        """Replaces the value; the version stays where `same` says that it is what it was."""
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
        """What makes it run."""
        return self.outputs[0].clocks


@dataclass(frozen=True)
class SourceReport:
    """One source as the frame left it. `changed`: whether it did in this frame."""

    name: str
    clock: Clock
    size_bytes: int
    changed: bool


@dataclass(frozen=True)
class StageReport:
    """One stage as the frame left it.

    `size_bytes` is the GPU memory of what it writes, as far as no other stage or source has it by itself; `time_ms`
    what it took when it last ran. `is_value`: it only puts values together. `summary` and `file` tell what its
    function does, and where it stands.
    """

    name: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    clocks: tuple[Clock, ...]
    size_bytes: int
    time_ms: float | None
    ran: bool
    section: str
    is_value: bool
    summary: str
    file: str


class Graph:
    """Stages in the order in which they run, and the resources between them.

    The graph owns what its stages are methods of: it releases them with itself. `checks` tells after every kernel
    whether the running stage may write what the kernel wrote (slow; for tests).
    """

    def __init__(self, gpu: GpuContext, timers: PassTimers | None = None, *, checks: bool = False) -> None:
        self.gpu = gpu
        self.timers = timers
        self._checks = checks
        self._sections: list[tuple[int, str]] = []
        self._values: set[str] = set()
        self._begun: tuple[dict[Stage, object], dict[Resource[Any], int]] = {}, {}
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
        """Declares a source that is asked for before every run."""
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
        """Declares a stage that writes one resource of its own name; inputs may be named before they are declared.

        `same` compares an old with a new value; where it holds, what reads the resource does not run again.
        """
        return self._add(name, function, inputs, (name,), same)[0]

    def value(
        self, name: str, function: Callable[..., Any], *inputs: Resource[Any] | str, same: Same | None = None
    ) -> Resource[Any]:
        """Declares a stage that only puts values together: it runs no kernel, and pictures of the graph show it with
        the stage that it serves.
        """
        self._values.add(name)
        return self.stage(name, function, *inputs, same=same)

    def section(self, name: str) -> None:
        """Begins a section of the frame, for who reads the graph: what is declared from here on belongs to it."""
        self._sections.append((len(self._stages), name))

    def stages(
        self,
        name: str,
        function: Callable[..., Any],
        *inputs: Resource[Any] | str,
        outputs: Sequence[str],
        same: Same | None = None,
    ) -> tuple[Resource[Any], ...]:
        """Declares a stage whose function returns a value for each of the `outputs`."""
        return self._add(name, function, inputs, tuple(outputs), same)

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
        """Releases `item` with the graph, if it can be released."""
        if hasattr(item, "release") and not any(item is other for other in self._owned):
            self._owned.append(item)

    def resource(self, name: str) -> Resource[Any]:
        """The resource of that name.

        Raises:
            GraphError: there is none.
        """
        if name not in self._resources:
            close = get_close_matches(name, self._resources, 1)
            hint = f"; the nearest is `{close[0]}`" if close else ""
            raise GraphError(f"There is no resource `{name}`{hint}.")
        return self._resources[name]

    def __getitem__(self, name: str) -> Any:  # noqa: ANN401 (as its stage made it)
        """Value of a resource."""
        return self.resource(name).value

    def __contains__(self, name: str) -> bool:
        return name in self._resources

    def run(self, *targets: Resource[Any]) -> None:
        """Brings the `targets` (all resources if none is named) up to date.

        Raises:
            GraphError: stages read each other in a circle, read what nobody writes, or write what they did not
                declare.
        """
        for resource, ask, same in self._polled:
            resource.write(ask(), same)
        wanted = self._needed_for(targets) if targets else None
        for stage in self._sorted():
            stage.ran = False
            if wanted is None or stage in wanted:
                self._update(stage)

    def _sorted(self) -> list[Stage]:
        """Stages in an order in which each comes after what it reads; by declaration where that leaves a choice."""
        if self._order is None:
            for stage, names in self._named.items():
                stage.inputs = tuple(self._read(stage, name) for name in names)
            self._order = []
            for stage in self._stages:
                self._place(stage, [])
            self._follow_clocks()
        return self._order

    def _place(self, stage: Stage, waiting: list[Stage]) -> None:
        """Puts a stage into the order, behind all that it reads."""
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

    def _follow_clocks(self) -> None:
        """Clocks of what was named before it was declared."""
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
        """Runs a stage if a version of its inputs is not the one that it saw."""
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
        """Refuses that a kernel of the running stage writes what belongs to another one."""
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

    def begin_frame(self) -> None:
        """Begins a frame: reports tell what ran and changed since."""
        seen = {stage: stage.seen for stage in self._stages}
        self._begun = dict(seen), {item: item.version for item in self._resources.values()}

    def invalidate(self) -> None:
        """Makes every stage run again with the next run that needs it."""
        for stage in self._stages:
            stage.seen = None

    def report(self) -> list[StageReport]:
        """Every stage in the order in which they run, as the frame left it."""
        times: Mapping[str, float] = {} if self.timers is None else self.timers.last_ms
        sizes, (seen, _) = self._sizes(), self._begun
        return [
            StageReport(
                stage.name,
                tuple(item.name for item in stage.inputs),
                tuple(item.name for item in stage.outputs),
                tuple(clock for clock in CLOCKS if clock in stage.clocks),
                sum(sizes[item] for item in stage.outputs),
                times.get(stage.name),
                stage.ran or stage.seen is not seen.get(stage, stage.seen),
                self._section_of(stage),
                stage.name in self._values,
                _summary(stage.function),
                stage.function.__module__.replace(".", "/") + ".py",
            )
            for stage in self._sorted()
        ]

    def report_sources(self) -> list[SourceReport]:
        """Every source in the order in which they were declared, as the frame left it."""
        sizes, (_, versions) = self._sizes(), self._begun
        return [
            SourceReport(
                item.name, next(iter(item.clocks)), sizes[item], item.version != versions.get(item, 0)
            )
            for item in self._resources.values()
            if item.stage is None
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
        """Frees everything that the stages hold."""
        for item in reversed(self._owned):
            item.release()
        self._owned.clear()


def _summary(function: Callable[..., Any]) -> str:
    """First sentence of a function's documentation, without its full stop."""
    text = " ".join((inspect.getdoc(function) or "").split("\n\n")[0].split())
    return text.split(". ")[0].rstrip(".")
