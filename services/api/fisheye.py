"""Routes of what the fish-eye camera sees: its newest picture, and where in it the composite's lights are."""

from fastapi import APIRouter, Response
from pydantic import BaseModel, Field

from protocol.messages import RadianceMessage
from services.api.context import Shared
from services.api.fisheye_lights import FisheyeLight, lights_in_picture
from services.api.live import JPEG_ANSWER, PICTURE_HEADERS
from services.api.problems import responses
from services.storage.faults import NotFoundError

router = APIRouter(tags=["live"])


class FisheyeAnswer(BaseModel):
    """The fish-eye picture's size and the lights in it; a light that it does not show is left out."""

    seen_ns: int = Field(description="When it was taken, ns since 1970 by the node's clock.")
    node: str = Field(description="The node that sees it.")
    width: int = Field(description="Of the picture, pixels.")
    height: int
    clipped_share: float = Field(description="Of what it sees, what was too bright to be measured.")
    lights: list[FisheyeLight]


@router.get("/fisheye", responses=responses(404))
def fisheye(shared: Shared) -> FisheyeAnswer:
    """Return what the fish-eye camera sees: the size of its picture, and the places of the lights in it."""
    message, _ = _newest(shared)
    frame = shared.live.newest
    height, width = message.picture_shape[:2]
    return FisheyeAnswer(
        seen_ns=message.capture_ns,
        node=message.node,
        width=width,
        height=height,
        clipped_share=message.clipped_share,
        lights=lights_in_picture(message, () if frame is None else frame.message.lights),
    )


@router.get("/fisheye.jpg", response_class=Response, responses={**responses(404), **JPEG_ANSWER})
def fisheye_picture(shared: Shared) -> Response:
    """Return the newest fish-eye picture."""
    return Response(_newest(shared)[1], media_type="image/jpeg", headers=PICTURE_HEADERS)


def _newest(shared: Shared) -> tuple[RadianceMessage, bytes]:
    newest = shared.fisheye.newest
    if newest is None:
        raise NotFoundError(
            "no node has sent light of a fish-eye camera; docs/fisheye.md tells how to set one up."
        )
    return newest
