"""Routes of scenes and their revisions."""

from typing import Annotated, Literal

from fastapi import APIRouter, Path, Query, Response

from protocol.scene import SceneDocument
from services.api.bodies import SceneBody, ScenePatch
from services.api.context import Expected, OnTerms, Shared, with_revision_of
from services.api.models import RevisionEntry, SceneAnswer, SceneSummary
from services.api.problems import responses
from services.api.sent_documents import DOCUMENT_BODY, DOCUMENT_FILES, SentDocument, document_file
from services.storage.documents import patch_document, replace_document
from services.storage.faults import NotFoundError

router = APIRouter(tags=["scenes"])
SceneId = Annotated[str, Path(description="The scene's `id`.", examples=["4f0c2a9be1d37785"])]
CHANGE_PROBLEMS = responses(400, 404, 409, 422)
MAX_ENTRIES = 200
# SQLite's integers have 64 bits.
RevisionNumber = Annotated[int, Path(ge=1, lt=1 << 63)]


@router.get("/scenes")
def list_scenes(shared: Shared) -> list[SceneSummary]:
    """List all scenes."""
    return [SceneSummary.of(head) for head in shared.store.scenes.all()]


@router.post("/scenes", status_code=201, responses=responses(400, 409, 415, 422), openapi_extra=DOCUMENT_BODY)
def create_scene(shared: Shared, document: SentDocument, response: Response) -> SceneAnswer:
    """Make a scene of a document (an exported one too); assets are named by digest or uploaded name."""
    scene = shared.store.scenes.create(document)
    response.headers["Location"] = f"/api/v1/scenes/{scene.head.id}"
    return shared.answer(scene, response, changed=True)


@router.get("/active-scene", responses=responses(404))
def active_scene(shared: Shared, response: Response) -> SceneAnswer:
    """Return the scene that is rendered."""
    scene = shared.store.scenes.active()
    if scene is None:
        raise NotFoundError("no scene is active; activate one of the scenes.")
    return shared.answer(scene, response)


@router.get("/scenes/{scene_id}", responses=responses(404))
def get_scene(shared: Shared, scene_id: SceneId, response: Response) -> SceneAnswer:
    """Return a scene; the ETag is its revision."""
    return shared.answer(shared.store.scenes.get(scene_id), response)


@router.put("/scenes/{scene_id}", responses=CHANGE_PROBLEMS)
def replace_scene(
    shared: Shared, scene_id: SceneId, document: SceneBody, response: Response, terms: OnTerms
) -> SceneAnswer:
    """Put another document in place of a scene's; a `revision` in it counts as If-Match."""
    terms = with_revision_of(document, terms)
    return shared.change(scene_id, replace_document(document), "document replaced", terms, response)


@router.patch("/scenes/{scene_id}", responses=CHANGE_PROBLEMS)
def patch_scene(
    shared: Shared, scene_id: SceneId, patch: ScenePatch, response: Response, terms: OnTerms
) -> SceneAnswer:
    """Change keys of a scene's document; a `revision` in the patch counts as If-Match."""
    what = f"{', '.join(sorted(set(patch) - {'revision'})) or 'nothing'} changed"[:200]
    return shared.change(scene_id, patch_document(patch), what, with_revision_of(patch, terms), response)


@router.delete("/scenes/{scene_id}", status_code=204, responses=responses(400, 404, 409))
def delete_scene(shared: Shared, scene_id: SceneId, if_match: Expected) -> None:
    """Delete a scene that is not active."""
    revision = shared.store.scenes.get(scene_id).head.revision
    shared.store.scenes.delete(scene_id, if_match)
    body = {"id": scene_id, "revision": revision, "what": "deleted", "active": False, "deleted": True}
    shared.events.publish("scene", body)


@router.get(
    "/scenes/{scene_id}/document", response_model=SceneDocument, responses=responses(404) | DOCUMENT_FILES
)
def export_document(
    shared: Shared,
    scene_id: SceneId,
    kind: Annotated[
        Literal["json", "yaml"], Query(alias="format", description="How it is written.")
    ] = "json",
) -> Response:
    """Return the document alone, as a file to keep or to import."""
    document = shared.store.scenes.get(scene_id).document
    name = f"scene-{scene_id}-{document.revision}"
    return document_file(document, name, as_yaml=kind == "yaml")


@router.get("/scenes/{scene_id}/revisions", responses=responses(404))
def list_revisions(
    shared: Shared,
    scene_id: SceneId,
    before: Annotated[
        int | None, Query(ge=1, lt=1 << 63, description="Only revisions below this one.")
    ] = None,
    limit: Annotated[int, Query(ge=1, le=MAX_ENTRIES, description="At most so many.")] = 50,
) -> list[RevisionEntry]:
    """List the changes of a scene, the newest first."""
    return [RevisionEntry.of(each) for each in shared.store.scenes.history(scene_id, before, limit)]


@router.get("/scenes/{scene_id}/revisions/{revision}", responses=responses(404))
def get_revision(
    shared: Shared, scene_id: SceneId, revision: RevisionNumber, response: Response
) -> SceneAnswer:
    """Return a scene as it was at a revision."""
    return shared.answer(shared.store.scenes.revision(scene_id, revision), response)


@router.post("/scenes/{scene_id}/undo", responses=responses(400, 404, 409))
def undo(shared: Shared, scene_id: SceneId, response: Response, if_match: Expected) -> SceneAnswer:
    """Take the last change back, by a new revision."""
    return shared.answer(shared.store.scenes.undo(scene_id, if_match), response, changed=True)


@router.post("/scenes/{scene_id}/redo", responses=responses(400, 404, 409))
def redo(shared: Shared, scene_id: SceneId, response: Response, if_match: Expected) -> SceneAnswer:
    """Make the change again that undo took back."""
    return shared.answer(shared.store.scenes.redo(scene_id, if_match), response, changed=True)


@router.post("/scenes/{scene_id}/duplicate", status_code=201, responses=responses(404))
def duplicate(
    shared: Shared,
    scene_id: SceneId,
    response: Response,
    name: Annotated[
        str | None, Query(max_length=200, description="Title of the copy; default: `... (copy)`.")
    ] = None,
) -> SceneAnswer:
    """Make a copy of a scene."""
    scene = shared.store.scenes.duplicate(scene_id, name)
    response.headers["Location"] = f"/api/v1/scenes/{scene.head.id}"
    return shared.answer(scene, response, changed=True)


@router.post("/scenes/{scene_id}/activate", responses=responses(404))
def activate(shared: Shared, scene_id: SceneId, response: Response) -> SceneAnswer:
    """Render this scene from the next frame on."""
    return shared.answer(shared.store.scenes.activate(scene_id), response, changed=True)
