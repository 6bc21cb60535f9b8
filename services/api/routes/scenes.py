"""Routes of scenes: their revisions, objects, manual lights and the parts of the document."""

from collections.abc import Mapping
from enum import Enum
from typing import Annotated, Any, Literal

from fastapi import Path, Query, Response

from deltalight.protocol.methods import Method
from deltalight.protocol.scene import SceneDocument
from deltalight.protocol.scene_lights import Lights, ManualLight
from deltalight.protocol.scene_objects import RealScene, SceneObject
from deltalight.protocol.scene_output import Output, Shading
from deltalight.services.api.api_router import api_router
from deltalight.services.api.context import ExpectedRevision, IfUnchanged, Shared, with_revision_of
from deltalight.services.api.models import RevisionEntry, SceneAnswer, SceneSummary
from deltalight.services.api.problems import responses
from deltalight.services.api.request_bodies import (
    DOCUMENT_BODY,
    DOCUMENT_FILES,
    LightBody,
    LightPatch,
    LightsBody,
    MethodBody,
    ObjectBody,
    ObjectPatch,
    OutputBody,
    PartPatch,
    RealBody,
    SceneBody,
    ScenePatch,
    SentDocument,
    ShadingBody,
    document_file,
)
from deltalight.services.storage.documents import (
    add_light,
    add_object,
    light_at,
    patch_document,
    patch_light,
    patch_object,
    patch_part,
    remove_light,
    remove_object,
    replace_document,
    replace_light,
    replace_object,
    replace_part,
)
from deltalight.services.storage.faults import NotFoundError

scenes_router = api_router(tags=["scenes"])
objects_router = api_router("/scenes/{scene_id}/objects", tags=["objects"])
lights_router = api_router("/scenes/{scene_id}/lights/manual", tags=["lights"])
parts_router = api_router("/scenes/{scene_id}")
ROUTERS = (scenes_router, objects_router, lights_router, parts_router)

SceneId = Annotated[str, Path(description="The scene's `id`.", examples=["4f0c2a9be1d37785"])]
# SQLite's integers have 64 bits.
RevisionNumber = Annotated[int, Path(ge=1, lt=1 << 63)]
# `path`: an id may contain slashes.
ObjectId = Annotated[str, Path(description="The object's `id`.", examples=["knot"])]
Index = Annotated[int, Path(ge=0, le=63, description="Index among the manual lights, from 0.")]
CHANGE_PROBLEMS = responses(400, 404, 409, 422)
MAX_ENTRIES = 200
LONGEST_WHAT = 200  # characters of what a revision says of itself


def _named(body: object, key: str, otherwise: str) -> str:
    """Returns a name from a body that is not validated yet."""
    name = body.get(key) if isinstance(body, Mapping) else None
    return name[: LONGEST_WHAT // 2] if isinstance(name, str) and name else otherwise


def _changed(name: str, patch: Mapping[str, Any]) -> str:
    """Says for people what a patch changes, such as `knot: pose changed`."""
    keys = [key.replace("_", " ") for key in sorted(patch)]
    place = f"{name}: " if name else ""
    return f"{place}{', '.join(keys) or 'nothing'} changed"[:LONGEST_WHAT]


@scenes_router.get("/scenes")
def list_scenes(shared: Shared) -> list[SceneSummary]:
    """List all scenes."""
    return [SceneSummary.of(head) for head in shared.store.scenes.all()]


@scenes_router.post(
    "/scenes", status_code=201, responses=responses(400, 409, 415, 422), openapi_extra=DOCUMENT_BODY
)
def create_scene(shared: Shared, document: SentDocument, response: Response) -> SceneAnswer:
    """Create a scene from a document, such as an exported one; it refers to assets by digest or uploaded name."""
    scene = shared.store.scenes.create(document)
    response.headers["Location"] = f"/api/v1/scenes/{scene.head.id}"
    return shared.answer(scene, response, changed=True)


@scenes_router.get("/active-scene", responses=responses(404))
def active_scene(shared: Shared, response: Response) -> SceneAnswer:
    """Return the active scene."""
    scene = shared.store.scenes.active()
    if scene is None:
        raise NotFoundError("no scene is active; activate one of the scenes.")
    return shared.answer(scene, response)


@scenes_router.get("/scenes/{scene_id}", responses=responses(404))
def get_scene(shared: Shared, scene_id: SceneId, response: Response) -> SceneAnswer:
    """Return a scene; the ETag is its revision."""
    return shared.answer(shared.store.scenes.get(scene_id), response)


@scenes_router.put("/scenes/{scene_id}", responses=CHANGE_PROBLEMS)
def replace_scene(
    shared: Shared, scene_id: SceneId, document: SceneBody, response: Response, precondition: IfUnchanged
) -> SceneAnswer:
    """Replace a scene's document; a `revision` in it counts as If-Match."""
    precondition = with_revision_of(document, precondition)
    return shared.change(scene_id, replace_document(document), "document replaced", precondition, response)


@scenes_router.patch("/scenes/{scene_id}", responses=CHANGE_PROBLEMS)
def patch_scene(
    shared: Shared, scene_id: SceneId, patch: ScenePatch, response: Response, precondition: IfUnchanged
) -> SceneAnswer:
    """Change keys of a scene's document; a `revision` in the patch counts as If-Match."""
    what = _changed("", {key: value for key, value in patch.items() if key != "revision"})
    return shared.change(
        scene_id, patch_document(patch), what, with_revision_of(patch, precondition), response
    )


@scenes_router.delete("/scenes/{scene_id}", status_code=204, responses=responses(400, 404, 409))
def delete_scene(shared: Shared, scene_id: SceneId, if_match: ExpectedRevision) -> None:
    """Delete a scene that is not active."""
    revision = shared.store.scenes.get(scene_id).head.revision
    shared.store.scenes.delete(scene_id, if_match)
    body = {"id": scene_id, "revision": revision, "what": "deleted", "active": False, "deleted": True}
    shared.events.publish("scene", body)


@scenes_router.get(
    "/scenes/{scene_id}/document", response_model=SceneDocument, responses=responses(404) | DOCUMENT_FILES
)
def export_document(
    shared: Shared,
    scene_id: SceneId,
    kind: Annotated[
        Literal["json", "yaml"], Query(alias="format", description="How it is written.")
    ] = "json",
) -> Response:
    """Return only the document, as a file to keep or to import."""
    document = shared.store.scenes.get(scene_id).document
    name = f"scene-{scene_id}-{document.revision}"
    return document_file(document, name, as_yaml=kind == "yaml")


@scenes_router.get("/scenes/{scene_id}/revisions", responses=responses(404))
def list_revisions(
    shared: Shared,
    scene_id: SceneId,
    before: Annotated[
        int | None, Query(ge=1, lt=1 << 63, description="Only revisions below this one.")
    ] = None,
    limit: Annotated[int, Query(ge=1, le=MAX_ENTRIES, description="The most entries to return.")] = 50,
) -> list[RevisionEntry]:
    """List the changes of a scene, newest first."""
    return [RevisionEntry.of(each) for each in shared.store.scenes.history(scene_id, before, limit)]


@scenes_router.get("/scenes/{scene_id}/revisions/{revision}", responses=responses(404))
def get_revision(
    shared: Shared, scene_id: SceneId, revision: RevisionNumber, response: Response
) -> SceneAnswer:
    """Return a scene as it was at a revision."""
    return shared.answer(shared.store.scenes.revision(scene_id, revision), response)


@scenes_router.post("/scenes/{scene_id}/undo", responses=responses(400, 404, 409))
def undo(shared: Shared, scene_id: SceneId, response: Response, if_match: ExpectedRevision) -> SceneAnswer:
    """Undo the last change, by a new revision."""
    return shared.answer(shared.store.scenes.undo(scene_id, if_match), response, changed=True)


@scenes_router.post("/scenes/{scene_id}/redo", responses=responses(400, 404, 409))
def redo(shared: Shared, scene_id: SceneId, response: Response, if_match: ExpectedRevision) -> SceneAnswer:
    """Redo the change that was undone last."""
    return shared.answer(shared.store.scenes.redo(scene_id, if_match), response, changed=True)


@scenes_router.post("/scenes/{scene_id}/duplicate", status_code=201, responses=responses(404))
def duplicate(
    shared: Shared,
    scene_id: SceneId,
    response: Response,
    name: Annotated[
        str | None, Query(max_length=200, description="Title of the copy; default: `... (copy)`.")
    ] = None,
) -> SceneAnswer:
    """Copy a scene."""
    scene = shared.store.scenes.duplicate(scene_id, name)
    response.headers["Location"] = f"/api/v1/scenes/{scene.head.id}"
    return shared.answer(scene, response, changed=True)


@scenes_router.post("/scenes/{scene_id}/activate", responses=responses(404))
def activate(shared: Shared, scene_id: SceneId, response: Response) -> SceneAnswer:
    """Render this scene from the next frame on."""
    return shared.answer(shared.store.scenes.activate(scene_id), response, changed=True)


@objects_router.get("", responses=responses(404))
def list_objects(shared: Shared, scene_id: SceneId) -> list[SceneObject]:
    """List the objects of a scene."""
    return list(shared.store.scenes.get(scene_id).document.objects)


@objects_router.post("", status_code=201, responses=CHANGE_PROBLEMS)
def create_object(
    shared: Shared, scene_id: SceneId, item: ObjectBody, response: Response, precondition: IfUnchanged
) -> SceneAnswer:
    """Add an object; without an `id` it gets a free one."""
    return shared.change(
        scene_id, add_object(item), f"{_named(item, 'id', 'object')} added", precondition, response
    )


@objects_router.get("/{object_id:path}", responses=responses(404))
def get_object(shared: Shared, scene_id: SceneId, object_id: ObjectId, response: Response) -> SceneObject:
    """Return one object; the ETag is the scene's revision."""
    document = shared.store.scenes.get(scene_id).document
    response.headers["ETag"] = f'"{document.revision}"'
    for item in document.objects:
        if item.id == object_id:
            return item
    raise NotFoundError(f"the scene has no object `{object_id}`; list its objects for their ids.")


@objects_router.put("/{object_id:path}", responses=CHANGE_PROBLEMS)
def put_object(
    *,
    shared: Shared,
    scene_id: SceneId,
    object_id: ObjectId,
    item: ObjectBody,
    response: Response,
    precondition: IfUnchanged,
) -> SceneAnswer:
    """Replace an object."""
    edit = replace_object(object_id, item)
    name = _named(item, "id", object_id)
    what = f"{object_id} replaced" if name == object_id else f"{object_id} renamed to {name}"
    return shared.change(scene_id, edit, what[:LONGEST_WHAT], precondition, response)


@objects_router.patch("/{object_id:path}", responses=CHANGE_PROBLEMS)
def change_object(
    *,
    shared: Shared,
    scene_id: SceneId,
    object_id: ObjectId,
    patch: ObjectPatch,
    response: Response,
    precondition: IfUnchanged,
) -> SceneAnswer:
    """Change keys of an object, such as its pose, its material or its visibility."""
    edit = patch_object(object_id, patch)
    return shared.change(scene_id, edit, _changed(object_id, patch), precondition, response)


@objects_router.delete("/{object_id:path}", responses=CHANGE_PROBLEMS)
def delete_object(
    shared: Shared, scene_id: SceneId, object_id: ObjectId, response: Response, precondition: IfUnchanged
) -> SceneAnswer:
    """Remove an object from the scene; undo restores it."""
    edit = remove_object(object_id)
    return shared.change(scene_id, edit, f"{object_id} removed", precondition, response)


@lights_router.get("", responses=responses(404))
def list_lights(shared: Shared, scene_id: SceneId) -> list[ManualLight]:
    """List the manual lights of a scene."""
    return list(shared.store.scenes.get(scene_id).document.lights.manual)


@lights_router.post("", status_code=201, responses=CHANGE_PROBLEMS)
def create_light(
    shared: Shared, scene_id: SceneId, light: LightBody, response: Response, precondition: IfUnchanged
) -> SceneAnswer:
    """Append a manual light; it is used in mode `manual`."""
    what = f"{_named(light, 'type', 'a')} light added"
    return shared.change(scene_id, add_light(light), what, precondition, response)


@lights_router.get("/{index}", responses=responses(404))
def get_light(shared: Shared, scene_id: SceneId, index: Index, response: Response) -> ManualLight:
    """Return one manual light; the ETag is the scene's revision."""
    document = shared.store.scenes.get(scene_id).document
    response.headers["ETag"] = f'"{document.revision}"'
    return light_at(document.lights.manual, index)


@lights_router.put("/{index}", responses=CHANGE_PROBLEMS)
def put_light(
    *,
    shared: Shared,
    scene_id: SceneId,
    index: Index,
    light: LightBody,
    response: Response,
    precondition: IfUnchanged,
) -> SceneAnswer:
    """Replace a manual light."""
    return shared.change(
        scene_id, replace_light(index, light), f"light {index + 1} replaced", precondition, response
    )


@lights_router.patch("/{index}", responses=CHANGE_PROBLEMS)
def change_light(
    *,
    shared: Shared,
    scene_id: SceneId,
    index: Index,
    patch: LightPatch,
    response: Response,
    precondition: IfUnchanged,
) -> SceneAnswer:
    """Change keys of a manual light; to change its `type`, replace it with PUT."""
    return shared.change(
        scene_id, patch_light(index, patch), _changed(f"light {index + 1}", patch), precondition, response
    )


@lights_router.delete("/{index}", responses=CHANGE_PROBLEMS)
def delete_light(
    shared: Shared, scene_id: SceneId, index: Index, response: Response, precondition: IfUnchanged
) -> SceneAnswer:
    """Remove a manual light; those after it move up, and undo restores it."""
    return shared.change(scene_id, remove_light(index), f"light {index + 1} removed", precondition, response)


def _add_part(part: str, model: Any, body: Any, text: str) -> None:  # noqa: ANN401 - types for the description
    """Adds the three routes of a part; `model` and `body` describe what is read and sent."""

    def get(shared: Shared, scene_id: SceneId, response: Response) -> object:
        document = shared.store.scenes.get(scene_id).document
        response.headers["ETag"] = f'"{document.revision}"'
        value: object = getattr(document, part)
        return value

    def put(
        shared: Shared, scene_id: SceneId, value: body, response: Response, precondition: IfUnchanged
    ) -> SceneAnswer:
        return shared.change(scene_id, replace_part(part, value), f"{part} replaced", precondition, response)

    def patch(
        shared: Shared, scene_id: SceneId, value: PartPatch, response: Response, precondition: IfUnchanged
    ) -> SceneAnswer:
        return shared.change(scene_id, patch_part(part, value), _changed(part, value), precondition, response)

    tags: list[str | Enum] = [part if part in ("lights", "method", "output") else "scenes"]
    parts_router.add_api_route(
        f"/{part}",
        get,
        name=f"get_{part}",
        summary=f"Get {text}",
        response_model=model,
        responses=responses(404),
        tags=tags,
    )
    for method, route, verb in (("PUT", put, "Replace"), ("PATCH", patch, "Change keys of")):
        parts_router.add_api_route(
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
