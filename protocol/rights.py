"""What the hosts of trusted keys may send: `trusted/NAME.allow` beside `trusted/NAME.key` lists it, a word a line.

A word is a stream (`color`), a topic (`color.desk`), or `control` (commands to a render server). Without the file a
trusted host may send everything.
"""

import re
import time
from collections.abc import Collection
from contextlib import suppress
from pathlib import Path

import structlog

from deltalight.protocol.documents import nearest
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.files import write_bytes
from deltalight.protocol.keys import TRUSTED, Keys, trusted_keys
from deltalight.protocol.messages import MESSAGE_TYPES

ALLOW = ".allow"
CONTROL = "control"
STREAMS = tuple(stream for stream in MESSAGE_TYPES if stream not in ("request", "reply"))
_TOPIC = re.compile(r"([a-z_]+)\.[A-Za-z0-9][A-Za-z0-9_-]{0,63}")
_READ_AGAIN_S = 1.0
_MOST_TOLD = 64
_log = structlog.get_logger(__name__)


def allow(folder: Path, name: str, words: Collection[str] | None) -> None:
    """Limits what the host of the trusted key `name` may send to these streams, topics and `control`; None: no limit.

    Raises:
        DeltalightError: a word is none of them, or the disk refuses.
    """
    path = folder / TRUSTED / f"{name}{ALLOW}"
    if words is None:
        with suppress(FileNotFoundError):
            path.unlink()
        return
    for word in words:
        _require_known(word)
    write_bytes(path, "".join(f"{word}\n" for word in sorted(words)).encode())


def allowed(folder: Path, name: str) -> frozenset[str] | None:
    """Returns what the host of a trusted key may send; None: everything, empty if the list cannot be read."""
    try:
        return frozenset((folder / TRUSTED / f"{name}{ALLOW}").read_text(encoding="ascii").split())
    except FileNotFoundError:
        return None
    except (OSError, UnicodeDecodeError):
        return frozenset()


class Rights:
    """Decides what the hosts of keys may send; changes hold within a second. Counts and tells what they may not."""

    def __init__(self, keys: Keys) -> None:
        self.refused = 0
        self._keys = keys
        self._known: dict[bytes, tuple[float, str, frozenset[str] | None]] = {}
        self._told: set[tuple[str, str]] = set()

    def lets(self, key: bytes, word: str) -> bool:
        """Whether the host of a public key (Z85) may send a topic, or commands (`control`)."""
        name, words = self._of(key)
        if words is None or word in words or word.partition(".")[0] in words:
            return True
        self.refused += 1
        told = (name, word.partition(".")[0])
        if told not in self._told and len(self._told) < _MOST_TOLD:
            self._told.add(told)
            _log.warning("a trusted host sent what it may not", reason=refusal(name, word))
        return False

    def name_of(self, key: bytes) -> str:
        """Returns the name under which a key is trusted."""
        return self._of(key)[0]

    def _of(self, key: bytes) -> tuple[str, frozenset[str] | None]:
        read_s, name, words = self._known.get(key, (-_READ_AGAIN_S, "", None))
        if time.monotonic() - read_s >= _READ_AGAIN_S:
            name, words = self._read(key)
            self._known[key] = (time.monotonic(), name, words)
        return name, words

    def _read(self, key: bytes) -> tuple[str, frozenset[str] | None]:
        """Returns name and rights of a key; a key that is trusted no more may send nothing."""
        if key == self._keys.public:
            return self._keys.name, None
        names = [name for name, public in trusted_keys(self._keys.folder).items() if public == key]
        lists = [allowed(self._keys.folder, name) for name in names]
        if not names:
            return "a host that is trusted no more", frozenset()
        limits = [words for words in lists if words is not None]
        return names[0], None if len(limits) < len(lists) else frozenset().union(*limits)


def refusal(name: str, word: str) -> str:
    """Returns the sentence that refuses a topic, or commands."""
    what = word.partition(".")[0]
    return (
        f"the key `{name}` does not allow {word:.130}; if it should, add {what} to "
        f"`deltalight keys allow {name}` on this host"
    )


def _require_known(word: str) -> None:
    topic = _TOPIC.fullmatch(word)
    stream = topic.group(1) if topic else word
    if stream in STREAMS or word == CONTROL:
        return
    hint = nearest(stream, [*STREAMS, CONTROL])
    advice = f"the nearest is {hint}" if hint else f"use {', '.join([*STREAMS, CONTROL])}"
    raise DeltalightError(f"`{word:.60}` is not a stream, topic or `{CONTROL}`: {advice}")
