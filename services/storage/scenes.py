"""Scenes: documents whose every change is a permanent revision."""

import secrets
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from deltalight.protocol.documents import parse_mapping
from deltalight.protocol.scene import DIGEST_PREFIX, SceneDocument
from deltalight.services.storage.assets import AssetNames
from deltalight.services.storage.database import Database, remembered
from deltalight.services.storage.documents import Edit, checked_document, require_revision
from deltalight.services.storage.faults import ConflictError, NotFoundError
from deltalight.services.storage.tables import AssetUseRow, ChoiceRow, RevisionRow, SceneRow

ACTIVE = "active_scene"
FIRST_REVISION = 1


@dataclass(frozen=True)
class SceneHead:
    """The newest revision of a scene, without its document."""

    id: str
    name: str
    revision: int
    created_ns: int
    changed_ns: int
    is_active: bool


@dataclass(frozen=True)
class StoredScene:
    """A scene at one revision (`document.revision`), and whether it can be undone and redone."""

    head: SceneHead
    document: SceneDocument
    what: str
    can_undo: bool
    can_redo: bool


@dataclass(frozen=True)
class Revision:
    """One change; `what` names it for the user."""

    number: int
    at_ns: int
    what: str
    name: str
    gesture: str | None


class SceneStore:
    """The scenes of a store; which of them is active is a matter of the `room`, None = of a single one.

    `rooms` are all rooms that scenes may be active in.
    """

    def __init__(self, database: Database, room: str | None = None, rooms: Sequence[str] = ()) -> None:
        self._database = database
        self._key = _active_key(room)
        self._keys = {self._key, *map(_active_key, rooms)}

    @contextmanager
    def _reading(self) -> Iterator[Session]:
        with self._database.reading() as session:
            session.info[ACTIVE] = self._key
            yield session

    @contextmanager
    def _writing(self) -> Iterator[Session]:
        with self._database.writing() as session:
            session.info[ACTIVE] = self._key
            yield session

    def create(self, document: object, what: str = "created") -> StoredScene:
        """Stores a new scene; its revisions begin at 1.

        Raises:
            DeltalightError: the document is wrong or names an asset that was not uploaded.
        """
        with self._writing() as session:
            added = self._add(session, document, what)
        return self._noted(added)

    def get(self, scene_id: str) -> StoredScene:
        """Returns the newest revision of a scene.

        Raises:
            NotFoundError: there is no such scene.
        """
        return self._database.answer((self, scene_id), partial(self._get, scene_id))

    def _get(self, scene_id: str) -> StoredScene:
        with self._reading() as session:
            return _stored(session, _scene(session, scene_id), _newest(session, scene_id))

    def _noted(self, newest: StoredScene) -> StoredScene:
        """Notes what reads would answer after a change."""
        scene_id = newest.head.id
        self._database.note((self, scene_id), newest, partial(self._get, scene_id))
        if newest.head.is_active:
            active: StoredScene | None = newest
            self._database.note((self, None), active, self._active)
        return newest

    @remembered
    def revision(self, scene_id: str, number: int) -> StoredScene:
        """Returns a scene as it was at a revision.

        Raises:
            NotFoundError: there is no such scene or revision.
        """
        with self._reading() as session:
            scene = _scene(session, scene_id)
            row = session.get(RevisionRow, (scene_id, number))
            if row is None:
                raise NotFoundError(f"the scene has no revision {number}; list its revisions.")
            return _stored(session, scene, row)

    @remembered
    def all(self) -> list[SceneHead]:
        """Returns all scenes, in the order of their creation."""
        newest = select(RevisionRow.scene_id, func.max(RevisionRow.number).label("number"))
        heads = newest.group_by(RevisionRow.scene_id).subquery()
        query = (
            select(SceneRow, RevisionRow)
            .join(heads, heads.c.scene_id == SceneRow.id)
            .join(
                RevisionRow,
                (RevisionRow.scene_id == heads.c.scene_id) & (RevisionRow.number == heads.c.number),
            )
            .where(SceneRow.deleted_ns.is_(None))
            .order_by(SceneRow.created_ns, SceneRow.id)
        )
        with self._reading() as session:
            active = _active_id(session)
            return [_head(scene, row, active) for scene, row in session.execute(query)]

    @remembered
    def history(self, scene_id: str, before: int | None, limit: int) -> list[Revision]:
        """Returns up to `limit` revisions below `before`, the newest first.

        Raises:
            NotFoundError: there is no such scene.
        """
        query = select(RevisionRow).where(RevisionRow.scene_id == scene_id)
        if before is not None:
            query = query.where(RevisionRow.number < before)
        with self._reading() as session:
            _scene(session, scene_id)
            rows = session.scalars(query.order_by(RevisionRow.number.desc()).limit(limit))
            return [Revision(row.number, row.at_ns, row.what, row.name, row.gesture) for row in rows]

    def change(
        self, scene_id: str, edit: Edit, what: str, expected: int | None = None, gesture: str | None = None
    ) -> StoredScene:
        """Adds a revision that `edit` makes from the newest one; an edit that changes nothing adds none.

        One undo takes back all consecutive changes with the same `gesture`.

        Raises:
            NotFoundError: there is no such scene.
            StaleRevisionError: `expected` is not the newest revision.
            DeltalightError: the changed document is wrong.
        """
        with self._writing() as session:
            scene, newest = _scene(session, scene_id), _newest(session, scene_id)
            require_revision(expected, newest.number)
            current = _document(session, newest)
            edited = checked_document(edit(current.model_dump(mode="json")), newest.number)
            document = edited.with_assets(AssetNames(session).resolved)
            if document == current:
                return _stored(session, scene, newest, current)
            changed = document.replaced(revision=newest.number + 1)
            is_continued = gesture is not None and gesture == newest.gesture
            before = newest.before if is_continued else newest.origin
            added = _added(session, scene, _row(scene_id, changed, what, before, gesture), changed)
        return self._noted(added)

    def undo(self, scene_id: str, expected: int | None = None) -> StoredScene:
        """Adds a revision that restores the state before the last change.

        Raises:
            ConflictError: there is nothing to undo; or as `change`.
        """

        def step(session: Session, newest: RevisionRow) -> RevisionRow:
            shown = _origin(session, newest)
            if shown.before is None:
                raise ConflictError(
                    "there is nothing to undo; the scene has not changed since it was created."
                )
            return _shown_again(
                newest, _revision(session, newest.scene_id, shown.before), "undo", newest.number
            )

        return self._step(scene_id, expected, step)

    def redo(self, scene_id: str, expected: int | None = None) -> StoredScene:
        """Adds a revision that restores what the last undo took back.

        Raises:
            ConflictError: there is nothing to redo; or as `change`.
        """

        def step(session: Session, newest: RevisionRow) -> RevisionRow:
            if newest.redo is None:
                raise ConflictError("there is nothing to redo; only undone changes can be redone.")
            undone = _revision(session, newest.scene_id, newest.redo)
            return _shown_again(newest, _origin(session, undone), "redo", undone.redo)

        return self._step(scene_id, expected, step)

    def duplicate(self, scene_id: str, name: str | None = None) -> StoredScene:
        """Stores a copy of the newest revision as a new scene.

        Raises:
            NotFoundError: there is no such scene.
        """
        with self._writing() as session:
            _scene(session, scene_id)
            document = _document(session, _newest(session, scene_id)).model_dump(mode="json")
            document["name"] = f"{document['name']} (copy)".lstrip()[-200:] if name is None else name
            added = self._add(session, document, f"copied from {scene_id}")
        return self._noted(added)

    def delete(self, scene_id: str, expected: int | None = None) -> None:
        """Deletes a scene that is not active; its revisions stay in the database.

        Raises:
            NotFoundError: there is no such scene.
            ConflictError: it is active, or `expected` is not its newest revision.
        """
        with self._writing() as session:
            scene = _scene(session, scene_id)
            require_revision(expected, _newest(session, scene_id).number)
            choices = (session.get(ChoiceRow, key) for key in self._keys)
            if any(choice is not None and choice.value == scene_id for choice in choices):
                raise ConflictError("the scene is the active one; activate another, then delete it.")
            scene.deleted_ns = time.time_ns()

    def activate(self, scene_id: str) -> StoredScene:
        """Makes a scene the one that is rendered.

        Raises:
            NotFoundError: there is no such scene.
        """
        with self._writing() as session:
            scene = _scene(session, scene_id)
            session.merge(ChoiceRow(key=self._key, value=scene_id))
            session.flush()
            activated = _stored(session, scene, _newest(session, scene_id))
        return self._noted(activated)

    def activate_first(self, scene_id: str) -> bool:
        """Makes a scene the one that is rendered, unless one is; returns whether it was made so.

        Raises:
            NotFoundError: there is no such scene.
        """
        with self._writing() as session:
            if _active_id(session) is not None:
                return False
            session.merge(ChoiceRow(key=self._key, value=_scene(session, scene_id).id))
            return True

    def active(self) -> StoredScene | None:
        """Returns the scene that is rendered, if one was chosen."""
        return self._database.answer((self, None), self._active)

    def _active(self) -> StoredScene | None:
        with self._reading() as session:
            scene_id = _active_id(session)
            if scene_id is None:
                return None
            return _stored(session, _scene(session, scene_id), _newest(session, scene_id))

    @remembered
    def active_id(self) -> str | None:
        """Returns the id of the scene that is rendered, if one was chosen."""
        with self._reading() as session:
            return _active_id(session)

    def _add(self, session: Session, document: Any, what: str) -> StoredScene:  # noqa: ANN401 - JSON
        checked = checked_document(document, FIRST_REVISION)
        resolved = checked.with_assets(AssetNames(session).resolved)
        scene = SceneRow(id=secrets.token_hex(8), created_ns=time.time_ns())
        session.add(scene)
        session.flush()
        return _added(session, scene, _row(scene.id, resolved, what, None), resolved)

    def _step(
        self, scene_id: str, expected: int | None, step: Callable[[Session, RevisionRow], RevisionRow]
    ) -> StoredScene:
        with self._writing() as session:
            scene, newest = _scene(session, scene_id), _newest(session, scene_id)
            require_revision(expected, newest.number)
            row = step(session, newest)
            session.add(row)
            session.flush()
            shown = _stored(session, scene, row)
        return self._noted(shown)


def _added(session: Session, scene: SceneRow, row: RevisionRow, document: SceneDocument) -> StoredScene:
    session.add(row)
    session.flush()
    for digest in sorted(_digests(document)):
        if session.get(AssetUseRow, (digest, scene.id)) is None:
            session.add(AssetUseRow(digest=digest, scene_id=scene.id, number=row.number))
    session.flush()
    return _stored(session, scene, row, document)


def _digests(document: SceneDocument) -> set[str]:
    found: set[str] = set()

    def note(_place: str, asset: str) -> str:
        found.add(asset.removeprefix(DIGEST_PREFIX))
        return asset

    document.with_assets(note)
    return found


def _row(
    scene_id: str, document: SceneDocument, what: str, before: int | None, gesture: str | None = None
) -> RevisionRow:
    number = document.revision
    return RevisionRow(
        scene_id=scene_id,
        number=number,
        at_ns=time.time_ns(),
        what=what,
        name=document.name,
        document=document.canonical_json(),
        origin=number,
        before=before,
        redo=None,
        gesture=gesture,
    )


def _shown_again(newest: RevisionRow, origin: RevisionRow, what: str, redo: int | None) -> RevisionRow:
    return RevisionRow(
        scene_id=newest.scene_id,
        number=newest.number + 1,
        at_ns=time.time_ns(),
        what=what,
        name=origin.name,
        document=None,
        origin=origin.number,
        before=None,
        redo=redo,
        gesture=None,
    )


def _scene(session: Session, scene_id: str) -> SceneRow:
    scene = session.get(SceneRow, scene_id)
    if scene is None or scene.deleted_ns is not None:
        raise NotFoundError(f"there is no scene {scene_id!r:.60}; list the scenes for their ids.")
    return scene


def _newest(session: Session, scene_id: str) -> RevisionRow:
    query = select(RevisionRow).where(RevisionRow.scene_id == scene_id).order_by(RevisionRow.number.desc())
    return session.scalars(query.limit(1)).one()


def _revision(session: Session, scene_id: str, number: int) -> RevisionRow:
    return session.get_one(RevisionRow, (scene_id, number))


def _origin(session: Session, row: RevisionRow) -> RevisionRow:
    return row if row.origin == row.number else _revision(session, row.scene_id, row.origin)


def _document(session: Session, row: RevisionRow) -> SceneDocument:
    text = _origin(session, row).document
    assert text is not None
    return checked_document(parse_mapping(text, "the stored scene", is_json=True), row.number)


def _active_key(room: str | None) -> str:
    return ACTIVE if room is None else f"{ACTIVE}.{room}"


def _active_id(session: Session) -> str | None:
    """Returns the scene that is active in the session's room; one that was deleted while no such room ran is none."""
    choice = session.get(ChoiceRow, session.info[ACTIVE])
    scene = None if choice is None else session.get(SceneRow, choice.value)
    return None if scene is None or scene.deleted_ns is not None else scene.id


def _head(scene: SceneRow, row: RevisionRow, active: str | None) -> SceneHead:
    return SceneHead(scene.id, row.name, row.number, scene.created_ns, row.at_ns, scene.id == active)


def _stored(
    session: Session, scene: SceneRow, row: RevisionRow, document: SceneDocument | None = None
) -> StoredScene:
    """Describes a scene at a revision; passes its document if it is available, to avoid reading it."""
    return StoredScene(
        _head(scene, row, _active_id(session)),
        document or _document(session, row),
        row.what,
        can_undo=_origin(session, row).before is not None,
        can_redo=row.redo is not None,
    )
