"""Which rooms and hosts are drained: a value of the database, which outlives the keeper of rooms."""

import json
from dataclasses import dataclass

from deltalight.services.storage.database import Database
from deltalight.services.storage.tables import ChoiceRow

_KEY = "drained"


@dataclass(frozen=True)
class Drained:
    """Names of rooms that are not started, and of hosts that get no rooms."""

    rooms: frozenset[str] = frozenset()
    hosts: frozenset[str] = frozenset()


class DrainedStore:
    """The drained rooms and hosts of a store."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def load(self) -> Drained:
        """Returns what was kept last.

        Raises:
            StorageFaultError: the database does not answer.
        """
        with self._database.reading() as session:
            row = session.get(ChoiceRow, _KEY)
        if row is None:
            return Drained()
        found = json.loads(row.value)
        return Drained(frozenset(found["rooms"]), frozenset(found["hosts"]))

    def keep(self, drained: Drained) -> None:
        """Stores it in place of the last.

        Raises:
            StorageFaultError: the database does not answer.
        """
        value = json.dumps({"rooms": sorted(drained.rooms), "hosts": sorted(drained.hosts)})
        with self._database.writing() as session:
            session.merge(ChoiceRow(key=_KEY, value=value))
