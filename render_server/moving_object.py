"""An object whose asset plays a clip: its meshes at a frame's capture time."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from protocol.errors import DeltalightError
from protocol.scene_objects import Animation, SceneObject
from render_server.scene.gltf_animation import Clip
from render_server.scene.gltf_asset import GltfAsset, Pose
from render_server.scene.triangle_mesh import TriangleMesh


class MovingObject:
    """Follows one animation; `meshes` are those of the last pose, in the asset's frame."""

    def __init__(self, asset: GltfAsset, clip: Clip, animation: Animation) -> None:
        self.asset, self.animation = asset, animation
        self._clip = clip
        self._pose: Pose | None = None
        self.meshes: Sequence[TriangleMesh] = ()

    @property
    def is_still(self) -> bool:
        """Whether it shows one and the same pose for ever."""
        return self.animation.speed == 0 or self._clip.duration_s == 0

    @property
    def bounds(self) -> Float64[np.ndarray, "2 3"]:
        """Least and greatest coordinates of all that the clip shows, in the asset's frame."""
        return self.asset.bounds(self._clip)

    def follow(self, capture_ns: int) -> bool:
        """Take the pose of that time; returns whether it differs from the one before."""
        time_s = self.animation.time_s(capture_ns, self._clip.duration_s)
        pose = self.asset.pose(self._clip, time_s)
        if pose.equals(self._pose):
            return False
        self._pose = pose
        self.meshes = self.asset.meshes(pose)
        return True


def clip_of(item: SceneObject, asset: GltfAsset | None) -> Clip | None:
    """The clip that an object plays; None if it keeps its shape.

    Raises:
        DeltalightError: it names a clip that its asset does not have.
    """
    playing = item.playing
    if playing is None:
        return None
    clip = None if asset is None else asset.clip(playing.clip)
    if clip is not None or item.animation is None:
        return clip
    if asset is None or not asset.clips:
        raise DeltalightError(
            f"object `{item.id}`: {item.asset} has no animation; leave out `animation`, or export it with its clips."
        )
    names = ", ".join(f"`{each.name}`" for each in asset.clips)
    raise DeltalightError(f"object `{item.id}`: {item.asset} has no clip {playing.clip!r}; it has {names}.")
