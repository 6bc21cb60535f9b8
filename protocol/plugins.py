"""Plugins: what installed packages bring through entry points (docs/plugins.md)."""

from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from typing import Generic, TypeVar

from deltalight.protocol.errors import DeltalightError

T = TypeVar("T")
OWN_PACKAGE = "deltalight"
LONGEST_REASON = 300  # characters of a sentence


@dataclass(frozen=True)
class Plugin:
    """An entry point of an installed package, or of the project itself; nothing of it runs before it is loaded."""

    entry_point: EntryPoint

    @property
    def name(self) -> str:
        """What the scene document or the configuration calls it."""
        return self.entry_point.name

    @property
    def package(self) -> str:
        """Name and version of the package that brings it."""
        package = self.entry_point.dist
        return OWN_PACKAGE if package is None else f"{package.name} {package.version}"

    def load(self) -> object:
        """What the entry point names.

        Raises:
            DeltalightError: it cannot be imported.
        """
        try:
            return self.entry_point.load()
        except (Exception, SystemExit) as error:  # a plugin's code may raise anything
            raise self.fault(f"{type(error).__name__}: {error}") from error

    @contextmanager
    def blamed(self, doing: str = "") -> Iterator[None]:
        """Turns what a package's code raises into a sentence that names it; sentences stay as they are.

        `doing` says where in the package's code, where that is known.

        Raises:
            DeltalightError: in place of any other exception.
        """
        try:
            yield
        except DeltalightError:
            raise
        except Exception as error:  # as above
            if self.entry_point.dist is None:
                raise
            where = f"{doing}, " if doing else ""
            raise self.fault(f"{where}{type(error).__name__}: {error}") from error

    def fault(self, reason: str) -> DeltalightError:
        """The sentence for people on why the plugin cannot be used."""
        point = self.entry_point
        said = " ".join(reason.split()).rstrip(".")[:LONGEST_REASON]
        return DeltalightError(
            f"The plugin `{point.name}` of package {self.package} (entry point {point.value} in {point.group}) "
            f"cannot be used ({said}); fix or uninstall the package."
        )


def blamed(plugin: Plugin | None) -> AbstractContextManager[None]:
    """`Plugin.blamed` of a plugin, if what runs is one's."""
    return nullcontext() if plugin is None else plugin.blamed()


@dataclass(frozen=True)
class LoadedPlugins(Generic[T]):
    """The plugins of a group: what is used of each by its name, and a sentence on each that cannot be used."""

    values: dict[str, T]
    faults: dict[Plugin, str]

    def fault(self, name: str) -> str | None:
        """Why the plugin of that name cannot be used, if there is one that cannot."""
        return next((said for plugin, said in self.faults.items() if plugin.name == name), None)


def installed_plugins(group: str) -> list[Plugin]:
    """The plugins of an entry point group, none of them loaded."""
    return [Plugin(point) for point in entry_points(group=group)]


def load_plugins(
    plugins: Iterable[Plugin], accept: Callable[[Plugin, object], T], reserved: Iterable[str] = ()
) -> LoadedPlugins[T]:
    """Loads plugins; one that cannot be used leaves the others alone.

    Args:
        plugins: what to load; of two with one name the first is used.
        accept: makes what an entry point names into what is used of it, or raises.
        reserved: names that no plugin may take.
    """
    taken = set(reserved)
    values: dict[str, T] = {}
    faults: dict[Plugin, str] = {}
    for plugin in plugins:
        try:
            if plugin.name in taken:
                raise plugin.fault("there is another one of that name")
            found = plugin.load()
            with plugin.blamed():
                values[plugin.name] = accept(plugin, found)
            taken.add(plugin.name)
        except DeltalightError as fault:
            faults[plugin] = str(fault)
    return LoadedPlugins(values, faults)
