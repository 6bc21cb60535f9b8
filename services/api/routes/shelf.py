"""Routes of the shelf: objects that every service has."""

from typing import Annotated

from fastapi import Path, Response
from pydantic import BaseModel, Field

from deltalight.services.api.api_router import api_router
from deltalight.services.api.context import Shared, in_pool
from deltalight.services.api.models import AssetAnswer
from deltalight.services.api.problems import responses
from deltalight.services.api.routes.assets import KEPT_ANSWERS, announced
from deltalight.services.storage.shelf import SHELF

router = api_router("/shelf", tags=["assets"])
ROUTERS = (router,)


class ShelfAnswer(BaseModel):
    """A ready-made object."""

    name: str = Field(examples=["chrome-ball"])
    label: str = Field(description="Name to display.", examples=["Chrome ball"])
    file_name: str = Field(description="Name of the resulting asset.", examples=["Chrome ball.glb"])
    clip: str | None = Field(description="Clip to play; null if it has none.")


@router.get("")
def list_shelf() -> list[ShelfAnswer]:
    """List the ready-made objects that every service has: a few models, and simple shapes."""
    return [
        ShelfAnswer(name=each.name, label=each.label, file_name=each.file_name, clip=each.clip)
        for each in SHELF.values()
    ]


@router.post("/{item}", status_code=201, responses={**KEPT_ANSWERS, **responses(404)})
@in_pool("assets")
def take_from_shelf(
    shared: Shared,
    response: Response,
    item: Annotated[str, Path(description="Its `name`.", examples=["chrome-ball"])],
) -> AssetAnswer:
    """Create an asset from a ready-made object, for use in scenes; 200 if it already exists."""
    asset, is_new = shared.store.assets.take_from_shelf(item)
    return announced(shared, asset, response, is_new=is_new)
