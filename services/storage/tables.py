"""The tables of the store; times are nanoseconds since 1970, UTC."""

from typing import ClassVar

from sqlalchemy import BigInteger, ForeignKey, ForeignKeyConstraint, Integer
from sqlalchemy.orm import DeclarativeBase, Mapped, mapped_column

SCHEMA_VERSION = 3  # of the newest file in migrations/versions
INTEGER = BigInteger().with_variant(Integer(), "sqlite")  # 64 bits in each database


class Base(DeclarativeBase):
    """All tables."""

    type_annotation_map: ClassVar = {int: INTEGER}


class SceneRow(Base):
    """A scene; deleting it sets `deleted_ns` and keeps its revisions."""

    __tablename__ = "scenes"

    id: Mapped[str] = mapped_column(primary_key=True)
    created_ns: Mapped[int]
    deleted_ns: Mapped[int | None] = mapped_column(default=None)


class RevisionRow(Base):
    """One revision of a scene; rows are added, never changed.

    `origin` is the revision whose document this one shows: itself, or for undo and redo (which then have no document
    of their own) an earlier one. `before` is the origin that undo goes back to, `redo` the row that redo restores.
    Consecutive revisions of one `gesture` go back to the state before the first of them.
    """

    __tablename__ = "revisions"

    scene_id: Mapped[str] = mapped_column(ForeignKey("scenes.id"), primary_key=True)
    number: Mapped[int] = mapped_column(primary_key=True)
    at_ns: Mapped[int]
    what: Mapped[str]
    name: Mapped[str]
    document: Mapped[str | None]
    origin: Mapped[int]
    before: Mapped[int | None]
    redo: Mapped[int | None]
    gesture: Mapped[str | None]


class AssetRow(Base):
    """An uploaded file; `facts` is JSON."""

    __tablename__ = "assets"

    digest: Mapped[str] = mapped_column(primary_key=True)
    kind: Mapped[str]
    format: Mapped[str]
    size_bytes: Mapped[int]
    facts: Mapped[str]
    uploaded_ns: Mapped[int]


class AssetNameRow(Base):
    """A name under which an asset was uploaded."""

    __tablename__ = "asset_names"

    digest: Mapped[str] = mapped_column(ForeignKey("assets.digest"), primary_key=True)
    name: Mapped[str] = mapped_column(primary_key=True, index=True)


class AssetUseRow(Base):
    """An asset that some revision of a scene uses, first in revision `number`."""

    __tablename__ = "asset_uses"
    __table_args__ = (
        ForeignKeyConstraint(["scene_id", "number"], ["revisions.scene_id", "revisions.number"]),
    )

    digest: Mapped[str] = mapped_column(primary_key=True)
    scene_id: Mapped[str] = mapped_column(primary_key=True)
    number: Mapped[int]


class ChoiceRow(Base):
    """A single value that outlives the process, such as the active scene."""

    __tablename__ = "choices"

    key: Mapped[str] = mapped_column(primary_key=True)
    value: Mapped[str]


class TokenRow(Base):
    """A token of the REST API, stored irreversibly."""

    __tablename__ = "tokens"

    id: Mapped[str] = mapped_column(primary_key=True)
    name: Mapped[str] = mapped_column(unique=True)
    role: Mapped[str]
    salt: Mapped[bytes]
    hash: Mapped[bytes]
    created_ns: Mapped[int]


class TicketRow(Base):
    """A single-use ticket that has not been used; `hash` is the SHA-256 of it."""

    __tablename__ = "tickets"

    hash: Mapped[bytes] = mapped_column(primary_key=True)
    role: Mapped[str]
    token_id: Mapped[str | None]
    name: Mapped[str]
    ends_ns: Mapped[int]
