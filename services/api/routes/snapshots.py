"""Routes of snapshots: one frame in any number of views, as pictures to keep."""

from pathlib import Path as FilePath
from tempfile import TemporaryDirectory
from typing import Annotated, Any, get_args

import numpy as np
from fastapi import Body, Path, Response
from jaxtyping import UInt8
from pydantic import Field, StrictBool, model_validator

from deltalight.protocol.documents import StrictModel
from deltalight.protocol.message_fields import Name
from deltalight.protocol.methods import Method
from deltalight.protocol.pictures import decode_rgb, read_bytes
from deltalight.protocol.scene_output import Output
from deltalight.services.api.api_router import api_router
from deltalight.services.api.context import Context, Shared, in_pool
from deltalight.services.api.file_response import StoredFileResponse
from deltalight.services.api.problems import ProblemError, responses, unavailable
from deltalight.services.api.request_bodies import AS_SENT, checked
from deltalight.services.api.routes.assets import UNCHANGING
from deltalight.services.api.routes.live import NO_ANSWER
from deltalight.services.api.snapshot_store import ID, SnapshotFacts, SnapshotPicture, files_of, now
from deltalight.services.before_after import before_after_gif, write_before_after_video
from deltalight.services.storage.faults import NotFoundError

router = api_router("/snapshots", tags=["snapshots"])
ROUTERS = (router,)
VIEWS: tuple[str, ...] = ("camera", *get_args(Output.model_fields["view"].annotation))
BEFORE_AFTER = ("camera", "composite")
MAX_PICTURES = 16
EXR = "composite.exr"
# Sixteen pictures by the slowest method, in software.
TIMEOUT_S = 120.0
SnapshotId = Annotated[
    str,
    Path(pattern=f"^{ID.pattern}$", description="The snapshot's `id`.", examples=["20261121-101500-3fa2c1"]),
]
FILE_ANSWER: dict[int | str, dict[str, Any]] = {
    200: {
        "content": {
            media_type: {"schema": {"type": "string", "format": "binary"}}
            for media_type in ("image/png", "image/x-exr")
        }
    }
}


class WantedPicture(StrictModel):
    """A picture to take."""

    name: Name = Field(description="Its file is called NAME.png.")
    view: str = Field(default="composite", description=f"One of {', '.join(VIEWS)}.")
    method: Method | None = Field(
        default=None, description="Method to relight with; null = as the scene says."
    )

    @model_validator(mode="after")
    def _check(self) -> "WantedPicture":
        if self.view not in VIEWS:
            raise ValueError(f"the view must be one of {', '.join(VIEWS)}")
        return self


class NewSnapshot(StrictModel):
    """What to take; by default every view."""

    pictures: tuple[WantedPicture, ...] = Field(
        default=tuple(WantedPicture(name=view, view=view) for view in VIEWS),
        min_length=1,
        max_length=MAX_PICTURES,
        fail_fast=True,
        description="Pictures to take, all of the same frame.",
    )
    camera: Name | None = Field(
        default=None, description="Name of the camera's node; null = the first camera."
    )
    exr: StrictBool = Field(default=False, description=f"Add {EXR}: the composite's linear radiance.")

    @model_validator(mode="after")
    def _check(self) -> "NewSnapshot":
        names = [picture.name for picture in self.pictures]
        if len(set(names)) < len(names):
            raise ValueError("two pictures have the same name")
        return self


@router.get("")
def list_snapshots(shared: Shared) -> list[SnapshotFacts]:
    """List all snapshots, newest first."""
    return shared.snapshots.all()


@router.post("", status_code=201, responses={**responses(404, 409, 422, 502), **unavailable(NO_ANSWER)})
@in_pool("render server")
def take_snapshot(
    shared: Shared,
    response: Response,
    wanted: Annotated[
        NewSnapshot,
        AS_SENT,
        Body(examples=[{"pictures": [{"name": "paper", "method": {"name": "dvct", "operator": "paper"}}]}]),
    ],
) -> SnapshotFacts:
    """Render the newest frame as specified for each picture, and keep the files."""
    order = checked(NewSnapshot, wanted, "the snapshot")
    shared.live.require(order.camera)
    taken = shared.snapshots.add(lambda name, folder: _taken(shared, name, folder, order))
    response.headers["Location"] = f"/api/v1/snapshots/{taken.id}"
    shared.events.publish("snapshot", taken.model_dump())
    return taken


@router.get("/{snapshot_id}", responses=responses(404))
def get_snapshot(shared: Shared, snapshot_id: SnapshotId) -> SnapshotFacts:
    """Return the facts of a snapshot."""
    return shared.snapshots.get(snapshot_id)


@router.get(
    "/{snapshot_id}/before-after.gif",
    response_class=Response,
    responses=responses(404) | {200: {"content": {"image/gif": {}}}},
)
@in_pool("thumbnails")
def snapshot_before_after(shared: Shared, snapshot_id: SnapshotId) -> Response:
    """Return an animation in which a moving line divides the camera's picture from the composite."""
    before, after = _before_and_after(shared, snapshot_id)
    return Response(before_after_gif(before, after), media_type="image/gif", headers=UNCHANGING)


@router.get(
    "/{snapshot_id}/before-after.mp4",
    response_class=Response,
    responses=responses(404, 422) | {200: {"content": {"video/mp4": {}}}},
)
@in_pool("thumbnails")
def snapshot_before_after_video(shared: Shared, snapshot_id: SnapshotId) -> Response:
    """Return the same as a full-size video (H.264) of a few seconds; needs the package `av`."""
    before, after = _before_and_after(shared, snapshot_id)
    with TemporaryDirectory(prefix=".video-", dir=shared.store.folder) as folder:
        path = FilePath(folder) / "before-after.mp4"
        write_before_after_video(path, before, after)
        return Response(read_bytes(path), media_type="video/mp4", headers=UNCHANGING)


@router.get(
    "/{snapshot_id}/{file}", response_class=StoredFileResponse, responses=responses(404) | FILE_ANSWER
)
def snapshot_file(
    shared: Shared,
    snapshot_id: SnapshotId,
    file: Annotated[str, Path(max_length=80, description="One of its files.", examples=["composite.png"])],
) -> StoredFileResponse:
    """Return a picture of a snapshot."""
    path = shared.snapshots.file(snapshot_id, file)
    media_type = "image/x-exr" if path.suffix == ".exr" else "image/png"
    return StoredFileResponse(path, media_type=media_type, headers=UNCHANGING)


@router.delete("/{snapshot_id}", status_code=204, responses=responses(404))
def delete_snapshot(shared: Shared, snapshot_id: SnapshotId) -> None:
    """Delete a snapshot permanently."""
    shared.snapshots.remove(snapshot_id)
    shared.events.publish("snapshot", {"id": snapshot_id, "deleted": True})


def _taken(shared: Context, name: str, folder: FilePath, wanted: NewSnapshot) -> SnapshotFacts:
    active = shared.store.scenes.active()
    pictures = [picture.model_dump(mode="json") for picture in wanted.pictures]
    order: dict[str, object] = {"folder": str(folder), "pictures": pictures, "exr": wanted.exr}
    if wanted.camera is not None:
        order["camera"] = wanted.camera
    answer: dict[str, Any] = shared.link.command("snapshot", order, TIMEOUT_S)
    files, faults = files_of(answer, folder)
    if not files:
        reason = next(iter(faults.values()), "it wrote no file into the data folder; run it on this host.")
        raise ProblemError(502, "no-pictures", f"The render server took no picture: {reason}")
    return SnapshotFacts(
        id=name,
        taken=now(),
        frame_id=answer["frame_id"],
        capture_ns=answer["capture_ns"],
        scene_id=None if active is None else active.head.id,
        scene_revision=None if active is None else active.document.revision,
        recording=shared.replay.recording or (shared.heard.replay() or {}).get("recording"),
        pictures=[_described(picture, files, faults) for picture in wanted.pictures],
        files=files,
    )


def _before_and_after(shared: Context, snapshot_id: str) -> list[UInt8[np.ndarray, "h w 3"]]:
    """Returns the camera's picture and the first composite."""
    files = [(each.view, each.file) for each in shared.snapshots.get(snapshot_id).pictures if each.file]
    found = dict(reversed(files))
    for view in BEFORE_AFTER:
        if view not in found:
            raise NotFoundError(f"the snapshot has no picture of view `{view}`; take one that has.")
    return [_picture(shared.snapshots.file(snapshot_id, found[view])) for view in BEFORE_AFTER]


def _picture(path: FilePath) -> UInt8[np.ndarray, "h w 3"]:
    return decode_rgb(read_bytes(path), path.name)


def _described(picture: WantedPicture, files: list[str], faults: dict[str, str]) -> SnapshotPicture:
    file = f"{picture.name}.png"
    return SnapshotPicture(
        name=picture.name,
        view=picture.view,
        method=picture.method,
        file=file if file in files else None,
        detail=faults.get(picture.name, ""),
    )
