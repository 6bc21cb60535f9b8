"""Scenes with revisions, assets, tokens."""

import sqlalchemy as sa
from alembic import op

from deltalight.services.storage.tables import INTEGER

revision = "1"
down_revision = None


def upgrade() -> None:
    """Makes the tables of the first version."""
    op.create_table(
        "scenes",
        sa.Column("id", sa.String, primary_key=True),
        sa.Column("created_ns", INTEGER, nullable=False),
        sa.Column("deleted_ns", INTEGER),
    )
    op.create_table(
        "revisions",
        sa.Column("scene_id", sa.String, sa.ForeignKey("scenes.id"), primary_key=True),
        sa.Column("number", INTEGER, primary_key=True),
        sa.Column("at_ns", INTEGER, nullable=False),
        sa.Column("what", sa.String, nullable=False),
        sa.Column("name", sa.String, nullable=False),
        sa.Column("document", sa.String),
        sa.Column("origin", INTEGER, nullable=False),
        sa.Column("before", INTEGER),
        sa.Column("redo", INTEGER),
    )
    op.create_table(
        "choices",
        sa.Column("key", sa.String, primary_key=True),
        sa.Column("value", sa.String, nullable=False),
    )
    op.create_table(
        "tokens",
        sa.Column("id", sa.String, primary_key=True),
        sa.Column("name", sa.String, nullable=False, unique=True),
        sa.Column("role", sa.String, nullable=False),
        sa.Column("salt", sa.LargeBinary, nullable=False),
        sa.Column("hash", sa.LargeBinary, nullable=False),
        sa.Column("created_ns", INTEGER, nullable=False),
    )
    _make_assets()


def _make_assets() -> None:
    op.create_table(
        "assets",
        sa.Column("digest", sa.String, primary_key=True),
        sa.Column("kind", sa.String, nullable=False),
        sa.Column("format", sa.String, nullable=False),
        sa.Column("size_bytes", INTEGER, nullable=False),
        sa.Column("facts", sa.String, nullable=False),
        sa.Column("uploaded_ns", INTEGER, nullable=False),
    )
    op.create_table(
        "asset_names",
        sa.Column("digest", sa.String, sa.ForeignKey("assets.digest"), primary_key=True),
        sa.Column("name", sa.String, primary_key=True, index=True),
    )
    op.create_table(
        "asset_uses",
        sa.Column("digest", sa.String, primary_key=True),
        sa.Column("scene_id", sa.String, primary_key=True),
        sa.Column("number", INTEGER, nullable=False),
        sa.ForeignKeyConstraint(["scene_id", "number"], ["revisions.scene_id", "revisions.number"]),
    )
