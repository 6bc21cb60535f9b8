"""A relighting method: its settings, resolved for this machine, and the declaration of its stages
(docs/plugins.md).

Light to import: processes that have no OpenGL load plugins too.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Generic, TypeVar

from deltalight.protocol.scene_method import MethodSettings, VoxelConeSettings
from deltalight.protocol.scene_objects import SceneObject

if TYPE_CHECKING:
    from deltalight.render_server.frame import FrameResources
    from deltalight.render_server.graph import Graph
    from deltalight.render_server.methods.surface_shading import Layers
    from deltalight.render_server.precomputation.occlusion_fields import OcclusionFields

Settings = TypeVar("Settings", bound=MethodSettings)
LEAST_VOLUME = 32  # voxels an edge
VOLUME_STEP = 8  # whose multiples have enough mip levels


@dataclass(frozen=True)
class ResolvedSettings:
    """The settings of a method whose defaults depend on the machine.

    `volume_size` is in voxels or cells per edge. Cones and volumes are evaluated at 1/`cone_scale` of the picture.
    """

    volume_size: int
    cone_scale: int
    rsm_size: int
    triangle_budget: int


SOFTWARE_DEFAULTS = ResolvedSettings(volume_size=64, cone_scale=4, rsm_size=512, triangle_budget=40_000)
GPU_DEFAULTS = ResolvedSettings(volume_size=256, cone_scale=2, rsm_size=1024, triangle_budget=400_000)


@dataclass(frozen=True, eq=False)
class Setup(Generic[Settings]):
    """Arguments of a method's declaration: settings, picture size (width, height), precomputed data of objects."""

    settings: Settings
    resolved: ResolvedSettings
    picture_size: tuple[int, int]
    fields: "OcclusionFields"


def resolve_voxel_cones(settings: VoxelConeSettings, defaults: ResolvedSettings) -> ResolvedSettings:
    """Fills in the machine's defaults where the document says null, within the limits of the quality."""
    size = settings.volume_size or defaults.volume_size
    return ResolvedSettings(
        max(int(settings.tier.volume_scale * size / VOLUME_STEP) * VOLUME_STEP, min(size, LEAST_VOLUME)),
        settings.cone_scale or defaults.cone_scale,
        settings.rsm_size or defaults.rsm_size,
        settings.triangle_budget or defaults.triangle_budget,
    )


def resolve_joint_maps(settings: VoxelConeSettings, defaults: ResolvedSettings) -> ResolvedSettings:
    """As `resolve_voxel_cones`; joint shadow maps of objects and room need twice the resolution."""
    return resolve_voxel_cones(settings, replace(defaults, rsm_size=2 * defaults.rsm_size))


def march_defines(settings: VoxelConeSettings) -> dict[str, int]:
    """Returns the defines that march.glsl is compiled with."""
    defines = {
        "ISOTROPIC_VOXELS": settings.voxels == "isotropic",
        "MULTIPLIED_COVERAGE": settings.coverage == "multiplied",
    }
    return {name: 1 for name, wanted in defines.items() if wanted}


def keep_defaults(_settings: object, defaults: ResolvedSettings) -> ResolvedSettings:
    """Returns the machine's defaults, for settings that override none."""
    return defaults


@dataclass(frozen=True)
class RelightingMethod(Generic[Settings]):
    """A method of computing how virtual objects change light.

    Attributes:
        settings: model of the scene document's `method`; its `name` is the method's.
        declare: declares the method's stages in a graph and returns what is composed.
        resolve: fills in the machine's defaults where the settings say null.
        state_memory: a sentence on the memory that it takes; raises DeltalightError beyond the settings' budget.
        require: raises DeltalightError for an object that the method cannot show.
    """

    settings: type[Settings]
    declare: "Callable[[Graph, FrameResources, Setup[Settings]], Layers]"
    resolve: Callable[[Settings, ResolvedSettings], ResolvedSettings] = keep_defaults
    state_memory: Callable[[Settings, ResolvedSettings], str] | None = None
    require: Callable[[SceneObject], None] | None = None
