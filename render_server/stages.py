"""Resources and stages of a frame graph, and the order in which stages run."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

from deltalight.protocol.array_checks import kind_of
from deltalight.protocol.plugins import Plugin
from deltalight.render_server.graph_report import Clock
from deltalight.render_server.lag import Lag

T = TypeVar("T")
Same = Callable[[Any, Any], bool]


class GraphError(RuntimeError):
    """Stages and resources do not fit together."""


@dataclass(eq=False, slots=True)
class Resource(Generic[T]):
    """A named texture, buffer or plain value, and its `version`, which counts its changes; 0: never written.

    `clocks` are what makes it change: its own if it is a source, else those of all that its stage reads (known once
    the graph has run or reported). `kind` is the type that a plugin's stage must return for it (as `isinstance`
    takes it), if it is checked.
    """

    name: str
    clocks: frozenset[Clock]
    stage: "Stage | None" = None
    version: int = 0
    kind: Any = None
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


@dataclass(eq=False, slots=True)
class Stage:
    """A function of resources.

    Attributes:
        same: compares an output's old and new value; if it holds, readers do not rerun.
        plugin: the plugin that declared the stage, if any.
        lag: decides in which frames it may wait, if any.
        view: number of the view that declared it.
        input_versions: versions of the inputs when it last ran; None: it never ran, or must run again.
        ran_in: number of the graph's run in which it last ran.
        is_read: whether a stage reads what it writes (known once the graph has run).
    """

    name: str
    function: Callable[..., Any]
    inputs: tuple[Resource[Any], ...]
    outputs: tuple[Resource[Any], ...]
    same: Same | None
    plugin: Plugin | None = None
    lag: Lag | None = None
    view: int = 0
    input_versions: tuple[int, ...] | None = None
    ran_in: int = 0
    is_read: bool = False

    @property
    def clocks(self) -> frozenset[Clock]:
        """The clocks that make it run."""
        return self.outputs[0].clocks

    def call(self) -> Any:  # noqa: ANN401 (as its function returns)
        """Calls the function with the values of the inputs, which have all been written."""
        return self.function(*[item._value for item in self.inputs])


def require_kinds(stage: Stage, values: Sequence[Any]) -> None:
    """Checks what a plugin's stage returned for its outputs, before a stage of others fails with it.

    Raises:
        TypeError: a value is of another type than its resource must be.
    """
    for output, value in zip(stage.outputs, values, strict=True):
        if output.kind is not None and not isinstance(value, output.kind):
            wanted = getattr(output.kind, "__name__", output.kind)
            raise TypeError(f"it returned {kind_of(value)} for `{output.name}`, which must be `{wanted}`")


def in_order(stages: Iterable[Stage]) -> list[Stage]:
    """Returns stages in topological order; the given order breaks ties.

    Raises:
        GraphError: stages read each other in a circle.
    """
    order: list[Stage] = []
    for stage in stages:
        _place(stage, order, [])
    return order


def _place(stage: Stage, order: list[Stage], waiting: list[Stage]) -> None:
    """Appends a stage to the order, after everything that it reads."""
    if stage in order:
        return
    if stage in waiting:
        raise GraphError(f"Stages read each other in a circle: {_links(waiting[waiting.index(stage) :])}.")
    for item in stage.inputs:
        if item.stage is not None:
            _place(item.stage, order, [*waiting, stage])
    order.append(stage)


def _links(cycle: Sequence[Stage]) -> str:
    """Returns which resource each stage of a cycle reads from the next one."""
    links = []
    for stage, writer in zip(cycle, [*cycle[1:], cycle[0]], strict=True):
        item = next(item for item in stage.inputs if item.stage is writer)
        links.append(f"`{stage.name}` reads `{item.name}` of `{writer.name}`")
    return ", ".join(links)


def complete_clocks(order: Sequence[Stage]) -> None:
    """Passes clocks on along the stages, which are in order: outputs follow the clocks of all inputs."""
    for stage in order:
        clocks = frozenset(clock for item in stage.inputs for clock in item.clocks)
        for output in stage.outputs:
            output.clocks = clocks


def needed_for(targets: Iterable[Resource[Any]]) -> set[Resource[Any]]:
    """Returns the targets and all resources that they depend on."""
    needed: set[Resource[Any]] = set()
    open_ = list(targets)
    while open_:
        item = open_.pop()
        if item not in needed:
            needed.add(item)
            open_ += () if item.stage is None else item.stage.inputs
    return needed
