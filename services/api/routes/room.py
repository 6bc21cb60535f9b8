"""Route of the real room: its mesh, for views from elsewhere than the camera."""

from pathlib import Path
from tempfile import TemporaryDirectory

from fastapi import Response

from deltalight.protocol.pictures import read_bytes
from deltalight.services.api.api_router import api_router
from deltalight.services.api.context import Shared, in_pool
from deltalight.services.api.problems import ProblemError, responses, unavailable
from deltalight.services.api.routes.live import NO_ANSWER, PICTURE_HEADERS

TIMEOUT_S = 15.0  # some frames of the slowest renderer, and the file
GLB_TYPE = "model/gltf-binary"

router = api_router(tags=["live"])
ROUTERS = (router,)


@router.get(
    "/live/room.glb",
    response_class=Response,
    responses={**responses(422, 502), **unavailable(NO_ANSWER), 200: {"content": {GLB_TYPE: {}}}},
)
@in_pool("render server")
def room(shared: Shared) -> Response:
    """Return the render server's model of the real scene: a mesh textured with the newest picture.

    Metres, y up (the world's z). Objects and lights are not in it.
    """
    with TemporaryDirectory(prefix=".room-", dir=shared.store.folder) as folder:
        path = Path(folder) / "room.glb"
        shared.link.command("room", {"file": str(path)}, TIMEOUT_S)
        if not path.is_file():
            raise ProblemError(
                502, "no-room", "The render server wrote no file into the data folder; run it on this host."
            )
        return Response(read_bytes(path), media_type=GLB_TYPE, headers=PICTURE_HEADERS)
