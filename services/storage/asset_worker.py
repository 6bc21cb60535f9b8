"""The process that handles an untrusted file within limits; started by `asset_sandbox`.

Run as `python -m deltalight.services.storage.asset_worker TASK PATH MEMORY_BYTES TIME_S OUTPUT_BYTES [ARGUMENT...]`;
prints one JSON object. Without arguments it forks such workers (`worker_forks`), which need not import again what it
has imported for their task; it opens no file of theirs itself.
"""

import json
import os
import resource
import select
import signal
import socket
import sys
from collections.abc import Callable
from contextlib import suppress
from importlib import import_module
from pathlib import Path

from deltalight.protocol.errors import DeltalightError, install_command
from deltalight.services.garbage_collection import no_garbage_collection
from deltalight.services.storage.asset_kinds import Facts

IDLE_S = 60.0  # without work; what it has imported takes 100 MB and more
REQUEST_BYTES = 1 << 16
MESH_LOADERS = ("deltalight.render_server.scene.asset_check", "deltalight.render_server.scene.mesh_loading")
# What the functions of tasks import when they are called.
IMPORTED_LATE = {
    "mesh": MESH_LOADERS,
    "map": ("deltalight.protocol.radiance_files",),
    "material": ("deltalight.render_server.scene.material_file",),
    "shelf": (*MESH_LOADERS, "trimesh.creation"),
}
GLTF = {".glb", ".gltf"}  # trimesh, which takes longest to import, loads all others


def _limit(memory_bytes: int, time_s: int, output_bytes: int) -> None:
    resource.setrlimit(resource.RLIMIT_AS, (memory_bytes, memory_bytes))
    resource.setrlimit(resource.RLIMIT_CPU, (time_s, time_s))
    resource.setrlimit(resource.RLIMIT_FSIZE, (output_bytes, output_bytes))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def _task(name: str) -> Callable[..., Facts]:
    """Returns the function of a task; imported here, because each needs other heavy packages."""
    if name == "unzip":
        from deltalight.services.storage.gltf_zip import repack

        return repack
    if name == "recording":
        from deltalight.services.storage.recording_check import check_recording

        return check_recording
    if name == "shelf":
        return _write_shelf_item
    if name.endswith("-thumbnail"):
        from deltalight.services.storage import material_thumbnails, thumbnails

        draw = {
            "mesh": thumbnails.draw_mesh,
            "map": thumbnails.draw_map,
            "material": material_thumbnails.draw_material,
        }
        return draw[name.removesuffix("-thumbnail")]
    from deltalight.services.storage.asset_facts import map_facts, material_facts, mesh_facts

    facts: dict[str, Callable[..., Facts]] = {
        "mesh": mesh_facts,
        "map": map_facts,
        "material": material_facts,
    }
    return facts[name]


def _write_shelf_item(path: Path, item: str) -> Facts:
    """Writes the file of an object of the shelf to `path`, which has no suffix; returns its facts."""
    from deltalight.services.storage.asset_facts import mesh_facts
    from deltalight.services.storage.shelf import shelf_item

    content = shelf_item(item).glb()
    named = path.with_suffix(".glb")  # by which loaders know its format
    try:
        named.write_bytes(content)
        facts = mesh_facts(named)
    finally:
        named.unlink(missing_ok=True)
    path.write_bytes(content)
    return facts


def _main(task: str, path: str, memory_bytes: str, time_s: str, output_bytes: str, *arguments: str) -> None:
    _limit(int(memory_bytes), int(time_s), int(output_bytes))
    try:
        facts = _task(task)(Path(path), *arguments)
    except DeltalightError as fault:
        facts = {"fault": str(fault)}
    except ModuleNotFoundError as fault:
        facts = {"fault": f"{path} cannot be checked without {fault.name}: {install_command('deltalight')}."}
    except MemoryError:
        facts = {"fault": f"{path} needs more than {int(memory_bytes) >> 20} MB to load; simplify it."}
    print(json.dumps(facts))


def _fork_workers(requests: socket.socket) -> None:
    """Forks a worker for each request until there has been none for a while, or nobody can send any more."""
    while True:
        if not select.select([requests], [], [], IDLE_S)[0]:
            requests.shutdown(socket.SHUT_RD)  # what was sent before is received all the same
        request, files, *_ = socket.recv_fds(requests, REQUEST_BYTES, 1)
        if not request:
            return
        folder, *words = json.loads(request)
        _prepare(words[0], Path(words[1]))
        if os.fork() == 0:
            requests.close()
            _run_forked(folder, words, files[0])
        os.close(files[0])


def _prepare(task: str, path: Path) -> None:
    with no_garbage_collection(), suppress(ImportError, DeltalightError):  # the worker says it
        _task(task)
        for name in IMPORTED_LATE.get(task, ()):
            import_module(name)
        if task in {"mesh", "mesh-thumbnail"} and path.suffix not in GLTF:
            import_module("trimesh")


def _run_forked(folder: str, words: list[str], answer: int) -> None:
    try:
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        signal.alarm(int(words[3]))  # ends it: whoever has asked waits no longer
        os.open(os.devnull, os.O_RDONLY)  # standard input was the socket
        os.dup2(answer, sys.stdout.fileno())
        os.close(answer)
        os.chdir(folder)
        _main(*words)
        sys.stdout.flush()
    finally:
        os._exit(0)


if __name__ == "__main__":
    if sys.argv[1:]:
        _main(*sys.argv[1:])
    else:
        signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # nobody waits for workers
        with socket.socket(fileno=sys.stdin.fileno()) as asked:
            _fork_workers(asked)
