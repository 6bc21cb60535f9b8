"""Counted things in sentences."""


def counted(count: int, noun: str) -> str:
    """Returns a number with its noun: `1 frame`, `2 frames`; for nouns whose plural is formed with an s."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"
