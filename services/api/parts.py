"""Routes of a scene's parts: the real scene, lights, method, shading, output."""

from enum import Enum
from typing import Any

from fastapi import APIRouter, Response

from protocol.scene_lights import Lights
from protocol.scene_method import Method, Output, Shading
from protocol.scene_objects import RealScene
from services.api.bodies import LightsBody, MethodBody, OutputBody, PartPatch, RealBody, ShadingBody
from services.api.context import OnTerms, Shared
from services.api.models import SceneAnswer
from services.api.problems import responses
from services.api.scenes import CHANGE_PROBLEMS, SceneId
from services.storage.documents import patch_part, replace_part

router = APIRouter(prefix="/scenes/{scene_id}")


def _add_part(part: str, model: Any, body: Any, text: str) -> None:  # noqa: ANN401 - types for the description
    """Add the three routes of a part; `model` and `body` describe what is read and sent."""

    def get(shared: Shared, scene_id: SceneId, response: Response) -> object:
        document = shared.store.scenes.get(scene_id).document
        response.headers["ETag"] = f'"{document.revision}"'
        value: object = getattr(document, part)
        return value

    def put(
        shared: Shared, scene_id: SceneId, value: body, response: Response, terms: OnTerms
    ) -> SceneAnswer:
        return shared.change(scene_id, replace_part(part, value), f"{part} replaced", terms, response)

    def patch(
        shared: Shared, scene_id: SceneId, value: PartPatch, response: Response, terms: OnTerms
    ) -> SceneAnswer:
        return shared.change(scene_id, patch_part(part, value), f"{part} changed", terms, response)

    tags: list[str | Enum] = [part if part in ("lights", "method", "output") else "scenes"]
    router.add_api_route(
        f"/{part}",
        get,
        name=f"get_{part}",
        summary=f"Get {text}",
        response_model=model,
        responses=responses(404),
        tags=tags,
    )
    for method, route, verb in (("PUT", put, "Replace"), ("PATCH", patch, "Change keys of")):
        router.add_api_route(
            f"/{part}",
            route,
            methods=[method],
            name=f"{method.lower()}_{part}",
            summary=f"{verb} {text}",
            responses=CHANGE_PROBLEMS,
            tags=tags,
        )


_add_part("real", RealScene, RealBody, "the real scene: its geometry and declared surfaces")
_add_part("lights", Lights, LightsBody, "the lights")
_add_part("method", Method, MethodBody, "the relighting method and its settings")
_add_part("shading", Shading, ShadingBody, "how virtual surfaces get their indirect light")
_add_part("output", Output, OutputBody, "the settings of the picture")
