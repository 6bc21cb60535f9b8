"""Routes of a scene's objects."""

from typing import Annotated

from fastapi import APIRouter, Path, Response

from protocol.scene_objects import SceneObject
from services.api.bodies import ObjectBody, ObjectPatch
from services.api.context import OnTerms, Shared
from services.api.models import SceneAnswer
from services.api.problems import responses
from services.api.scenes import CHANGE_PROBLEMS, SceneId
from services.storage.documents import add_object, patch_object, remove_object, replace_object
from services.storage.faults import NotFoundError

router = APIRouter(tags=["objects"], prefix="/scenes/{scene_id}/objects")
# `path`: an id may hold slashes.
ObjectId = Annotated[str, Path(description="The object's `id`.", examples=["knot"])]


@router.get("", responses=responses(404))
def list_objects(shared: Shared, scene_id: SceneId) -> list[SceneObject]:
    """List the objects of a scene."""
    return list(shared.store.scenes.get(scene_id).document.objects)


@router.post("", status_code=201, responses=CHANGE_PROBLEMS)
def create_object(
    shared: Shared, scene_id: SceneId, item: ObjectBody, response: Response, terms: OnTerms
) -> SceneAnswer:
    """Add an object; without an `id` it gets a free one."""
    return shared.change(scene_id, add_object(item), "object added", terms, response)


@router.get("/{object_id:path}", responses=responses(404))
def get_object(shared: Shared, scene_id: SceneId, object_id: ObjectId, response: Response) -> SceneObject:
    """Return one object; the ETag is the scene's revision."""
    document = shared.store.scenes.get(scene_id).document
    response.headers["ETag"] = f'"{document.revision}"'
    for item in document.objects:
        if item.id == object_id:
            return item
    raise NotFoundError(f"the scene has no object `{object_id}`; list its objects for their ids.")


@router.put("/{object_id:path}", responses=CHANGE_PROBLEMS)
def put_object(
    *,
    shared: Shared,
    scene_id: SceneId,
    object_id: ObjectId,
    item: ObjectBody,
    response: Response,
    terms: OnTerms,
) -> SceneAnswer:
    """Put another object in place of one."""
    edit = replace_object(object_id, item)
    return shared.change(scene_id, edit, f"object {object_id} replaced", terms, response)


@router.patch("/{object_id:path}", responses=CHANGE_PROBLEMS)
def change_object(
    *,
    shared: Shared,
    scene_id: SceneId,
    object_id: ObjectId,
    patch: ObjectPatch,
    response: Response,
    terms: OnTerms,
) -> SceneAnswer:
    """Change keys of an object: its pose, its material, whether it is seen."""
    edit = patch_object(object_id, patch)
    return shared.change(scene_id, edit, f"object {object_id} changed", terms, response)


@router.delete("/{object_id:path}", responses=CHANGE_PROBLEMS)
def delete_object(
    shared: Shared, scene_id: SceneId, object_id: ObjectId, response: Response, terms: OnTerms
) -> SceneAnswer:
    """Take an object out of the scene; undo brings it back."""
    edit = remove_object(object_id)
    return shared.change(scene_id, edit, f"object {object_id} removed", terms, response)
