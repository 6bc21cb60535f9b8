"""All precomputed data of a renderer's objects; computes those that a scene document asks for."""

from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

import numpy as np

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.scene import SceneDocument
from deltalight.protocol.scene_method import AroofMethod
from deltalight.protocol.scene_objects import SceneObject
from deltalight.render_server.geometry_state import PlacedObject
from deltalight.render_server.precomputation.light_transfers import (
    ObjectTransfers,
    require_rigid_transfer,
    transfer_settings,
)
from deltalight.render_server.precomputation.occlusion_fields import (
    OcclusionFields,
    field_settings,
    require_rigid,
)
from deltalight.render_server.scene.mesh_loading import load_mesh
from deltalight.render_server.scene.triangle_mesh import TriangleMesh
from deltalight.render_server.virtual_objects import given_material


class Precomputed:
    """Occlusion fields (method aroof) and transfer (shading `precomputed`) of objects."""

    def __init__(self, notify: Callable[[str], None], *, waits: bool = True) -> None:
        self.fields = OcclusionFields(notify, waits=waits)
        self.transfers = ObjectTransfers(notify, waits=waits)

    def stop_waiting(self) -> None:
        """From now on, computes in the background."""
        self.fields.waits = self.transfers.waits = False

    def release(self) -> None:
        """Cancels all jobs; threads end at their next step."""
        self.fields.release()
        self.transfers.release()


def precompute_scene(scene: SceneDocument, notify: Callable[[str], None]) -> Iterator[str]:
    """Computes the data of visible objects that are not in the cache, with a progress bar; yields a line for each.

    Raises:
        DeltalightError: the scene asks for nothing precomputed, an object changes its shape, or its asset cannot be
            used.
    """
    items = [item for item in scene.objects if item.visible]
    aroof = scene.method if isinstance(scene.method, AroofMethod) else None
    if aroof is None and not scene.shading.is_precomputed:
        raise DeltalightError(
            "the scene asks for nothing precomputed; give it `shading: {name: precomputed}` or the method aroof."
        )
    for item in items:
        if scene.shading.is_precomputed:
            require_rigid_transfer(item)
        if aroof is not None:
            require_rigid(item)
    own, meshes = Precomputed(notify), cache(lambda asset: tuple(load_mesh(Path(asset))))
    for item in items:
        placed = _unplaced(item, meshes(item.asset))
        if scene.shading.is_precomputed:
            made = own.transfers.find(placed, transfer_settings(scene.shading))
            if made is not None:
                count, coefficients, _ = made.transfer.shape
                yield f"object `{item.id}`: light transfer of {count} vertices, {coefficients} coefficients"
        if aroof is not None and own.fields.find(placed, field_settings(aroof)) is not None:
            yield f"object `{item.id}`: occlusion field of {aroof.shells} shells"


def _unplaced(item: SceneObject, meshes: tuple[TriangleMesh, ...]) -> PlacedObject:
    """The object as precomputation needs it, wherever it stands."""
    given = None if item.material is None else given_material(item.material)
    return PlacedObject(item.id, meshes, np.eye(4), given)
