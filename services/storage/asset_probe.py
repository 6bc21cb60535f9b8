"""Loading an untrusted file once, in a limited child process, before anything else may load it."""

from pathlib import Path

from protocol.errors import DeltalightError
from services.storage.asset_child import MEMORY_LIMIT_BYTES, Facts, run_limited
from services.storage.asset_kinds import AssetKind


def probe(path: Path, kind: AssetKind, name: str, *, memory_bytes: int = MEMORY_LIMIT_BYTES) -> Facts:
    """Load a file in a child process and return what is known of it then.

    A mesh has `triangles`, `vertices`, `minimum` and `maximum` (in the file's own units and axes, at rest), and the
    `clips` (`name`, `duration_s`) that it can play; a map has `width` and `height` in pixels. `name` stands for the
    file in sentences.

    Raises:
        RejectedAssetError: it cannot be loaded, or not within the limits.
    """
    return run_limited(kind, path, name, memory_bytes=memory_bytes)


def mesh_facts(path: Path) -> Facts:
    """Load a mesh (in the child).

    Raises:
        DeltalightError: what is wrong with it.
    """
    from render_server.scene.asset_check import check_mesh_file, read_gltf

    if check_mesh_file(path) == ".glb":
        read_gltf(path)  # a file that lies is refused before the loader's second of imports
    import numpy as np

    from render_server.scene.mesh_loading import load_asset

    asset = load_asset(path)
    meshes, clips = asset.meshes, () if asset.animated is None else asset.animated.clips
    bounds = np.stack([mesh.bounds() for mesh in meshes])
    return {
        "triangles": sum(len(mesh.triangles) for mesh in meshes),
        "vertices": sum(len(mesh.positions) for mesh in meshes),
        "minimum": bounds[:, 0].min(axis=0).tolist(),
        "maximum": bounds[:, 1].max(axis=0).tolist(),
        "clips": [{"name": clip.name, "duration_s": clip.duration_s} for clip in clips],
    }


def map_facts(path: Path) -> Facts:
    """Load an environment map (in the child).

    Raises:
        DeltalightError: what is wrong with it.
    """
    from protocol.radiance_files import read_linear

    height, width = read_linear(path).shape[:2]
    if width != 2 * height:
        raise DeltalightError(
            f"{path} has {width}x{height} pixels; a latitude-longitude map is twice as wide as high."
        )
    return {"width": width, "height": height}
