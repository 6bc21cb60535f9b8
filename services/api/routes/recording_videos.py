"""Routes of recordings' videos, which are made in the background."""

import asyncio
import time
from functools import partial
from typing import Any

from deltalight.services.api.api_router import api_router
from deltalight.services.api.context import JOBS, Shared, in_pool
from deltalight.services.api.file_response import StoredFileResponse
from deltalight.services.api.problems import ProblemError, responses, unavailable
from deltalight.services.api.recording_videos import VideoAnswer, was_stopped
from deltalight.services.api.routes.recordings import RecordingId, require_at_rest

router = api_router("/recordings", tags=["recordings"], dependencies=[JOBS])
ROUTERS = (router,)

WAIT_S = 10.0  # for a short video; proxies give up after 30 s and more
LOOK_AGAIN_S = 0.05
RETRY_AFTER_S = 5
VIDEO_ANSWER: dict[int | str, dict[str, Any]] = {
    200: {"content": {"video/mp4": {"schema": {"type": "string", "format": "binary"}}}}
}


@router.get("/{recording_id}/video", responses=responses(404, 409, 422))
@in_pool("recordings")
def get_recording_video(shared: Shared, recording_id: RecordingId) -> VideoAnswer:
    """Return whether the video of the relit pictures is available, or its progress."""
    require_at_rest(shared, recording_id)
    return shared.videos.state(recording_id)


@router.post("/{recording_id}/video", status_code=202, responses=responses(404, 409, 422))
@in_pool("recordings")
def make_recording_video(shared: Shared, recording_id: RecordingId) -> VideoAnswer:
    """Encode the recorded relit pictures as a video (H.264) in the background, and keep it.

    The package `av` makes it (extra `video`).
    """
    require_at_rest(shared, recording_id)
    shared.videos.begin(recording_id)
    return shared.videos.state(recording_id)


@router.delete("/{recording_id}/video", status_code=204, responses=responses(404, 409))
@in_pool("recordings")
def delete_recording_video(shared: Shared, recording_id: RecordingId) -> None:
    """Stop encoding a video, or delete it; the recording stays."""
    require_at_rest(shared, recording_id)
    shared.recordings.get(recording_id)
    shared.videos.stop(recording_id)
    shared.recordings.remove_video(recording_id)


@router.get(
    "/{recording_id}/video.mp4",
    response_class=StoredFileResponse,
    responses=responses(404, 409, 416, 422) | unavailable("It is being made.") | VIDEO_ANSWER,
)
async def recording_video(shared: Shared, recording_id: RecordingId) -> StoredFileResponse:
    """Download the video of the relit pictures; ranges are supported.

    Where it is not there, it is begun. 503 with `Retry-After` comes instead if it takes longer than some seconds.
    """
    require_at_rest(shared, recording_id)
    making = await shared.pools["recordings"].run(partial(shared.videos.begin, recording_id))
    deadline_s = time.monotonic() + WAIT_S
    while not making.done():
        if time.monotonic() > deadline_s:
            progress = shared.videos.state(recording_id).progress
            sentence = f"The video of {recording_id} is being made ({progress:.0%}); try again soon."
            raise ProblemError(503, "video-is-being-made", sentence, {"Retry-After": str(RETRY_AFTER_S)})
        await asyncio.sleep(LOOK_AGAIN_S)
    if making.cancelled():
        raise was_stopped(recording_id)
    path = making.result()
    return StoredFileResponse(path, media_type="video/mp4", filename=path.name)
