"""`deltalight demo`: the whole path on loopback from the shipped recording."""

from pathlib import Path
from typing import Annotated

import typer

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.method_names import require_method
from deltalight.services.child import NODE, SERVER, WEB, ending_spares, fork_spares
from deltalight.services.commands.options import MethodName
from deltalight.services.garbage_collection import no_garbage_collection
from deltalight.services.ports import PAGE_PORT, require_free
from deltalight.services.warm_spare import SHARED, prepare


def demo(
    *,
    headless: Annotated[
        bool,
        typer.Option(
            "--headless", help="Without the dashboard: write pictures, a contact sheet and a video to --out."
        ),
    ] = False,
    frames: Annotated[
        int, typer.Option(min=1, max=100_000, help="Number of pictures of a headless demo.")
    ] = 30,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Output folder of a headless demo.")] = None,
    method: MethodName = "dvct",
    no_browser: Annotated[bool, typer.Option("--no-browser", help="Do not open a browser.")] = False,
    port: Annotated[int, typer.Option(min=1, max=65535, help="Port of the dashboard.")] = PAGE_PORT,
    as_json: Annotated[bool, typer.Option("--json", help="Print a headless demo's summary as JSON.")] = False,
) -> None:
    """Play the shipped recording through node, render server and web process, and open the dashboard."""
    method = require_method(method)
    if headless:
        _write(method, frames, out, as_json=as_json)
        return
    if out is not None or as_json:
        raise DeltalightError("--out and --json are for a headless demo; add --headless, or leave them out.")
    require_free(port, "dashboard", "--port")
    prepare(SHARED)
    early = fork_spares({SERVER: "server", NODE: "replay"})  # they need not wait for the storage's libraries
    with no_garbage_collection():
        from deltalight.services.live_demo import run_live

    with ending_spares(fork_spares({WEB: "api"}, early)) as spares:
        run_live(method, port=port, with_browser=not no_browser, spares=spares)


def _write(method: str, frames: int, out: Path | None, *, as_json: bool) -> None:
    if out is None:
        raise DeltalightError("A headless demo writes files; give a folder for them with --out.")
    prepare(SHARED)
    with no_garbage_collection():
        from deltalight.services.files import make_output_folder
        from deltalight.services.headless_demo import run_headless

    make_output_folder(out)
    with ending_spares(fork_spares({SERVER: "server", NODE: "node"})) as spares:
        run_headless(method, frames, out, as_json=as_json, spares=spares)
