"""Bodies of requests: described by the protocol's models, validated as part of the whole scene document.

Every fault therefore has the same sentence as on the command line, with its place in the document and the nearest
key. Whole documents can also be sent and downloaded as YAML.
"""

import json
from collections.abc import Mapping
from functools import partial
from typing import Annotated, Any, TypeVar, cast

import yaml
from fastapi import Body, Depends, Request, Response
from pydantic import BaseModel, ValidatorFunctionWrapHandler, WrapValidator

from deltalight.protocol.documents import parse_mapping, validate
from deltalight.protocol.methods import Method
from deltalight.protocol.scene import SceneDocument
from deltalight.protocol.scene_lights import Lights, ManualLight
from deltalight.protocol.scene_objects import RealScene, SceneObject
from deltalight.protocol.scene_output import Output, Shading
from deltalight.protocol.yaml_text import yaml_text
from deltalight.services.api.context import Shared
from deltalight.services.api.problems import ProblemError, unreadable_json

UPLOAD_TYPE = "application/octet-stream"

Model = TypeVar("Model", bound=BaseModel)


def _as_sent(value: object, _validate: ValidatorFunctionWrapHandler) -> object:
    """Leaves the body unvalidated; its model only describes it."""
    if isinstance(value, bytes):  # of another media type
        raise ValueError("must be JSON")
    return value


def checked(model: type[Model], sent: object, name: str) -> Model:
    """Validates a body called `name` that came `AS_SENT`.

    Raises:
        DeltalightError: the first fault, with its place and the nearest key.
    """
    return validate(model, cast(Mapping[str, Any], sent), name, strict=True)


AS_SENT = WrapValidator(_as_sent)

_OBJECT = {
    "id": "knot",
    "asset": "knot.glb",
    "pose": {"translation_m": [0.29, -0.09, 0.0]},
    "material": {"base_color": [0.8, 0.3, 0.2], "roughness": 0.4},
}
SCENE_EXAMPLE = {"name": "a knot beside the board", "objects": [_OBJECT]}
_LIGHTS = {
    "mode": "manual",
    "manual": [
        {"type": "sphere", "position_m": [1.1, -0.36, 0.76], "intensity": 4.9, "radius_m": 0.06},
        {"type": "ambient", "radiance": 0.2},
    ],
}
_SURFACE = {"region": {"plane": {"normal": [0, 0, 1]}}, "roughness": 0.25}

SceneBody = Annotated[SceneDocument, AS_SENT, Body(examples=[SCENE_EXAMPLE])]
ObjectBody = Annotated[SceneObject, AS_SENT, Body(examples=[_OBJECT])]
RealBody = Annotated[RealScene, AS_SENT, Body(examples=[{"surfaces": [_SURFACE]}])]
LightBody = Annotated[ManualLight, AS_SENT, Body(examples=[_LIGHTS["manual"][0]])]
LightsBody = Annotated[Lights, AS_SENT, Body(examples=[_LIGHTS])]
MethodBody = Annotated[Method, AS_SENT, Body(examples=[{"name": "dvct", "bounces": 2}])]
ShadingBody = Annotated[Shading, AS_SENT, Body(examples=[{"name": "auto"}])]
OutputBody = Annotated[Output, AS_SENT, Body(examples=[{"view": "delta"}])]

_PATCH_TEXT = "JSON merge patch (RFC 7396): the keys that change; null puts a key back to its default."
ScenePatch = Annotated[
    dict[str, Any], Body(description=_PATCH_TEXT, examples=[{"output": {"view": "delta"}}])
]
ObjectPatch = Annotated[
    dict[str, Any],
    Body(description=_PATCH_TEXT, examples=[{"pose": {"translation_m": [0.3, -0.1, 0.0]}}]),
]
LightPatch = Annotated[dict[str, Any], Body(description=_PATCH_TEXT, examples=[{"intensity": 3.5}])]
PartPatch = Annotated[dict[str, Any], Body(description=_PATCH_TEXT, examples=[{}])]

JSON_TYPE, YAML_TYPE = "application/json", "application/yaml"
_YAML_TYPES = (YAML_TYPE, "application/x-yaml", "text/yaml")  # none was registered before RFC 9512
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


async def _sent(request: Request, shared: Shared) -> object:
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
    text = _text(body)
    parse = partial(parse_mapping, text, "the document", is_json=False)
    return await shared.pools["documents"].run(parse)


def _parsed_json(body: bytes) -> object:
    try:
        return json.loads(_text(body))
    except (ValueError, RecursionError) as fault:
        raise unreadable_json(fault) from fault


def _text(body: bytes) -> str:
    try:
        return body.decode("utf-8-sig")
    except UnicodeDecodeError as fault:
        raise ProblemError(
            400, "not-text", "The body is not UTF-8 text; send the document as text."
        ) from fault


SentDocument = Annotated[Any, Depends(_sent)]


def document_file(document: SceneDocument, name: str, *, as_yaml: bool) -> Response:
    """Returns a document as a download, NAME.json or NAME.yaml."""
    if as_yaml:
        content = yaml_text(document.model_dump(mode="json"))
        media_type, suffix = YAML_TYPE, "yaml"
    else:
        content, media_type, suffix = document.model_dump_json(), JSON_TYPE, "json"
    headers = {"Content-Disposition": f'attachment; filename="{name}.{suffix}"'}
    return Response(content, media_type=media_type, headers=headers)


def require_upload_type(request: Request) -> None:
    """Refuses a body that is no file as it is.

    Raises:
        ProblemError: it is of another media type.
    """
    if request.headers.get("content-type", "").partition(";")[0].strip().lower() != UPLOAD_TYPE:
        raise ProblemError(415, "media-type", f"Send the file as the body, with Content-Type: {UPLOAD_TYPE}.")
