"""Tickets, which any of several web processes takes."""

import sqlalchemy as sa
from alembic import op

from deltalight.services.storage.tables import INTEGER

revision = "3"
down_revision = "2"


def upgrade() -> None:
    """Makes the table of tickets."""
    op.create_table(
        "tickets",
        sa.Column("hash", sa.LargeBinary, primary_key=True),
        sa.Column("role", sa.String, nullable=False),
        sa.Column("token_id", sa.String),
        sa.Column("name", sa.String, nullable=False),
        sa.Column("ends_ns", INTEGER, nullable=False),
    )
