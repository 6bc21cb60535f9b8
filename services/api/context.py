"""What the routes share: the store, the link to the render server, and how a request names a revision."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated

from fastapi import Depends, Header, Response
from starlette.requests import HTTPConnection

from services.api.camera_finder import CameraFinder
from services.api.events import EventHub
from services.api.fisheye_view import FisheyeView
from services.api.live_hub import LiveHub
from services.api.metrics import Metrics
from services.api.models import SceneAnswer
from services.api.playback import Playback
from services.api.problems import ProblemError, Problems
from services.api.process_watch import ProcessWatch
from services.api.render_link import RenderLink
from services.api.settings import ApiSettings
from services.api.snapshot_shelf import SnapshotShelf
from services.api.take_recorder import TakeRecorder
from services.api.take_shelf import TakeShelf
from services.api.tickets import TicketBox
from services.storage.documents import Edit
from services.storage.scenes import StoredScene
from services.storage.store import Store

_GESTURE = re.compile(r"[A-Za-z0-9_-]{1,64}")
_ENTITY_TAG = re.compile(r'(?:W/)?"([0-9]{1,18})"|([0-9]{1,18})')


@dataclass(frozen=True)
class Terms:
    """Under which a change is made: `expected` is the revision that it is made to (None = the newest), `gesture`
    joins changes that one undo takes back."""

    expected: int | None
    gesture: str | None


@dataclass(frozen=True)
class Context:
    """The parts that routes use."""

    store: Store
    link: RenderLink
    events: EventHub
    live: LiveHub
    fisheye: FisheyeView
    watch: ProcessWatch
    cameras: CameraFinder
    tickets: TicketBox
    takes: TakeShelf
    recorder: TakeRecorder
    playback: Playback
    snapshots: SnapshotShelf
    settings: ApiSettings
    problems: Problems
    metrics: Metrics

    def change(self, scene_id: str, edit: Edit, what: str, terms: Terms, response: Response) -> SceneAnswer:
        """Change a scene, show it where it is the active one, and describe it."""
        scene = self.store.scenes.change(scene_id, edit, what, terms.expected, terms.gesture)
        return self.answer(scene, response, changed=True)

    def answer(self, scene: StoredScene, response: Response, *, changed: bool = False) -> SceneAnswer:
        """Describe a scene, with its revision as entity tag; after a change everybody hears of it first."""
        if changed:
            self._tell(scene)
        picture = self.link.show(scene) if changed and scene.head.is_active else self.link.picture
        response.headers["ETag"] = f'"{scene.document.revision}"'
        return SceneAnswer.of(scene, picture if picture and picture.scene_id == scene.head.id else None)

    def _tell(self, scene: StoredScene) -> None:
        head = scene.head
        body = {"id": head.id, "revision": head.revision, "name": head.name, "what": scene.what}
        self.events.publish("scene", {**body, "active": head.is_active})


def _context(connection: HTTPConnection) -> Context:
    context = connection.app.state.context
    assert isinstance(context, Context)
    return context


def _if_match(
    if_match: Annotated[
        str | None,
        Header(
            description='Revision that the change is made to, such as "7"; another one is refused with 409.',
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


def _terms(
    expected: Annotated[int | None, Depends(_if_match)],
    gesture: Annotated[
        str | None,
        Header(
            alias="Deltalight-Gesture",
            description="Any id; changes in a row with the same one are undone together.",
            examples=["drag-17"],
            json_schema_extra={"pattern": f"^{_GESTURE.pattern}$"},
        ),
    ] = None,
) -> Terms:
    if gesture is not None and not _GESTURE.fullmatch(gesture):
        raise ProblemError(
            400, "gesture", "Deltalight-Gesture must be 1 to 64 letters, digits, dashes or underscores."
        )
    return Terms(expected, gesture)


Shared = Annotated[Context, Depends(_context)]
Expected = Annotated[int | None, Depends(_if_match)]
OnTerms = Annotated[Terms, Depends(_terms)]


def with_revision_of(document: object, terms: Terms) -> Terms:
    """The terms of a change; without If-Match the `revision` that the document itself carries is expected."""
    revision = document.get("revision") if isinstance(document, Mapping) else None
    if terms.expected is not None or not isinstance(revision, int) or isinstance(revision, bool):
        return terms
    return replace(terms, expected=revision)
