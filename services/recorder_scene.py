"""The scene document of a render server."""

import uuid

from protocol.errors import DeltalightError
from protocol.keys import Keys
from protocol.messages import ControlRequest
from protocol.scene import SceneDocument, parse_scene
from protocol.transport import RequestClient

TIMEOUT_S = 5.0


def scene_of_server(endpoint: str, keys: Keys | None) -> SceneDocument:
    """Request the scene document from the render server at a control endpoint.

    Raises:
        DeltalightError: it does not answer, or its answer is no scene document.
    """
    client = RequestClient(endpoint, keys=keys)
    try:
        request = ControlRequest(node="recorder", id=uuid.uuid4().hex, op="get_scene")
        reply = client.request(request, TIMEOUT_S)
    finally:
        client.close()
    scene = reply.payload.get("scene")
    if reply.error is not None or not isinstance(scene, dict):
        raise DeltalightError(
            f"{endpoint} gives no scene document ({reply.error}); name the control endpoint of a render server."
        )
    return parse_scene(scene, f"the scene of {endpoint}")
