"""Settings of processes: the configuration file `deltalight.toml`, the environment, the command line.

Later ones override earlier ones: defaults of the program, the file, environment variables `DELTALIGHT_SECTION__KEY`,
options.
"""

import tomllib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, Field, create_model
from pydantic_settings import BaseSettings, EnvSettingsSource, SettingsConfigDict, SettingsError

from deltalight.protocol.documents import StrictModel, validate
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.keys import config_home
from deltalight.services.ports import COMPOSITE_PORT, CONTROL_PORT, NODE_PORT, endpoint

FILE_NAME = "deltalight.toml"
ENV_PREFIX, ENV_DELIMITER = "DELTALIGHT_", "__"
DEFAULT, COMMAND_LINE = "default", "command line"
# Defaults of the commands that differ from, or are missing in, those of the models.
COMMAND_DEFAULTS: dict[str, dict[str, Any]] = {
    "node": {"loop": False},
    "server": {
        "subscribe": [endpoint(NODE_PORT)],
        "publish": endpoint(COMPOSITE_PORT),
        "control": endpoint(CONTROL_PORT),
    },
    "api": {},
    "keys": {},
}

Values = dict[str, Any]
Model = TypeVar("Model", bound=BaseModel)


class _File(StrictModel):
    """Sections of the configuration file."""

    node: dict[str, Any] = Field(default_factory=dict)
    server: dict[str, Any] = Field(default_factory=dict)
    api: dict[str, Any] = Field(default_factory=dict)
    keys: dict[str, Any] = Field(default_factory=dict)


class _Environment(BaseSettings):
    """Naming of variables; the section is added as a field."""

    model_config = SettingsConfigDict(
        env_prefix=ENV_PREFIX, env_nested_delimiter=ENV_DELIMITER, env_parse_none_str="null"
    )


@dataclass(frozen=True)
class _Layer:
    """Values of one origin; `origin` names it for the key at a path."""

    values: Values
    origin: Callable[[tuple[str, ...]], str]
    name: str


@dataclass(frozen=True)
class Configuration:
    """Contents of the configuration file (`path`, None if there is none) and of the environment."""

    path: Path | None
    sections: Mapping[str, Values]

    def section(self, name: str, model: type[Model], given: Mapping[str, Any] | None = None) -> Model:
        """Returns the validated settings of a section; `given` are those of the command line.

        Raises:
            DeltalightError: a key is unknown (the nearest is named), or a value is wrong; names the origin.
        """
        return self._merged(name, model, given or {})[0]

    def explained(self, name: str, model: type[Model]) -> tuple[Model, dict[str, str]]:
        """Returns the settings of a section, and the origin of the value of each key (`depth.fill`).

        Raises:
            DeltalightError: as `section`.
        """
        settings, layers = self._merged(name, model, {})
        paths = list(_leaves(settings.model_dump(mode="json")))
        return settings, {".".join(path): _origin(path, layers) for path in paths}

    def _merged(self, name: str, model: type[Model], given: Mapping[str, Any]) -> tuple[Model, list[_Layer]]:
        layers = [
            _Layer(COMMAND_DEFAULTS[name], lambda _: DEFAULT, DEFAULT),
            _Layer(self.sections[name], lambda _: str(self.path), f"{self.path} [{name}]"),
            _Layer(_from_environment(name, model), lambda path: _variable(name, path), "environment"),
            _Layer(dict(given), lambda _: COMMAND_LINE, COMMAND_LINE),
        ]
        merged: Values = {}
        for layer in layers:
            merged = _deep_merge(merged, layer.values)
        try:
            return validate(model, merged, name), layers
        except DeltalightError:
            _blame(model, layers)
            raise


def _blame(model: type[BaseModel], layers: list[_Layer]) -> None:
    """Attributes a fault to the layer that caused it: the first with which the settings are wrong.

    Raises:
        DeltalightError: always, if the layers together are wrong.
    """
    merged: Values = {}
    for layer in layers:
        merged = _deep_merge(merged, layer.values)
        validate(model, merged, layer.name)


def load_configuration(path: Path | None = None) -> Configuration:
    """Reads the configuration file: `path`, else ./deltalight.toml, else the user's.

    Raises:
        DeltalightError: the named file is missing, or a file is not TOML or has an unknown section.
    """
    found = path or next((each for each in _places() if each.is_file()), None)
    if found is None:
        return Configuration(None, _File().model_dump())
    try:
        data = tomllib.loads(found.read_text(encoding="utf-8"))
    except OSError as error:
        raise DeltalightError(
            f"{found} cannot be read ({error.strerror}); give a file that exists."
        ) from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise DeltalightError(f"{found} is not valid TOML ({error}); correct it there.") from error
    return Configuration(found, validate(_File, data, str(found)).model_dump())


def _places() -> tuple[Path, Path]:
    return Path(FILE_NAME), config_home() / FILE_NAME


def _from_environment(name: str, model: type[BaseModel]) -> Values:
    source = create_model("Section", __base__=_Environment, **{name: (model, ...)})  # type: ignore[call-overload]
    try:
        return dict(EnvSettingsSource(source)().get(name, {}))
    except (SettingsError, ValueError, TypeError) as error:
        raise DeltalightError(
            f"environment: a variable {ENV_PREFIX}{name.upper()}... cannot be read ({error}); lists and tables are"
            " written as JSON."
        ) from error


def _variable(name: str, path: tuple[str, ...]) -> str:
    return ENV_PREFIX + ENV_DELIMITER.join((name, *path)).upper()


def _deep_merge(below: Values, above: Mapping[str, Any]) -> Values:
    merged = dict(below)
    for key, value in above.items():
        old = merged.get(key)
        merged[key] = _deep_merge(old, value) if isinstance(old, dict) and isinstance(value, dict) else value
    return merged


def _leaves(values: Mapping[str, Any], path: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    for key, value in values.items():
        if isinstance(value, dict) and value:
            yield from _leaves(value, (*path, key))
        else:
            yield (*path, key)


def _origin(path: tuple[str, ...], layers: list[_Layer]) -> str:
    for layer in reversed(layers):
        here: Any = layer.values
        for depth, key in enumerate(path):
            if not isinstance(here, Mapping):
                return layer.origin(path[:depth])
            if key not in here:
                break
            here = here[key]
        else:
            return layer.origin(path)
    return DEFAULT
