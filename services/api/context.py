"""What the routes share: the store, the link to the render server, and how a request names a revision."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

from fastapi import Depends, Header, Request, Response

from services.api.metrics import Metrics
from services.api.models import SceneAnswer
from services.api.problems import ProblemError, Problems
from services.api.process_watch import ProcessWatch
from services.api.render_link import RenderLink
from services.api.settings import ApiSettings
from services.storage.scenes import StoredScene
from services.storage.store import Store

_ENTITY_TAG = re.compile(r'(?:W/)?"(\d{1,18})"|(\d{1,18})')


@dataclass(frozen=True)
class Context:
    """The parts that routes use."""

    store: Store
    link: RenderLink
    watch: ProcessWatch
    settings: ApiSettings
    problems: Problems
    metrics: Metrics

    def answer(self, scene: StoredScene, response: Response, *, changed: bool = False) -> SceneAnswer:
        """Describe a scene, with its revision as entity tag; after a change the render server gets it first."""
        if changed and scene.head.is_active:
            self.link.refresh()
        response.headers["ETag"] = f'"{scene.document.revision}"'
        picture = self.link.picture
        return SceneAnswer.of(scene, picture if picture and picture.scene_id == scene.head.id else None)


def _context(request: Request) -> Context:
    context = request.app.state.context
    assert isinstance(context, Context)
    return context


def _if_match(
    if_match: Annotated[
        str | None,
        Header(
            description='Revision that the change is made to, such as "7"; another one is refused with 409.'
        ),
    ] = None,
) -> int | None:
    if if_match is None or if_match.strip() == "*":
        return None
    match = _ENTITY_TAG.fullmatch(if_match.strip())
    if match is None:
        raise ProblemError(400, "if-match", 'If-Match must be a revision in quotes, such as "7".')
    return int(match.group(1) or match.group(2))


Shared = Annotated[Context, Depends(_context)]
Expected = Annotated[int | None, Depends(_if_match)]


def expected_revision(if_match: int | None, document: object) -> int | None:
    """The revision that a change is made to: If-Match, else the `revision` that the document itself carries."""
    if if_match is not None or not isinstance(document, Mapping):
        return if_match
    revision = document.get("revision")
    return revision if isinstance(revision, int) and not isinstance(revision, bool) else None
