"""`deltalight keys`: key pairs of this host and the keys of others that it trusts."""

import json
from pathlib import Path
from typing import Annotated

import typer

from deltalight.protocol.errors import DeltalightError

keys = typer.Typer(no_args_is_help=True, help="Manage keys for connections to other hosts.")

Folder = Annotated[
    Path | None,
    typer.Option(help="Folder of the keys; default: that of `keys` in the configuration file."),
]


@keys.command()
def create(
    name: Annotated[str, typer.Argument(help="Name of the key pair, for example this host's.")],
    folder: Folder = None,
) -> None:
    """Create a key pair; the public file is for other hosts, the secret one stays here."""
    from deltalight.protocol.keys import create_keys

    public, secret = create_keys(name, _folder(folder))
    typer.echo(f"Secret key, for this host only: {secret}")
    typer.echo(f"Public key: {public}")
    typer.echo(f"Copy the public key to the other host and run there: deltalight keys trust {public.name}")


@keys.command(name="list")
def list_keys(
    folder: Folder = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the keys as JSON.")] = False,
) -> None:
    """List this host's key pairs and the keys it trusts."""
    from deltalight.protocol.keys import load_keys, own_keys, trusted_keys
    from deltalight.protocol.rights import allowed

    place = _folder(folder)
    own = {name: load_keys(name, place).public.decode() for name in own_keys(place)}
    trusted = {name: key.decode() for name, key in trusted_keys(place).items()}
    limits = {name: words for name in trusted if (words := allowed(place, name)) is not None}
    if as_json:
        allow = {name: sorted(words) for name, words in limits.items()}
        listing = {"folder": str(place), "own": own, "trusted": trusted, "allow": allow}
        typer.echo(json.dumps(listing, indent=2))
        return
    typer.echo(f"Keys in {place}")
    for title, found in (("own", own), ("trusted", trusted)):
        for name, public in found.items():
            typer.echo(f"{title:<8} {name:<24} {public}")
            if title == "trusted" and name in limits:
                typer.echo(f"{'':<8} may send only: {', '.join(sorted(limits[name])) or 'nothing'}")
        if not found:
            typer.echo(f"{title:<8} none")


@keys.command()
def trust(
    file: Annotated[Path, typer.Argument(help="Public key of the other host, NAME.key.")],
    name: Annotated[
        str | None, typer.Option(help="Name to store it under; default: the name of the file.")
    ] = None,
    folder: Folder = None,
) -> None:
    """Trust the host with this public key; takes effect at once, without a restart."""
    from deltalight.protocol.keys import trust as keep

    kept = keep(file, _folder(folder), name)
    typer.echo(f"Trusted from now on: {kept} (delete that file to stop trusting it)")


@keys.command(name="allow")
def allow_host(
    name: Annotated[str, typer.Argument(help="Name of a trusted key.")],
    words: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[STREAM]...",
            help="What that host may send: streams (color), topics (color.desk), and control for commands.",
        ),
    ] = None,
    *,
    everything: Annotated[bool, typer.Option("--everything", help="Remove the limit.")] = False,
    folder: Folder = None,
) -> None:
    """Limit what a trusted host may send here: nothing but the named streams; takes effect within a second."""
    from deltalight.protocol.keys import trusted_keys
    from deltalight.protocol.rights import allow

    place = _folder(folder)
    if name not in trusted_keys(place):
        raise DeltalightError(f"no key of `{name}` is trusted in {place}; see `deltalight keys list`.")
    if everything == bool(words):
        raise DeltalightError("name the streams that the host may send, or give --everything.")
    allow(place, name, None if everything else words)
    typer.echo(f"{name} may send {'everything' if everything else ', '.join(sorted(words or []))}.")


def _folder(given: Path | None) -> Path:
    from deltalight.protocol.keys import KeySettings, key_folder
    from deltalight.services.settings import load_configuration

    return given or load_configuration().section("keys", KeySettings).folder or key_folder()
