"""Changes in a row that are undone together."""

import sqlalchemy as sa
from alembic import op

revision = "2"
down_revision = "1"


def upgrade() -> None:
    """Adds the gesture of a revision."""
    op.add_column("revisions", sa.Column("gesture", sa.String))
