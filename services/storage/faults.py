"""Refusals of the storage that callers tell apart; each is a sentence for people."""

from protocol.errors import DeltalightError


class NotFoundError(DeltalightError):
    """What was named is not there."""


class ConflictError(DeltalightError):
    """The change does not fit what is stored now."""


class StaleRevisionError(ConflictError):
    """The change was made to an older revision; `current` is the newest."""

    def __init__(self, sentence: str, current: int) -> None:
        super().__init__(sentence)
        self.current = current


class RejectedAssetError(DeltalightError):
    """An uploaded file is not what it must be."""


class TooLargeError(DeltalightError):
    """More was sent than is taken."""


class StorageFaultError(DeltalightError):
    """The disk or the database refuses."""
