"""Routes of uploaded assets."""

from typing import Annotated, Any

from fastapi import Path, Query, Request, Response
from fastapi.concurrency import run_in_threadpool

from deltalight.protocol.scene import DIGEST_PREFIX
from deltalight.protocol.scene_fields import Text
from deltalight.services.api.api_router import api_router
from deltalight.services.api.context import Context, Shared, in_pool
from deltalight.services.api.file_response import StoredFileResponse
from deltalight.services.api.models import AssetAnswer
from deltalight.services.api.problems import responses
from deltalight.services.api.request_bodies import UPLOAD_TYPE, require_upload_type
from deltalight.services.storage.asset_kinds import FORMATS
from deltalight.services.storage.assets import Asset

router = api_router("/assets", tags=["assets"])
ROUTERS = (router,)
Digest = Annotated[
    str, Path(description="`sha256:<hex>` or the digits alone.", examples=["sha256:2c26b46b68ffc68f..."])
]
UNCHANGING = {
    "Cache-Control": "private, max-age=31536000, immutable",
    "X-Content-Type-Options": "nosniff",
    "Content-Security-Policy": "sandbox; default-src 'none'",
}
PNG: dict[int | str, dict[str, Any]] = {
    200: {"content": {"image/png": {"schema": {"type": "string", "format": "binary"}}}}
}
_KNOWN = ", ".join(each.name.upper() for each in FORMATS)
KEPT_ANSWERS: dict[int | str, dict[str, Any]] = {
    200: {"model": AssetAnswer, "description": "The same content already exists."}
}
_UPLOAD_ANSWERS = {**KEPT_ANSWERS, **responses(400, 413, 415, 422)}
_UPLOAD_BODY = {
    "requestBody": {
        "required": True,
        "description": f"The file itself: {_KNOWN}, or a ZIP of one glTF and its files.",
        "content": {UPLOAD_TYPE: {"schema": {"type": "string", "format": "binary"}}},
    }
}


@router.get("")
def list_assets(shared: Shared) -> list[AssetAnswer]:
    """List all assets, newest first."""
    return [AssetAnswer.of(asset) for asset in shared.store.assets.all()]


@router.post("", status_code=201, responses=_UPLOAD_ANSWERS, openapi_extra=_UPLOAD_BODY)
async def upload_asset(
    shared: Shared,
    request: Request,
    response: Response,
    name: Annotated[Text, Query(max_length=1000, description="Name of the file.", examples=["chair.glb"])],
) -> AssetAnswer:
    """Upload a mesh, map or precomputed material as the request body; 200 if the content already exists.

    The file is recognised by its content and loaded once in a process of its own, with limits of memory and time.
    A .zip of one glTF and its files is kept as one .glb.
    """
    require_upload_type(request)
    assets = shared.store.assets
    with assets.receiving(shared.settings.upload_limit_mb << 20) as incoming:
        async for chunk in request.stream():
            await run_in_threadpool(incoming.write, chunk)
        asset, is_new = await shared.pools["assets"].run(lambda: assets.keep(incoming, name))
    return announced(shared, asset, response, is_new=is_new)


def announced(shared: Context, asset: Asset, response: Response, *, is_new: bool) -> AssetAnswer:
    """Describes an asset that was kept; tells all listeners."""
    shared.events.publish("asset", {"digest": asset.reference, "name": asset.names[0]})
    response.status_code = 201 if is_new else 200
    response.headers["Location"] = f"/api/v1/assets/{asset.reference}"
    return AssetAnswer.of(asset)


@router.get("/{digest}", responses=responses(404))
def get_asset(shared: Shared, digest: Digest) -> AssetAnswer:
    """Return the facts of an asset."""
    return AssetAnswer.of(shared.store.assets.get(digest.removeprefix(DIGEST_PREFIX)))


@router.get("/{digest}/content", response_class=StoredFileResponse, responses=responses(404, 416))
@in_pool("asset files")
def download_asset(shared: Shared, digest: Digest) -> StoredFileResponse:
    """Download the file."""
    asset = shared.store.assets.get(digest.removeprefix(DIGEST_PREFIX))
    path = shared.store.assets.path(asset)
    return StoredFileResponse(
        path, media_type=asset.format.media_type, filename=asset.names[0], headers=UNCHANGING
    )


@router.get("/{digest}/thumbnail.png", response_class=StoredFileResponse, responses=responses(404, 422) | PNG)
@in_pool("thumbnails")
def thumbnail(shared: Shared, digest: Digest) -> StoredFileResponse:
    """Return a thumbnail of a mesh, map or material: 256 x 256 pixels on a transparent background."""
    path = shared.store.assets.thumbnail(digest.removeprefix(DIGEST_PREFIX))
    return StoredFileResponse(path, media_type="image/png", headers=UNCHANGING)


@router.delete("/{digest}", status_code=204, responses=responses(404, 409))
def delete_asset(shared: Shared, digest: Digest) -> None:
    """Delete an asset that no scene uses, currently or in a revision that undo can restore."""
    asset = shared.store.assets.get(digest.removeprefix(DIGEST_PREFIX))
    shared.store.assets.remove(digest.removeprefix(DIGEST_PREFIX))
    shared.events.publish("asset", {"digest": asset.reference, "name": asset.names[0], "deleted": True})
