"""The process that handles an untrusted file within limits; started by `asset_sandbox`.

Run as `python -m deltalight.services.storage.asset_worker TASK PATH MEMORY_BYTES TIME_S OUTPUT_BYTES [ARGUMENT...]`;
prints one JSON object.
"""

import json
import resource
import sys
from collections.abc import Callable
from pathlib import Path

from deltalight.protocol.errors import DeltalightError, install_command
from deltalight.services.storage.asset_kinds import Facts


def _limit(memory_bytes: int, time_s: int, output_bytes: int) -> None:
    resource.setrlimit(resource.RLIMIT_AS, (memory_bytes, memory_bytes))
    resource.setrlimit(resource.RLIMIT_CPU, (time_s, time_s))
    resource.setrlimit(resource.RLIMIT_FSIZE, (output_bytes, output_bytes))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def _task(name: str) -> Callable[..., Facts]:
    """Return the function of a task; imported here, because each needs other heavy packages."""
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
    """Write the file of an object of the shelf to `path`, which has no suffix; return its facts."""
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


if __name__ == "__main__":
    _main(*sys.argv[1:])
