"""The session file: the scene document that a render server starts with and keeps, so that it survives a restart."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from deltalight.protocol.files import write_bytes
from deltalight.protocol.scene import SceneDocument


@contextmanager
def session_file(scene: SceneDocument) -> Iterator[Path]:
    """Yields a temporary file with the scene document, for the render server's `--session`."""
    with TemporaryDirectory(prefix="deltalight-") as folder:
        path = Path(folder) / "scene.json"
        write_scene(path, scene)
        yield path


def write_scene(path: Path, scene: SceneDocument) -> None:
    """Writes a scene document for the render server's `--session`."""
    write_bytes(path, scene.model_dump_json(indent=1).encode())
