"""Routes of a scene's manual lights, one by one; `/lights` as a whole is a part of the document."""

from typing import Annotated

from fastapi import APIRouter, Path, Response

from protocol.scene_lights import ManualLight
from services.api.bodies import LightBody, LightPatch
from services.api.context import OnTerms, Shared
from services.api.models import SceneAnswer
from services.api.problems import responses
from services.api.scenes import CHANGE_PROBLEMS, SceneId
from services.storage.documents import add_light, light_at, patch_light, remove_light, replace_light

router = APIRouter(tags=["lights"], prefix="/scenes/{scene_id}/lights/manual")
Index = Annotated[int, Path(ge=0, le=63, description="Place among the manual lights, from 0.")]


@router.get("", responses=responses(404))
def list_lights(shared: Shared, scene_id: SceneId) -> list[ManualLight]:
    """List the manual lights of a scene."""
    return list(shared.store.scenes.get(scene_id).document.lights.manual)


@router.post("", status_code=201, responses=CHANGE_PROBLEMS)
def create_light(
    shared: Shared, scene_id: SceneId, light: LightBody, response: Response, terms: OnTerms
) -> SceneAnswer:
    """Add a manual light after the others; it shines in mode `manual`."""
    return shared.change(scene_id, add_light(light), "light added", terms, response)


@router.get("/{index}", responses=responses(404))
def get_light(shared: Shared, scene_id: SceneId, index: Index, response: Response) -> ManualLight:
    """Return one manual light; the ETag is the scene's revision."""
    document = shared.store.scenes.get(scene_id).document
    response.headers["ETag"] = f'"{document.revision}"'
    return light_at(document.lights.manual, index)


@router.put("/{index}", responses=CHANGE_PROBLEMS)
def put_light(
    *,
    shared: Shared,
    scene_id: SceneId,
    index: Index,
    light: LightBody,
    response: Response,
    terms: OnTerms,
) -> SceneAnswer:
    """Put another manual light in place of one."""
    return shared.change(scene_id, replace_light(index, light), f"light {index} replaced", terms, response)


@router.patch("/{index}", responses=CHANGE_PROBLEMS)
def change_light(
    *,
    shared: Shared,
    scene_id: SceneId,
    index: Index,
    patch: LightPatch,
    response: Response,
    terms: OnTerms,
) -> SceneAnswer:
    """Change keys of a manual light; for another `type` put a whole one in its place."""
    return shared.change(scene_id, patch_light(index, patch), f"light {index} changed", terms, response)


@router.delete("/{index}", responses=CHANGE_PROBLEMS)
def delete_light(
    shared: Shared, scene_id: SceneId, index: Index, response: Response, terms: OnTerms
) -> SceneAnswer:
    """Take a manual light out; those after it move up, and undo brings it back."""
    return shared.change(scene_id, remove_light(index), f"light {index} removed", terms, response)
