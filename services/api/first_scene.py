"""The scene of a service that has none yet."""

import structlog

from protocol.errors import DeltalightError
from protocol.keys import Keys
from protocol.messages import ControlRequest
from protocol.scene import SceneDocument, parse_scene
from protocol.transport import RequestClient
from services.api.settings import ApiSettings
from services.host_store import FIRST_SCENE, activate_document
from services.storage.store import Store

ANSWER_TIMEOUT_S = 1.0

log = structlog.get_logger()


def make_first_scene(store: Store, settings: ApiSettings, keys: Keys | None) -> None:
    """Where no scene is active: take over what the render server shows, or begin with an empty one."""
    if store.scenes.active() is not None:
        return
    try:
        shown = _shown_scene(settings.control, keys)
        activate_document(store, shown.replaced(name=shown.name or FIRST_SCENE))
    except (DeltalightError, OSError) as fault:  # it does not run yet, or its files are another host's
        log.debug("nothing to take over from the render server", fault=str(fault))
        activate_document(store, SceneDocument(name=FIRST_SCENE))


def _shown_scene(control: str, keys: Keys | None) -> SceneDocument:
    client = RequestClient(control, keys=keys)
    try:
        reply = client.request(ControlRequest(node="api", id="first-scene", op="get_scene"), ANSWER_TIMEOUT_S)
    finally:
        client.close()
    if reply.error is not None:
        raise DeltalightError(reply.error)
    document = reply.payload.get("scene")
    if not isinstance(document, dict):
        raise DeltalightError("The render server's answer holds no scene.")
    return parse_scene(document)
