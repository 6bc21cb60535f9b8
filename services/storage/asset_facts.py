"""Facts about a mesh or a map, found by loading it (in the worker)."""

from pathlib import Path

from protocol.errors import DeltalightError
from services.storage.asset_kinds import Facts


def mesh_facts(path: Path) -> Facts:
    """Load a mesh and return its facts.

    They are `triangles`, `vertices`, `minimum` and `maximum` (in the file's own units and axes, at rest), and the
    `clips` (`name`, `duration_s`) that it can play.

    Raises:
        DeltalightError: the file is wrong; the sentence says how.
    """
    from render_server.scene.asset_check import check_mesh_file, read_gltf

    if check_mesh_file(path) == ".glb":
        read_gltf(path)  # refuses a malformed file before the loader's second of imports
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
    """Load an environment map and return its `width` and `height` in pixels.

    Raises:
        DeltalightError: the file is wrong; the sentence says how.
    """
    from protocol.radiance_files import read_linear

    height, width = read_linear(path).shape[:2]
    if width != 2 * height:
        raise DeltalightError(
            f"{path} has {width}x{height} pixels; a latitude-longitude map is twice as wide as high."
        )
    return {"width": width, "height": height}
