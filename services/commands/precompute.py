"""`deltalight precompute`: what a scene wants precomputed of its objects, before it is shown."""

from pathlib import Path
from typing import Annotated

import typer


def precompute(
    scene: Annotated[Path, typer.Argument(help="Scene document; its assets lie as it names them.")],
) -> None:
    """Compute the light transfer and the occlusion fields of a scene's objects, so that no picture waits for them.

    What is in the cache already is not computed again; Ctrl-C keeps the objects that are done.
    """
    from deltalight.protocol.scene import load_scene
    from deltalight.render_server.precomputed import precompute_scene

    def notify(sentence: str) -> None:
        typer.echo(sentence, err=True)

    for line in precompute_scene(load_scene(scene), notify):
        typer.echo(line)
