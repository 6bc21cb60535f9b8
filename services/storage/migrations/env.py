"""Run by Alembic: migrates the connection that `schema.migrate` hands over."""

from alembic import context

from deltalight.services.storage.tables import Base

context.configure(connection=context.config.attributes["connection"], target_metadata=Base.metadata)
with context.begin_transaction():
    context.run_migrations()
