"""Routes of recordings, and of the replay of one in place of the live nodes."""

from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Annotated, Any, Literal, Self, TypeVar

from fastapi import Body, Path, Query, Request, Response
from fastapi.concurrency import run_in_threadpool
from pydantic import Field, StrictBool, ValidationError

from deltalight.protocol.counts import counted
from deltalight.protocol.documents import StrictModel
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.message_fields import Name
from deltalight.sensor_node.cameras.playback import MAX_RATE, MIN_RATE
from deltalight.services.api.api_router import api_router
from deltalight.services.api.context import JOBS, Context, Shared, in_pool
from deltalight.services.api.file_response import StoredFileResponse
from deltalight.services.api.playback_client import Position
from deltalight.services.api.problems import responses
from deltalight.services.api.recording_session import RecordingSession
from deltalight.services.api.recording_store import NAME, Facts, RecordingStore, StoredRecording
from deltalight.services.api.replay_control import ReplayOrder
from deltalight.services.api.request_bodies import AS_SENT, UPLOAD_TYPE, checked, require_upload_type
from deltalight.services.storage.faults import ConflictError

router = api_router("/recordings", tags=["recordings"], dependencies=[JOBS])
replay_router = api_router("/replay", tags=["recordings"], dependencies=[JOBS])
ROUTERS = (router, replay_router)
Heard = TypeVar("Heard", bound=StrictModel)

RecordingId = Annotated[
    str,
    Path(pattern=f"^{NAME.pattern}$", description="The recording's name.", examples=["take-20261121-101500"]),
]
Rate = Annotated[
    float, Field(ge=MIN_RATE, le=MAX_RATE, description="Playback speed: recorded seconds per second.")
]
MOST_STEPS = 1_000_000
Seconds = Annotated[float, Field(ge=0, le=1e6, description="Position from the recording's first frame.")]
POSTER_ANSWER: dict[int | str, dict[str, Any]] = {
    200: {"content": {"image/jpeg": {"schema": {"type": "string", "format": "binary"}}}}
}
_UPLOAD_BODY = {
    "requestBody": {
        "required": True,
        "description": "The file itself: MCAP, or a ZIP of one dataset folder.",
        "content": {UPLOAD_TYPE: {"schema": {"type": "string", "format": "binary"}}},
    }
}
DOWNLOAD_ANSWER: dict[int | str, dict[str, Any]] = {
    200: {"content": {"application/octet-stream": {"schema": {"type": "string", "format": "binary"}}}}
}


class NewRecording(StrictModel):
    """What to record; every key has a default."""

    name: str | None = Field(
        default=None,
        max_length=64,
        description="Letters, digits, dashes and underscores; null = the current time.",
    )
    duration_s: float | None = Field(
        default=None, ge=0.1, le=86_400, description="Duration from the first frame; null = until stopped."
    )
    node: Name | None = Field(
        default=None, description="Node to record; null = the first one to send a picture."
    )
    composites: StrictBool = Field(
        default=False, description="Also keep the relit pictures, for `video.mp4`."
    )


class Stream(StrictModel):
    """The contents of one stream of a recording."""

    messages: int
    size_bytes: int = Field(description="Before compression.")


class Check(StrictModel):
    """One requirement for relighting."""

    what: Literal["depth", "pose", "light"]
    is_there: bool
    text: str = Field(description="What is available, or what to do if it is not.")


def _checklist(facts: Facts) -> list[Check]:
    depth, light = facts["depth"], facts["fisheye"]
    has_pose = facts["board"] is not None or facts["given_poses"] > 0
    return [
        Check(
            what="depth",
            is_there=depth is not None,
            text="No depth: give the scene a model of the room."
            if depth is None
            else f"Depth in {depth['frames']} of {counted(facts['frames'], 'frame')}.",
        ),
        Check(
            what="pose",
            is_there=has_pose,
            text="Poses are given."
            if facts["given_poses"]
            else "A marker board is described."
            if has_pose
            else "No marker board and no poses: objects cannot be placed.",
        ),
        Check(
            what="light",
            is_there=light is not None,
            text="No fish-eye camera: place lamps by hand."
            if light is None
            else "Light of a fish-eye camera.",
        ),
    ]


class RecordingAnswer(StrictModel):
    """A recording, finished or in progress."""

    id: str = Field(description="Its name, also in URLs.", examples=["take-20261121-101500"])
    state: Literal["waiting", "recording", "finished", "interrupted"] = Field(
        description="`waiting` = no frame has arrived yet; `interrupted` = its recorder was killed: recover it."
    )
    detail: str = Field(description="Why it cannot grow or be read, or what it lacks; else empty.")
    changed: datetime = Field(description="When it was finished; while recording, when it was started.")
    size_bytes: int
    duration_s: float | None
    frames: int | None
    frames_per_s: float | None
    composites: int = Field(description="Number of relit pictures in it.")
    lost: dict[str, int] = Field(description="Missing messages, by stream; known while recording.")
    unkept: int = Field(description="Frames left out because the disk refused them; known until it ends.")
    streams: dict[str, Stream]
    scene: str | None = Field(description="Title of the attached scene, empty if untitled; null = no scene.")
    checklist: list[Check] = Field(description="Requirements for relighting; empty while recording.")
    notes: list[str] = Field(description="Further notes.")

    @classmethod
    def growing(cls, session: RecordingSession) -> Self:
        """Describes a recording that grows."""
        figures = session.figures or {}
        return cls(
            id=session.id,
            state="recording" if session.figures else "waiting",
            detail=session.detail,
            changed=session.started,
            size_bytes=figures.get("bytes", 0),
            duration_s=figures.get("seconds"),
            frames=figures.get("frames"),
            frames_per_s=figures.get("frames_per_s"),
            composites=figures.get("composites", 0),
            lost={**figures.get("missing", {}), **figures.get("dropped", {})},
            unkept=figures.get("unkept", 0),
            streams={},
            scene=None,
            checklist=[],
            notes=[],
        )

    @classmethod
    def stored(cls, recording: StoredRecording) -> Self:
        """Describes a recording on the disk."""
        facts = recording.facts or {}
        return cls(
            id=recording.id,
            state=recording.state,
            detail=recording.detail,
            changed=datetime.fromtimestamp(recording.changed_ns / 1e9, UTC),
            size_bytes=recording.size_bytes,
            duration_s=facts.get("duration_s"),
            frames=facts.get("frames"),
            frames_per_s=facts.get("frames_per_s"),
            composites=facts.get("composites", 0),
            lost={},
            unkept=0,
            streams={
                topic: Stream(messages=figures["messages"], size_bytes=figures["bytes"])
                for topic, figures in facts.get("streams", {}).items()
            },
            scene=facts.get("scene"),
            checklist=_checklist(facts) if facts else [],
            notes=[note.replace(str(recording.path), recording.id) for note in facts.get("notes", [])],
        )

    @classmethod
    def ended(cls, recording: StoredRecording, session: RecordingSession) -> Self:
        """Describes a recording that has just ended."""
        stored, figures = cls.stored(recording), session.figures or {}
        told = {"detail": session.detail or stored.detail, "unkept": figures.get("unkept", 0)}
        return stored.model_copy(update=told)


class NewReplay(StrictModel):
    """What to show."""

    recording: str = Field(
        pattern=f"^{NAME.pattern}$", description="The recording's name.", examples=["take-20261121-101500"]
    )
    position_s: Seconds = 0.0
    playing: bool = True
    rate: Rate = 1.0
    loop: bool = Field(default=True, description="Start again at the end; false = stay there, paused.")


class ReplayChange(StrictModel):
    """What to change; everything else stays as it is."""

    position_s: Seconds | None = None
    step_frames: int | None = Field(
        default=None,
        ge=-MOST_STEPS,
        le=MOST_STEPS,
        description="Frames to step forward, or back if negative.",
    )
    playing: bool | None = None
    rate: Rate | None = None


class ReplayAnswer(StrictModel):
    """Position of the recording on display; all null = a live camera is shown."""

    recording: str | None = Field(
        description="null = the node's own frames are shown (which may come from a recording)."
    )
    position_s: float | None = None
    duration_s: float | None = None
    playing: bool | None = None
    rate: float | None = None
    loop: bool | None = None


@router.get("")
@in_pool("recordings")
def list_recordings(shared: Shared) -> list[RecordingAnswer]:
    """List all recordings: those in progress first, then newest first."""
    growing = _growing(shared)
    stored = [RecordingAnswer.stored(recording) for recording in shared.recordings.all(growing=set(growing))]
    return [*growing.values(), *stored]


@router.post("", status_code=201, responses=responses(409, 422, 503))
@in_pool("recordings")
def start_recording(
    shared: Shared,
    response: Response,
    wanted: Annotated[NewRecording, AS_SENT, Body(examples=[{"name": "two-lamps", "duration_s": 20}])],
) -> RecordingAnswer:
    """Start recording a node, with the active scene attached; events report the progress."""
    order = checked(NewRecording, wanted, "the recording")
    active = shared.store.scenes.active()
    scene = None if active is None else active.document
    session = shared.recording_sessions.start(
        order.name, order.node, order.duration_s, scene, composites=order.composites
    )
    response.headers["Location"] = f"/api/v1/recordings/{session.id}"
    return RecordingAnswer.growing(session)


@router.post(
    "/upload", status_code=201, responses=responses(400, 409, 413, 415, 422), openapi_extra=_UPLOAD_BODY
)
async def upload_recording(
    shared: Shared,
    request: Request,
    response: Response,
    name: Annotated[str, Query(max_length=1000, description="Name of the file.", examples=["desk.mcap"])],
) -> RecordingAnswer:
    """Upload an .mcap recording, or a .zip of a dataset folder, as the request body.

    It is recognised by its content and read once in a process of its own, with limits of memory, time and disk. It is
    kept under the name of the file, with a number where that is taken.
    """
    require_upload_type(request)
    settings = shared.settings
    limits = settings.recording_limit_mb << 20, settings.recording_quota_mb << 20
    store = shared.recordings
    with store.receiving(*limits) as incoming:
        async for chunk in request.stream():
            await run_in_threadpool(incoming.write, chunk)
        kept = await shared.pools["recording uploads"].run(lambda: store.keep(incoming, name))
    answer = RecordingAnswer.stored(kept)
    shared.events.publish("recording", answer.model_dump())
    response.headers["Location"] = f"/api/v1/recordings/{kept.id}"
    return answer


@router.get("/{recording_id}", responses=responses(404))
@in_pool("recordings")
def get_recording(shared: Shared, recording_id: RecordingId) -> RecordingAnswer:
    """Return the facts of a recording."""
    growing = _growing(shared).get(recording_id)
    return RecordingAnswer.stored(shared.recordings.get(recording_id)) if growing is None else growing


@router.post("/{recording_id}/stop", responses=responses(404, 409, 422, 503))
@in_pool("recordings")
def stop_recording(shared: Shared, recording_id: RecordingId) -> RecordingAnswer:
    """Stop a recording.

    409 if no frame had arrived, so that nothing was recorded; 503 if the disk refuses its end, so that it is
    `interrupted` and can be recovered.
    """
    session = shared.recording_sessions.stop(recording_id)
    return RecordingAnswer.ended(shared.recordings.get(recording_id), session)


@router.post("/{recording_id}/recover", responses=responses(404, 409, 422))
@in_pool("recordings")
def recover_recording(shared: Shared, recording_id: RecordingId) -> RecordingAnswer:
    """Recover an interrupted recording: keep all frames that can be read, and finish the file."""
    require_at_rest(shared, recording_id)
    return RecordingAnswer.stored(shared.recordings.recover(recording_id))


@router.get(
    "/{recording_id}/content",
    response_class=StoredFileResponse,
    responses=responses(404, 409, 416) | DOWNLOAD_ANSWER,
)
@in_pool("recordings")
def download_recording(shared: Shared, recording_id: RecordingId) -> StoredFileResponse:
    """Download the .mcap file; ranges are supported."""
    require_at_rest(shared, recording_id)
    recording = shared.recordings.get(recording_id)
    if recording.state == "interrupted":
        raise ConflictError(f"{recording.id} was interrupted; recover it, then download it.")
    path = recording.path
    return StoredFileResponse(path, media_type="application/octet-stream", filename=path.name)


@router.get(
    "/{recording_id}/poster.jpg",
    response_class=StoredFileResponse,
    responses=responses(404, 409, 422) | POSTER_ANSWER,
)
@in_pool("recordings")
def recording_poster(shared: Shared, recording_id: RecordingId) -> StoredFileResponse:
    """Return the first colour picture, at most 640 pixels wide or high."""
    require_at_rest(shared, recording_id)
    return StoredFileResponse(shared.recordings.poster(recording_id), media_type="image/jpeg")


@router.delete("/{recording_id}", status_code=204, responses=responses(404, 409))
@in_pool("recordings")
def delete_recording(shared: Shared, recording_id: RecordingId) -> None:
    """Delete a recording permanently, unless it is in progress or on display."""
    require_at_rest(shared, recording_id)
    if shared.replay.recording == recording_id:
        raise ConflictError(f"{recording_id} is being replayed; go back to live, then delete it.")
    shared.videos.stop(recording_id)
    shared.recordings.remove(recording_id)


@replay_router.get("", responses=responses(503))
@in_pool("replay")
def get_replay(shared: Shared) -> ReplayAnswer:
    """Return which recording is shown and its position; without one, the position in the node's own recording."""
    heard = shared.heard.replay()
    answer = None if heard is None else _as_heard(ReplayAnswer, heard)
    return answer or replay_answer(shared.replay.position())


@replay_router.put("", responses=responses(404, 409, 422, 503))
@in_pool("replay")
def start_replay(
    shared: Shared,
    wanted: Annotated[
        NewReplay, AS_SENT, Body(examples=[{"recording": "two-lamps", "position_s": 2.5, "loop": True}])
    ],
) -> ReplayAnswer:
    """Show a recording instead of the live nodes or of the current recording."""
    new = checked(NewReplay, wanted, "the replay")
    require_at_rest(shared, new.recording)
    recording = shared.recordings.get(new.recording)
    order = ReplayOrder(recording.id, recording.path, new.position_s, new.playing, new.rate, new.loop)
    return replay_answer(shared.replay.start(order))


@replay_router.patch("", responses=responses(409, 422, 503))
@in_pool("replay")
def change_replay(
    shared: Shared,
    change: Annotated[ReplayChange, AS_SENT, Body(examples=[{"position_s": 4.2, "playing": False}])],
) -> ReplayAnswer:
    """Seek, step frame by frame, pause, resume, or change the speed of the recording that `GET /replay` returns."""
    wanted = checked(ReplayChange, change, "the change")
    return replay_answer(shared.replay.change(**dict(wanted)))


@replay_router.delete("", status_code=204, responses=responses(409))
@in_pool("replay")
def end_replay(shared: Shared) -> None:
    """Show the live nodes again."""
    shared.replay.stop()


def replay_answer(position: Position | None) -> ReplayAnswer:
    """Describes where a recording is that is shown; None = a live camera is."""
    return ReplayAnswer(recording=None) if position is None else ReplayAnswer(**vars(position))


def recording_event(
    recordings: RecordingStore, session: RecordingSession, *, is_growing: bool
) -> dict[str, Any]:
    """Returns the body of the event about a recording while it grows, and at its end."""
    if is_growing:
        return RecordingAnswer.growing(session).model_dump()
    try:
        return RecordingAnswer.ended(recordings.get(session.id), session).model_dump()
    except DeltalightError:  # no frame arrived
        return {**RecordingAnswer.growing(session).model_dump(), "deleted": True}


def _growing(shared: Context) -> dict[str, RecordingAnswer]:
    """Returns the recordings in progress by name: its own, and those of the web process that records."""
    heard = [_as_heard(RecordingAnswer, body) for body in shared.heard.growing()]
    own = [RecordingAnswer.growing(session) for session in shared.recording_sessions.running()]
    return {each.id: each for each in (*heard, *own) if each is not None}


def _as_heard(model: type[Heard], body: Mapping[str, Any]) -> Heard | None:
    """Returns the answer in another web process's event; None for one of a version with other fields."""
    try:
        return model.model_validate(body)
    except ValidationError:
        return None


def require_at_rest(shared: Context, recording_id: str) -> None:
    """Refuses what needs a finished recording.

    Raises:
        ConflictError: it is still growing.
    """
    if recording_id in _growing(shared):
        raise ConflictError(f"{recording_id} is still being recorded; stop it first.")
