"""The layout of a database: made at first, and brought up to date by Alembic's migrations in `migrations/versions`.

A revision's id is its number. Alembic is imported only where there is something to migrate: it takes 0.2 s.
"""

from pathlib import Path

from sqlalchemy import Column, Connection, MetaData, String, Table, inspect, select

from deltalight.services.storage.tables import SCHEMA_VERSION, Base

FIRST_WITH_ALEMBIC = 3  # SQLite files of older versions know nothing of it
MIGRATIONS = Path(__file__).with_name("migrations")
# As Alembic makes it.
_VERSIONS = Table("alembic_version", MetaData(), Column("version_num", String(32), primary_key=True))


def stored_version(connection: Connection) -> int:
    """Returns the version of a database's layout; 0 = it has no tables."""
    if not inspect(connection).has_table(_VERSIONS.name):
        return 0
    return int(connection.execute(select(_VERSIONS.c.version_num)).scalar_one())


def make_tables(connection: Connection) -> None:
    """Makes the tables of the newest version."""
    Base.metadata.create_all(connection)
    note_version(connection, SCHEMA_VERSION)


def note_version(connection: Connection, version: int) -> None:
    """Tells Alembic which version a database has that it does not know."""
    _VERSIONS.create(connection)
    connection.execute(_VERSIONS.insert().values(version_num=str(version)))


def migrate(connection: Connection) -> None:
    """Brings an older layout up to date, in the connection's transaction."""
    from alembic import command
    from alembic.config import Config

    config = Config()
    config.set_main_option("script_location", str(MIGRATIONS).replace("%", "%%"))
    config.attributes["connection"] = connection
    command.upgrade(config, str(SCHEMA_VERSION))
