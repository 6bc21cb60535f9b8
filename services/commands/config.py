"""`deltalight config`: the resolved settings and their origins."""

import json
from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any

import typer

from deltalight.services.commands.options import ConfigFile

if TYPE_CHECKING:
    from pydantic import BaseModel


def config(
    config_file: ConfigFile = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print the values and where they come from as JSON.")
    ] = False,
) -> None:
    """Print the settings of node, server, API and keys as a configuration file, and where each comes from."""
    from deltalight.services.settings import load_configuration

    configuration = load_configuration(config_file)
    values: dict[str, Any] = {}
    origins: dict[str, str] = {}
    for name, model in _models().items():
        settings, places = configuration.explained(name, model)
        values[name] = settings.model_dump(mode="json")
        origins.update({f"{name}.{key}": place for key, place in places.items()})
    if as_json:
        typer.echo(json.dumps({"values": values, "origins": origins}, indent=2))
    else:
        for name, section in values.items():
            _print_table(name, section, origins)


def _models() -> "dict[str, type[BaseModel]]":
    """Returns the sections whose programs are installed here."""
    from deltalight.protocol.keys import KeySettings
    from deltalight.sensor_node.node import NodeConfig

    models: dict[str, type[BaseModel]] = {"node": NodeConfig, "keys": KeySettings}
    try:
        from deltalight.render_server.server.process import ServerSettings
        from deltalight.services.api.settings import ApiSettings
    except ModuleNotFoundError:  # a host that only captures
        return models
    return {"node": NodeConfig, "server": ServerSettings, "api": ApiSettings, "keys": KeySettings}


def _print_table(name: str, values: Mapping[str, Any], origins: Mapping[str, str]) -> None:
    typer.echo(f"[{name}]")
    tables = {key: value for key, value in values.items() if isinstance(value, dict) and value}
    for key in [key for key in values if key not in tables]:
        text = "" if values[key] is None else f"{key} = {_toml(values[key])}"
        typer.echo(f"{text or f'# {key} is not set':<44} # {origins[f'{name}.{key}']}")
    typer.echo()
    for key, table in tables.items():
        _print_table(f"{name}.{key}", table, origins)


def _toml(value: object) -> str:
    """Formats a value as TOML: JSON's strings, numbers and lists are valid TOML."""
    if isinstance(value, dict):
        return (
            "{" + ", ".join(f"{key} = {_toml(each)}" for key, each in value.items() if each is not None) + "}"
        )
    if isinstance(value, list):
        return "[" + ", ".join(_toml(each) for each in value if each is not None) + "]"
    return json.dumps(value, ensure_ascii=False)
