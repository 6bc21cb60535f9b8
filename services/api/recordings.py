"""Routes of recordings."""

from datetime import UTC, datetime
from typing import Annotated, Any, Literal, Self

from fastapi import APIRouter, Body, Path, Response
from pydantic import Field

from protocol.documents import StrictModel
from protocol.errors import DeltalightError
from protocol.messages import Name
from services.api.bodies import AS_SENT, checked
from services.api.context import Context, Shared
from services.api.kept_files import KeptFile
from services.api.problems import responses
from services.api.take_recorder import RunningTake
from services.api.take_shelf import NAME, Take, TakeShelf
from services.storage.faults import ConflictError

router = APIRouter(tags=["recordings"], prefix="/recordings")
RecordingId = Annotated[
    str,
    Path(pattern=f"^{NAME.pattern}$", description="The recording's name.", examples=["take-20261121-101500"]),
]
POSTER_ANSWER: dict[int | str, dict[str, Any]] = {
    200: {"content": {"image/jpeg": {"schema": {"type": "string", "format": "binary"}}}}
}
DOWNLOAD_ANSWER: dict[int | str, dict[str, Any]] = {
    200: {"content": {"application/octet-stream": {"schema": {"type": "string", "format": "binary"}}}}
}


class NewRecording(StrictModel):
    """What to record; every key has a default."""

    name: str | None = Field(
        default=None, max_length=64, description="Letters, digits, dashes, underscores; null = the time."
    )
    duration_s: float | None = Field(
        default=None, ge=0.1, le=86_400, description="Ends so long after the first frame; null = by stop."
    )
    node: Name | None = Field(
        default=None, description="Which node; null = the one whose picture comes first."
    )


class Stream(StrictModel):
    """What one stream of a recording holds."""

    messages: int
    size_bytes: int = Field(description="Before compression.")


class RecordingAnswer(StrictModel):
    """A recording, finished or growing."""

    id: str = Field(description="Its name, also in addresses.", examples=["take-20261121-101500"])
    state: Literal["waiting", "recording", "finished", "interrupted"] = Field(
        description="`waiting` = no frame has come yet; `interrupted` = its recorder was killed: recover it."
    )
    detail: str = Field(description="What keeps it from growing, or from being read; else empty.")
    changed: datetime = Field(description="When it was finished; while it grows: when it was begun.")
    size_bytes: int
    duration_s: float | None
    frames: int | None
    frames_per_s: float | None
    lost: dict[str, int] = Field(description="What never came, by stream; known while it grows.")
    streams: dict[str, Stream]
    scene: str | None = Field(description="Title of the attached scene, empty for one without; null = none.")
    notes: list[str] = Field(description="What else is to be known of it.")

    @classmethod
    def growing(cls, take: RunningTake) -> Self:
        """Describe a recording that grows."""
        figures = take.figures or {}
        return cls(
            id=take.id,
            state="recording" if take.figures else "waiting",
            detail=take.detail,
            changed=take.started,
            size_bytes=figures.get("bytes", 0),
            duration_s=figures.get("seconds"),
            frames=figures.get("frames"),
            frames_per_s=figures.get("frames_per_s"),
            lost={**figures.get("missing", {}), **figures.get("dropped", {})},
            streams={},
            scene=None,
            notes=[],
        )

    @classmethod
    def kept(cls, take: Take) -> Self:
        """Describe a recording on the disk."""
        facts = take.facts or {}
        return cls(
            id=take.id,
            state=take.state,
            detail=take.detail,
            changed=datetime.fromtimestamp(take.changed_ns / 1e9, UTC),
            size_bytes=take.size_bytes,
            duration_s=facts.get("duration_s"),
            frames=facts.get("frames"),
            frames_per_s=facts.get("frames_per_s"),
            lost={},
            streams={
                topic: Stream(messages=figures["messages"], size_bytes=figures["bytes"])
                for topic, figures in facts.get("streams", {}).items()
            },
            scene=facts.get("scene"),
            notes=[note.replace(str(take.path), take.id) for note in facts.get("notes", [])],
        )


@router.get("")
def list_recordings(shared: Shared) -> list[RecordingAnswer]:
    """List all recordings, those that grow first, then the newest first."""
    growing = shared.recorder.running()
    names = {take.id for take in growing}
    kept = [RecordingAnswer.kept(take) for take in shared.takes.all(growing=names)]
    return [RecordingAnswer.growing(take) for take in growing] + kept


@router.post("", status_code=201, responses=responses(409, 422, 503))
def start_recording(
    shared: Shared,
    response: Response,
    wanted: Annotated[NewRecording, AS_SENT, Body(examples=[{"name": "two-lamps", "duration_s": 20}])],
) -> RecordingAnswer:
    """Begin to record a node, with the active scene attached; events tell how far it is."""
    order = checked(NewRecording, wanted, "the recording")
    active = shared.store.scenes.active()
    scene = None if active is None else active.document
    take = shared.recorder.start(order.name, order.node, order.duration_s, scene)
    response.headers["Location"] = f"/api/v1/recordings/{take.id}"
    return RecordingAnswer.growing(take)


@router.get("/{recording_id}", responses=responses(404))
def get_recording(shared: Shared, recording_id: RecordingId) -> RecordingAnswer:
    """Return what is known of a recording."""
    growing = _growing(shared, recording_id)
    return (
        RecordingAnswer.kept(shared.takes.get(recording_id))
        if growing is None
        else RecordingAnswer.growing(growing)
    )


@router.post("/{recording_id}/stop", responses=responses(404, 409, 422))
def stop_recording(shared: Shared, recording_id: RecordingId) -> RecordingAnswer:
    """End a recording; 409 where no frame had come, so that there is none."""
    shared.recorder.stop(recording_id)
    return RecordingAnswer.kept(shared.takes.get(recording_id))


@router.post("/{recording_id}/recover", responses=responses(404, 409, 422))
def recover_recording(shared: Shared, recording_id: RecordingId) -> RecordingAnswer:
    """Mend an interrupted recording: all frames that can be read, finished."""
    _require_at_rest(shared, recording_id)
    return RecordingAnswer.kept(shared.takes.recover(recording_id))


@router.get(
    "/{recording_id}/content", response_class=KeptFile, responses=responses(404, 409, 416) | DOWNLOAD_ANSWER
)
def download_recording(shared: Shared, recording_id: RecordingId) -> KeptFile:
    """Download the .mcap file; ranges of it too."""
    _require_at_rest(shared, recording_id)
    take = shared.takes.get(recording_id)
    if take.state == "interrupted":
        raise ConflictError(f"{take.id} was interrupted; recover it, then download it.")
    return KeptFile(take.path, media_type="application/octet-stream", filename=take.path.name)


@router.get(
    "/{recording_id}/poster.jpg",
    response_class=KeptFile,
    responses=responses(404, 409, 422) | POSTER_ANSWER,
)
def recording_poster(shared: Shared, recording_id: RecordingId) -> KeptFile:
    """Return the first colour picture, at most 640 pixels wide or high."""
    _require_at_rest(shared, recording_id)
    return KeptFile(shared.takes.poster(recording_id), media_type="image/jpeg")


@router.delete("/{recording_id}", status_code=204, responses=responses(404, 409))
def delete_recording(shared: Shared, recording_id: RecordingId) -> None:
    """Delete a recording for good; not one that grows or is shown."""
    _require_at_rest(shared, recording_id)
    if shared.playback.recording == recording_id:
        raise ConflictError(f"{recording_id} is being replayed; go back to live, then delete it.")
    shared.takes.remove(recording_id)


def recording_event(takes: TakeShelf, take: RunningTake, *, is_growing: bool) -> dict[str, Any]:
    """What events tell of a recording while it grows, and at its end."""
    if is_growing:
        return RecordingAnswer.growing(take).model_dump()
    try:
        ended = RecordingAnswer.kept(takes.get(take.id))
    except DeltalightError:  # no frame had come
        return {**RecordingAnswer.growing(take).model_dump(), "deleted": True}
    return {**ended.model_dump(), "detail": take.detail or ended.detail}


def _growing(shared: Context, recording_id: str) -> RunningTake | None:
    return next((take for take in shared.recorder.running() if take.id == recording_id), None)


def _require_at_rest(shared: Context, recording_id: str) -> None:
    if _growing(shared, recording_id) is not None:
        raise ConflictError(f"{recording_id} is still being recorded; stop it first.")
