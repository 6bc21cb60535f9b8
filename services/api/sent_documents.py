"""Scene documents in requests and answers, as JSON or YAML."""

import json
from typing import Annotated, Any

import yaml
from fastapi import Depends, Request, Response

from protocol.documents import parse_mapping, yaml_text
from protocol.scene import SceneDocument
from services.api.bodies import SCENE_EXAMPLE
from services.api.problems import ProblemError

JSON_TYPE, YAML_TYPE = "application/json", "application/yaml"
_YAML_TYPES = (YAML_TYPE, "application/x-yaml", "text/yaml")  # before RFC 9512 there was no registered one
_REFERENCE = {"$ref": "#/components/schemas/SceneDocument"}
DOCUMENT_BODY: dict[str, Any] = {
    "requestBody": {
        "required": True,
        "content": {
            JSON_TYPE: {"schema": {**_REFERENCE, "examples": [SCENE_EXAMPLE]}},
            YAML_TYPE: {"schema": {**_REFERENCE, "examples": [yaml.safe_dump(SCENE_EXAMPLE)]}},
        },
    }
}
DOCUMENT_FILES: dict[int | str, dict[str, Any]] = {200: {"content": {YAML_TYPE: {"schema": _REFERENCE}}}}


async def _sent(request: Request) -> object:
    media_type = request.headers.get("content-type", JSON_TYPE).partition(";")[0].strip().lower()
    body = await request.body()
    if not body:
        raise ProblemError(422, "invalid", "The body is missing; send a scene document.")
    if media_type == JSON_TYPE:
        return _parsed_json(body)
    if media_type not in _YAML_TYPES:
        raise ProblemError(
            415, "media-type", f"Send the document with Content-Type: {JSON_TYPE} or {YAML_TYPE}."
        )
    return parse_mapping(_text(body), "the document", is_json=False)


def _parsed_json(body: bytes) -> object:
    try:
        return json.loads(_text(body))
    except (ValueError, RecursionError) as fault:
        raise ProblemError(400, "not-json", "The body is not valid JSON; correct it.") from fault


def _text(body: bytes) -> str:
    try:
        return body.decode("utf-8-sig")
    except UnicodeDecodeError as fault:
        raise ProblemError(
            400, "not-text", "The body is not UTF-8 text; send the document as text."
        ) from fault


SentDocument = Annotated[Any, Depends(_sent)]


def document_file(document: SceneDocument, name: str, *, as_yaml: bool) -> Response:
    """The answer that a browser keeps as a file NAME.json or NAME.yaml."""
    if as_yaml:
        content = yaml_text(document.model_dump(mode="json"))
        media_type, suffix = YAML_TYPE, "yaml"
    else:
        content, media_type, suffix = document.model_dump_json(), JSON_TYPE, "json"
    headers = {"Content-Disposition": f'attachment; filename="{name}.{suffix}"'}
    return Response(content, media_type=media_type, headers=headers)
