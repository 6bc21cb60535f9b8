"""Routes of the replay: a recording shown in place of the live nodes."""

from typing import Annotated

from fastapi import APIRouter, Body
from pydantic import Field

from protocol.documents import StrictModel
from sensor_node.cameras.playback import MAX_RATE, MIN_RATE
from services.api.bodies import AS_SENT, checked
from services.api.context import Context, Shared
from services.api.playback import Position, ReplayOrder
from services.api.problems import responses
from services.api.take_shelf import NAME
from services.storage.faults import ConflictError

router = APIRouter(tags=["recordings"], prefix="/replay")
Rate = Annotated[float, Field(ge=MIN_RATE, le=MAX_RATE, description="Recorded seconds a second.")]
Seconds = Annotated[float, Field(ge=0, le=1e6, description="From the recording's first frame.")]


class NewReplay(StrictModel):
    """What to show."""

    recording: str = Field(
        pattern=f"^{NAME.pattern}$", description="The recording's name.", examples=["take-20261121-101500"]
    )
    position_s: Seconds = 0.0
    playing: bool = True
    rate: Rate = 1.0
    loop: bool = Field(default=True, description="Begin again at the end; else it stays there, paused.")


class ReplayChange(StrictModel):
    """What is to be otherwise; the rest stays."""

    position_s: Seconds | None = None
    playing: bool | None = None
    rate: Rate | None = None


class ReplayAnswer(StrictModel):
    """Where the replay is; all null = the live nodes are shown."""

    recording: str | None
    position_s: float | None = None
    duration_s: float | None = None
    playing: bool | None = None
    rate: float | None = None
    loop: bool | None = None


@router.get("", responses=responses(503))
def get_replay(shared: Shared) -> ReplayAnswer:
    """Return which recording is shown and where it is."""
    return replay_answer(shared.playback.position())


@router.put("", responses=responses(404, 409, 422, 503))
def start_replay(
    shared: Shared,
    wanted: Annotated[
        NewReplay, AS_SENT, Body(examples=[{"recording": "two-lamps", "position_s": 2.5, "loop": True}])
    ],
) -> ReplayAnswer:
    """Show a recording instead of the live nodes, or of the recording that is shown."""
    new = checked(NewReplay, wanted, "the replay")
    _require_at_rest(shared, new.recording)
    take = shared.takes.get(new.recording)
    order = ReplayOrder(take.id, take.path, new.position_s, new.playing, new.rate, new.loop)
    return replay_answer(shared.playback.start(order))


@router.patch("", responses=responses(409, 422, 503))
def change_replay(
    shared: Shared,
    change: Annotated[ReplayChange, AS_SENT, Body(examples=[{"position_s": 4.2, "playing": False}])],
) -> ReplayAnswer:
    """Seek, pause, go on, play slower or faster."""
    wanted = checked(ReplayChange, change, "the change")
    return replay_answer(shared.playback.change(wanted.position_s, wanted.playing, wanted.rate))


@router.delete("", status_code=204)
def end_replay(shared: Shared) -> None:
    """Show the live nodes again."""
    shared.playback.stop()


def replay_answer(position: Position | None) -> ReplayAnswer:
    """Describe where a replay is."""
    return ReplayAnswer(recording=None) if position is None else ReplayAnswer(**vars(position))


def _require_at_rest(shared: Context, recording: str) -> None:
    if any(take.id == recording for take in shared.recorder.running()):
        raise ConflictError(f"{recording} is still being recorded; stop it first.")
