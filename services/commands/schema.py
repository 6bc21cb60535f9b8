"""`deltalight schema`: JSON Schemas for editors and programs."""

import json
from enum import StrEnum
from typing import Annotated, Any

import typer


class Document(StrEnum):
    """What has a schema."""

    SCENE = "scene"
    NODE = "node"
    SERVER = "server"
    API = "api"


def schema(
    document: Annotated[
        Document, typer.Argument(help="The scene document, or the settings of a process.")
    ] = Document.SCENE,
) -> None:
    """Print the JSON Schema of the scene document or of a process's settings."""
    typer.echo(json.dumps(_schema(document), indent=2))


def _schema(document: Document) -> dict[str, Any]:
    match document:
        case Document.SCENE:
            from deltalight.protocol.scene import scene_json_schema

            return scene_json_schema()
        case Document.NODE:
            from deltalight.sensor_node.node import NodeConfig

            return NodeConfig.model_json_schema()
        case Document.SERVER:
            from deltalight.render_server.server.process import ServerSettings

            return ServerSettings.model_json_schema()
        case Document.API:
            from deltalight.services.api.settings import ApiSettings

            return ApiSettings.model_json_schema()
