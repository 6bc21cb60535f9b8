"""Responses of the REST API; the documents themselves are the protocol's."""

from datetime import UTC, datetime
from typing import Any, Literal, Self

from pydantic import BaseModel, Field

from deltalight.protocol.scene import SceneDocument
from deltalight.services.api.delivery import DeliveryStatus
from deltalight.services.api.streams import Report
from deltalight.services.storage.asset_kinds import AssetKind
from deltalight.services.storage.assets import Asset
from deltalight.services.storage.scenes import Revision, SceneHead, StoredScene


class SceneSummary(BaseModel):
    """A scene in a list."""

    id: str = Field(description="Name in addresses.", examples=["4f0c2a9be1d37785"])
    name: str = Field(description="Title to display.")
    revision: int = Field(description="The newest revision.")
    created: datetime
    changed: datetime
    active: bool = Field(description="Whether this scene is being rendered.")

    @classmethod
    def of(cls, head: SceneHead) -> Self:
        """Describes a scene."""
        return cls(
            id=head.id,
            name=head.name,
            revision=head.revision,
            created=_time(head.created_ns),
            changed=_time(head.changed_ns),
            active=head.is_active,
        )


class PictureState(BaseModel):
    """What the render server made of a revision of the active scene."""

    state: Literal["shown", "pending", "refused", "superseded"] = Field(
        description="`shown` = from the next frame on; `pending` = the render server has not accepted it yet, and "
        "the event `picture` reports when it has; `refused` = it cannot render this and keeps showing "
        "the previous revision; `superseded` = a newer change was made before the server accepted "
        "this one, and is shown in its place."
    )
    revision: int = Field(description="The revision that this describes.")
    detail: str = Field(description="Why it is not shown; else empty.")

    @classmethod
    def of(cls, status: DeliveryStatus) -> Self:
        """Describes the delivery of a revision."""
        return cls(state=status.state, revision=status.revision, detail=status.detail)


class SceneAnswer(BaseModel):
    """A scene at one revision."""

    id: str = Field(description="Name in addresses.", examples=["4f0c2a9be1d37785"])
    revision: int = Field(description="The revision of the document; also the ETag.")
    created: datetime
    changed: datetime
    active: bool = Field(description="Whether this scene is being rendered.")
    what: str = Field(description="The change that created this revision.")
    can_undo: bool
    can_redo: bool
    picture: PictureState | None = Field(description="null unless the scene is active.")
    document: SceneDocument

    @classmethod
    def of(cls, scene: StoredScene, delivery: DeliveryStatus | None) -> Self:
        """Describes a scene at a revision."""
        return cls(
            id=scene.head.id,
            revision=scene.document.revision,
            created=_time(scene.head.created_ns),
            changed=_time(scene.head.changed_ns),
            active=scene.head.is_active,
            what=scene.what,
            can_undo=scene.can_undo,
            can_redo=scene.can_redo,
            picture=None if delivery is None else PictureState.of(delivery),
            document=scene.document,
        )


class RevisionEntry(BaseModel):
    """One change of a scene."""

    revision: int
    at: datetime
    what: str = Field(description="What was changed.", examples=["knot: pose changed"])
    name: str = Field(description="Title of the scene at that revision.")
    gesture: str | None = Field(description="Consecutive changes with the same id are undone together.")

    @classmethod
    def of(cls, revision: Revision) -> Self:
        """Describes a revision."""
        return cls(
            revision=revision.number,
            at=_time(revision.at_ns),
            what=revision.what,
            name=revision.name,
            gesture=revision.gesture,
        )


class AssetAnswer(BaseModel):
    """An uploaded file."""

    asset: str = Field(
        description="Reference to use in scene documents.", examples=["sha256:2c26b46b68ffc68f..."]
    )
    names: list[str] = Field(description="File names under which it was uploaded.")
    kind: AssetKind = Field(
        description="`mesh` for objects and models, `map` for environment lights, `material` for what "
        "`material: {precomputed: ...}` names."
    )
    format: str = Field(examples=["glb"])
    size_bytes: int
    uploaded: datetime
    facts: dict[str, Any] = Field(
        description="Mesh: triangles, vertices, minimum and maximum corner in the file's units and axes, and the "
        "clips that it can play (name, duration_s). Map: width and height, pixels. Material: model (measured_brdf, "
        "polynomial_texture, texture_stack), base_color, and lobes and roughness, or width and height in texels.",
        examples=[{"triangles": 1000, "vertices": 502, "minimum": [0, 0, 0], "maximum": [0.1, 0.1, 0.2]}],
    )

    @classmethod
    def of(cls, asset: Asset) -> Self:
        """Describes an asset."""
        return cls(
            asset=asset.reference,
            names=list(asset.names),
            kind=asset.format.kind,
            format=asset.format.name,
            size_bytes=asset.size_bytes,
            uploaded=_time(asset.uploaded_ns),
            facts=asset.facts,
        )


class ProcessAnswer(BaseModel):
    """What a node or render server said about itself last."""

    name: str
    state: str = Field(description="starting, running, waiting, degraded or stopping.")
    detail: str
    age_s: float = Field(description="Seconds since it reported this.")
    rates: dict[str, float] = Field(description="1/s.")
    drops: dict[str, int] = Field(description="Losses since its start, by cause.")
    clock_bound_ms: float | None = Field(
        description="Upper bound of its clock error against the server's; null = not compared."
    )

    @classmethod
    def of(cls, report: Report) -> Self:
        """Describes a report."""
        message = report.message
        bound_ns = message.clock_bound_ns
        return cls(
            name=message.node,
            state=message.state,
            detail=message.detail,
            age_s=round(report.age_s, 3),
            rates=dict(message.rates),
            drops=dict(message.drops),
            clock_bound_ms=None if bound_ns is None else bound_ns / 1e6,
        )


def _time(nanoseconds: int) -> datetime:
    return datetime.fromtimestamp(nanoseconds / 1e9, UTC)
