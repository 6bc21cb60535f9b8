"""The relighting methods that a scene document may name: the project's own and those of installed plugins."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import reduce
from operator import or_
from typing import TYPE_CHECKING, Annotated, Any, get_args

from pydantic import BeforeValidator, Discriminator, Tag

from deltalight.protocol.plugins import LoadedPlugins, Plugin, installed_plugins, load_plugins
from deltalight.protocol.scene_method import BUILT_IN_METHODS, DEFAULT_METHOD, MethodSettings

GROUP = "deltalight.methods"


@dataclass(frozen=True)
class InstalledMethod:
    """A method of a plugin.

    `value` is what its entry point names: a `RelightingMethod` of the renderer, of which only `settings` is known.
    Processes that have no OpenGL load it too, to check documents.
    """

    plugin: Plugin
    settings: type[MethodSettings]
    value: object


def _accept(plugin: Plugin, value: object) -> InstalledMethod:
    settings = getattr(value, "settings", None)
    if not (isinstance(settings, type) and issubclass(settings, MethodSettings)):
        raise plugin.fault("it names no RelightingMethod whose settings are a MethodSettings")
    if settings.method_name() != plugin.name:
        raise plugin.fault(f"its settings are called `{settings.method_name()}`; both names must be the same")
    return InstalledMethod(plugin, settings, value)


def load_methods() -> LoadedPlugins[InstalledMethod]:
    """Loads the plugins of the group."""
    return load_plugins(
        installed_plugins(GROUP), _accept, [model.method_name() for model in BUILT_IN_METHODS]
    )


PLUGINS = load_methods()
SETTINGS = {
    model.method_name(): model
    for model in (*BUILT_IN_METHODS, *(method.settings for method in PLUGINS.values.values()))
}


def _name(value: Any) -> Any:  # noqa: ANN401 - whatever the document holds
    if isinstance(value, Mapping):
        return value.get("name", DEFAULT_METHOD)
    return getattr(value, "name", DEFAULT_METHOD)


def _refuse_faulty(value: Any) -> Any:  # noqa: ANN401 - as above
    name = _name(value)
    if isinstance(name, str) and name not in SETTINGS:
        fault = PLUGINS.fault(name) or _short_name_fault(name)
        if fault is not None:
            raise ValueError(fault)
    return value


def _short_name_fault(name: str) -> str | None:
    """Says how a scene document writes what command lines call by a short name; None if `name` is none of those."""
    for model in BUILT_IN_METHODS:
        method, field = model.method_name(), model.model_fields.get("operator")
        for operator in () if field is None else get_args(field.annotation):
            if name in (operator, f"{method}-{operator}"):
                written = f"{{name: {method}, operator: {operator}}}"
                return f"`{name}` is a short name for command lines; here write {written}"
    return None


if TYPE_CHECKING:
    Method = MethodSettings
else:
    Method = Annotated[
        reduce(or_, (Annotated[model, Tag(name)] for name, model in SETTINGS.items())),
        Discriminator(_name),
        BeforeValidator(_refuse_faulty),
    ]
