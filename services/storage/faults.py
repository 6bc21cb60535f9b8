"""Errors of the storage that callers distinguish; each is a sentence for the user."""

from deltalight.protocol.errors import DeltalightError


class NotFoundError(DeltalightError):
    """The named thing does not exist."""


class ConflictError(DeltalightError):
    """The change conflicts with what is stored."""


class StaleRevisionError(ConflictError):
    """The change was made to an older revision; `current` is the newest."""

    def __init__(self, sentence: str, current: int) -> None:
        super().__init__(sentence)
        self.current = current


class RejectedAssetError(DeltalightError):
    """An uploaded file is invalid."""


class TooLargeError(DeltalightError):
    """The upload exceeds the limit."""


class StorageFaultError(DeltalightError):
    """The disk or the database refuses."""


class DatabaseGoneError(StorageFaultError):
    """The database does not answer; it may come back."""


class OutdatedTokenError(DeltalightError):
    """A token is stored in the way of an earlier version, and has to be made again."""
