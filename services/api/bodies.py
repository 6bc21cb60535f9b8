"""Bodies of requests: described by the protocol's models, validated as part of the whole scene document.

So every fault has the same sentence as on the command line, with its place in the document and the nearest key.
"""

from collections.abc import Mapping
from typing import Annotated, Any, TypeVar, cast

from fastapi import Body
from pydantic import BaseModel, ValidatorFunctionWrapHandler, WrapValidator

from protocol.documents import validate
from protocol.scene import SceneDocument
from protocol.scene_lights import Lights, ManualLight
from protocol.scene_method import Method, Output, Shading
from protocol.scene_objects import RealScene, SceneObject

Model = TypeVar("Model", bound=BaseModel)


def _as_sent(value: object, _validate: ValidatorFunctionWrapHandler) -> object:
    """Leave the body as it is; its model only describes it."""
    return value


def checked(model: type[Model], sent: object, name: str) -> Model:
    """Validate a body called `name` that came `AS_SENT`.

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
