"""CURVE keys (CurveZMQ, ZeroMQ RFC 26): a key pair for each host and the public keys that it trusts, in a folder.

NAME.key_secret     this host's own secret key, readable by its owner only
NAME.key            its public key, for other hosts to trust
trusted/NAME.key    public key of another host that is trusted
trusted/NAME.allow  what that host may send (rights.py); without it, everything
"""

import os
import re
import shutil
import stat
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory

import zmq.auth
from pydantic import Field

from deltalight.protocol.documents import StrictModel, nearest
from deltalight.protocol.endpoints import Endpoint, parse_endpoint
from deltalight.protocol.errors import DeltalightError

PUBLIC, SECRET = ".key", ".key_secret"
TRUSTED = "trusted"
CREATE_HINT = "run `deltalight keys create NAME`"
TRUST_HINT = "copy the other host's public key (NAME.key) here and run `deltalight keys trust NAME.key`"
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}")
# Permission bits that let anybody but the owner access a secret key.
_OTHERS = stat.S_IRWXG | stat.S_IRWXO


@dataclass(frozen=True)
class Keys:
    """This host's key pair (Z85 text as bytes) and the folder of trusted public keys.

    The folder is read on each use, so that trust can change without a restart. `on_loopback`: connections within this
    host use keys too.
    """

    name: str
    public: bytes
    secret: bytes = field(repr=False)
    folder: Path
    on_loopback: bool = False

    def trusted(self) -> dict[str, bytes]:
        """Returns the trusted public keys and the own one, by name."""
        return {**trusted_keys(self.folder), self.name: self.public}

    def peer(self, endpoint: Endpoint) -> bytes:
        """Returns the public key of the host behind an endpoint.

        That is the one that the endpoint names; without a name, the own key on loopback, else the only other one.

        Raises:
            DeltalightError: no such key is trusted, or several are and no name selects one.
        """
        trusted = self.trusted()
        if endpoint.peer is not None:
            return self._named(endpoint.peer, endpoint, trusted)
        if not endpoint.leaves_host:
            return self.public
        others = [name for name in trusted if name != self.name]
        if len(others) != 1:
            names = ", ".join(others)
            advice = f"write tcp://NAME@HOST:PORT with one of {names}" if others else TRUST_HINT
            raise DeltalightError(
                f"{endpoint.address} needs the key of its host, and {len(others)} are trusted; {advice}."
            )
        return trusted[others[0]]

    def _named(self, name: str, endpoint: Endpoint, trusted: dict[str, bytes]) -> bytes:
        if name not in trusted:
            hint = nearest(name, trusted)
            known = f"the nearest trusted name is {hint}, else {TRUST_HINT}" if hint else TRUST_HINT
            raise DeltalightError(f"no key of `{name}` is trusted for {endpoint.address}; {known}.")
        return trusted[name]


class KeySettings(StrictModel):
    """Which keys a process uses."""

    name: str | None = Field(
        default=None,
        description="This host's key pair (`deltalight keys create NAME`); null = the only one there is.",
    )
    folder: Path | None = Field(
        default=None, description="Folder of the keys; null = `keys` in the user's configuration folder."
    )
    on_loopback: bool = Field(
        default=False, description="Also use keys between processes of this host, and at the end of a tunnel."
    )

    def load(self, endpoints: Iterable[str]) -> Keys | None:
        """Returns the keys that a process with these endpoints uses, None if it needs none.

        Raises:
            DeltalightError: keys are required but missing, or they cannot be used.
        """
        parts = [parse_endpoint(endpoint) for endpoint in endpoints]
        if not any(part.needs_keys or (self.on_loopback and part.is_tcp) for part in parts):
            return None
        folder = self.folder or key_folder()
        first = next((part.address for part in parts if part.needs_keys), parts[0].address)
        return load_keys(self.name, folder, purpose=first, on_loopback=self.on_loopback)


def config_home() -> Path:
    """Returns the user's configuration folder of Deltalight (XDG base directory specification)."""
    return Path(os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config") / "deltalight"


def key_folder() -> Path:
    """Returns the default folder of keys."""
    return config_home() / "keys"


def create_keys(name: str, folder: Path) -> tuple[Path, Path]:
    """Creates a key pair; returns the public and the secret file.

    Raises:
        DeltalightError: the name is wrong or taken, or the folder cannot be written.
    """
    _check_name(name)
    public, secret = folder / f"{name}{PUBLIC}", folder / f"{name}{SECRET}"
    if public.exists() or secret.exists():
        raise DeltalightError(
            f"{folder} has keys called `{name}`; choose another name, or remove them first."
        )
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        # A temporary folder is private, so that others can read the secret key at no time.
        with TemporaryDirectory(dir=folder, prefix=".new-") as closed:
            made_public, made_secret = map(Path, zmq.auth.create_certificates(closed, name))
            made_secret.chmod(0o600)
            made_public.chmod(0o644)
            made_secret.replace(secret)
            made_public.replace(public)
    except OSError as error:
        raise DeltalightError(
            f"keys cannot be written to {folder} ({error.strerror}); name another folder."
        ) from error
    return public, secret


def load_keys(name: str | None, folder: Path, *, purpose: str = "this", on_loopback: bool = False) -> Keys:
    """Reads a key pair of this host: the one called `name`, or the only one.

    Raises:
        DeltalightError: there is none or several, or others can read the secret file.
    """
    own = own_keys(folder)
    if name is None and len(own) > 1:
        raise DeltalightError(f"{folder} has the keys {', '.join(own)}; say which with `name` of [keys].")
    if (name is None and not own) or (name is not None and name not in own):
        raise DeltalightError(
            f"{purpose} needs keys and {folder} has none{f' called `{name}`' if name else ''}; {CREATE_HINT}."
        )
    chosen = name or own[0]
    path = folder / f"{chosen}{SECRET}"
    if path.stat().st_mode & _OTHERS:
        raise DeltalightError(
            f"others can read the secret key {path}; run `chmod 600 {path}`, or make a new one."
        )
    public, secret = _read(path)
    if secret is None:
        raise DeltalightError(f"{path} holds no secret key; {CREATE_HINT}.")
    return Keys(chosen, public, secret, folder, on_loopback)


def trust(file: Path, folder: Path, name: str | None = None) -> Path:
    """Trusts another host's public key; returns the path where it is stored.

    Raises:
        DeltalightError: the file holds no public key or a secret one, or another key has the name.
    """
    if not file.is_file():
        raise DeltalightError(f"{file} is not a file; {TRUST_HINT}.")
    public, secret = _read(file)
    if secret is not None:
        raise DeltalightError(f"{file} holds a secret key, which stays on its host; give its {PUBLIC} file.")
    chosen = name or file.name.removesuffix(PUBLIC)
    _check_name(chosen)
    kept = folder / TRUSTED / f"{chosen}{PUBLIC}"
    if kept.is_file() and _read(kept)[0] != public:
        raise DeltalightError(f"another key is trusted as `{chosen}`; give --name, or remove {kept} first.")
    try:
        kept.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        shutil.copyfile(file, kept)
    except OSError as error:
        raise DeltalightError(f"{kept} cannot be written ({error.strerror}); name another folder.") from error
    return kept


def own_keys(folder: Path) -> list[str]:
    """Returns the names of the key pairs in a folder."""
    return sorted(path.name.removesuffix(SECRET) for path in folder.glob(f"*{SECRET}"))


def trusted_keys(folder: Path) -> dict[str, bytes]:
    """Returns the trusted public keys of a folder by name; files without one are left out."""
    found = {}
    for path in sorted((folder / TRUSTED).glob(f"*{PUBLIC}")):
        try:
            found[path.name.removesuffix(PUBLIC)] = _read(path)[0]
        except DeltalightError:
            continue
    return found


def _read(path: Path) -> tuple[bytes, bytes | None]:
    """Returns public and secret key of a file in pyzmq's form."""
    try:
        return zmq.auth.load_certificate(path)
    except (OSError, ValueError) as error:
        raise DeltalightError(
            f"{path} is not a key file; give one that `deltalight keys create` made."
        ) from error


def _check_name(name: str) -> None:
    if not _NAME.fullmatch(name):
        raise DeltalightError(
            f"`{name}` is not a valid name for keys; use letters, digits, - and _, and begin with a letter or digit."
        )
