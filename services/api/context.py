"""What the routes share: the service's parts, and the revision that a request expects."""

import re
from collections.abc import Callable, Coroutine, Mapping
from dataclasses import dataclass, field, replace
from functools import partial, wraps
from typing import Annotated, Any, ParamSpec, TypeVar

from fastapi import Depends, Header, Response
from starlette.requests import HTTPConnection

from deltalight.services.api.camera_finder import CameraFinder
from deltalight.services.api.credentials import Tickets
from deltalight.services.api.events import EventHub
from deltalight.services.api.fisheye import FisheyeView
from deltalight.services.api.heard_jobs import HeardJobs
from deltalight.services.api.limits import StreamLimits
from deltalight.services.api.live_hub import LiveHub
from deltalight.services.api.metrics import Metrics
from deltalight.services.api.models import SceneAnswer
from deltalight.services.api.pools import Pool, PoolName
from deltalight.services.api.problems import ProblemError, Problems
from deltalight.services.api.recording_session import RecordingSessions
from deltalight.services.api.recording_store import RecordingStore
from deltalight.services.api.recording_videos import RecordingVideos
from deltalight.services.api.render_link import RenderLink
from deltalight.services.api.replay_control import ReplayControl
from deltalight.services.api.settings import ApiSettings
from deltalight.services.api.snapshot_store import SnapshotStore
from deltalight.services.api.streams import ProcessWatch
from deltalight.services.api.whep import WhepSessions
from deltalight.services.storage.documents import Edit
from deltalight.services.storage.faults import NotFoundError
from deltalight.services.storage.scenes import StoredScene
from deltalight.services.storage.store import Store

Given = ParamSpec("Given")
Answer = TypeVar("Answer")

_GESTURE = re.compile(r"[A-Za-z0-9_-]{1,64}")
_ENTITY_TAG = re.compile(r'(?:W/)?"([0-9]{1,18})"|([0-9]{1,18})')


@dataclass(frozen=True)
class Precondition:
    """The precondition of a change: `expected` is the revision that it applies to (None = the newest).

    Consecutive changes with the same `gesture` are undone together.
    """

    expected: int | None
    gesture: str | None


@dataclass(frozen=True)
class Context:
    """The parts of the service that routes use, in one `room`; `others` are those of the other rooms."""

    store: Store
    link: RenderLink
    events: EventHub
    live: LiveHub
    fisheye: FisheyeView
    watch: ProcessWatch
    cameras: CameraFinder
    tickets: Tickets
    recordings: RecordingStore
    videos: RecordingVideos
    recording_sessions: RecordingSessions
    replay: ReplayControl
    snapshots: SnapshotStore
    settings: ApiSettings
    problems: Problems
    metrics: Metrics
    pools: Mapping[PoolName, Pool]
    streams: StreamLimits
    whep: WhepSessions
    room: str
    server_name: str  # in its render server's messages, until there is one
    heard: HeardJobs = field(default_factory=HeardJobs)
    others: list["Context"] = field(default_factory=list)

    def change(
        self, scene_id: str, edit: Edit, what: str, precondition: Precondition, response: Response
    ) -> SceneAnswer:
        """Changes a scene, shows it if it is the active one, and describes it."""
        scene = self.store.scenes.change(scene_id, edit, what, precondition.expected, precondition.gesture)
        return self.answer(scene, response, changed=True)

    def answer(self, scene: StoredScene, response: Response, *, changed: bool = False) -> SceneAnswer:
        """Describes a scene, with its revision as entity tag; announces a change to all listeners first."""
        if changed:
            self._announce(scene)
        delivery = self.link.show(scene) if changed and scene.head.is_active else self.link.delivery(scene)
        response.headers["ETag"] = f'"{scene.document.revision}"'
        return SceneAnswer.of(scene, delivery)

    def _announce(self, scene: StoredScene) -> None:
        head = scene.head
        body = {"id": head.id, "revision": head.revision, "name": head.name, "what": scene.what}
        self.events.publish("scene", {**body, "active": head.is_active})
        for other in self.others:
            is_active = other.store.scenes.active_id() == head.id
            other.events.publish("scene", {**body, "active": is_active})
            if is_active:
                other.link.look_again()


ROOM_KEY = "deltalight.room"  # of a request's scope


async def _context(connection: HTTPConnection) -> Context:
    contexts = connection.app.state.contexts
    room = connection.scope.get(ROOM_KEY, next(iter(contexts)))
    if room not in contexts:
        raise NotFoundError(f"there is no room {room!r:.80}; list the rooms for their names.")
    context = contexts[room]
    assert isinstance(context, Context)
    return context


async def _if_match(
    if_match: Annotated[
        str | None,
        Header(
            description='Revision that the change is based on, such as "7"; if it is not the current one, the '
            "change is refused with 409.",
            json_schema_extra={"pattern": rf"^({_ENTITY_TAG.pattern}|\*)$"},
        ),
    ] = None,
) -> int | None:
    if if_match is None or if_match.strip() == "*":
        return None
    match = _ENTITY_TAG.fullmatch(if_match.strip())
    if match is None:
        raise ProblemError(400, "if-match", 'If-Match must be a revision in quotes, such as "7".')
    return int(match.group(1) or match.group(2))


async def _precondition(
    expected: Annotated[int | None, Depends(_if_match)],
    gesture: Annotated[
        str | None,
        Header(
            alias="Deltalight-Gesture",
            description="Any id; consecutive changes with the same id are undone together.",
            examples=["drag-17"],
            json_schema_extra={"pattern": f"^{_GESTURE.pattern}$"},
        ),
    ] = None,
) -> Precondition:
    if gesture is not None and not _GESTURE.fullmatch(gesture):
        raise ProblemError(
            400, "gesture", "Deltalight-Gesture must be 1 to 64 letters, digits, dashes or underscores."
        )
    return Precondition(expected, gesture)


Shared = Annotated[Context, Depends(_context)]


async def _require_jobs(connection: HTTPConnection, shared: Shared) -> None:
    if connection.scope["method"] != "GET" and not shared.settings.jobs:
        raise ProblemError(
            409, "no-jobs", "This web process neither records nor replays; ask the one that does."
        )


JOBS = Depends(_require_jobs)  # of routers whose changes are for one of several web processes
ExpectedRevision = Annotated[int | None, Depends(_if_match)]
IfUnchanged = Annotated[Precondition, Depends(_precondition)]


def in_pool(
    name: PoolName,
) -> Callable[[Callable[Given, Answer]], Callable[Given, Coroutine[Any, Any, Answer]]]:
    """Runs a route, which has a parameter `shared`, in a pool of its own."""

    def pooled(route: Callable[Given, Answer]) -> Callable[Given, Coroutine[Any, Any, Answer]]:
        @wraps(route)
        async def run(*args: Given.args, **kwargs: Given.kwargs) -> Answer:
            shared = kwargs["shared"]
            assert isinstance(shared, Context)
            return await shared.pools[name].run(partial(route, *args, **kwargs))

        return run

    return pooled


def with_revision_of(document: object, precondition: Precondition) -> Precondition:
    """Returns the precondition of a change; without If-Match it expects the `revision` in the document itself."""
    revision = document.get("revision") if isinstance(document, Mapping) else None
    if precondition.expected is not None or not isinstance(revision, int) or isinstance(revision, bool):
        return precondition
    return replace(precondition, expected=revision)
