"""Defaults of settings that the scene document leaves open, by the machine's abilities."""

from dataclasses import dataclass
from typing import Generic, TypeVar

from protocol.scene_method import AroofMethod, DlpvMethod, VoxelConeSettings
from render_server.occlusion_fields import OcclusionFields

Settings = TypeVar("Settings")

# (software, GPU)
VOLUME_SIZE = (64, 256)
CONE_SCALE = (4, 2)
RSM_SIZE = (512, 1024)
TRIANGLE_BUDGET = (40_000, 400_000)
SHOWN_CELLS = 64  # of method aroof, for view `volume` alone
JOINT_RSM_SIZE = (1024, 2048)  # joint maps of objects and room need double resolution


@dataclass(frozen=True)
class ResolvedSettings:
    """The settings of a method whose defaults depend on the machine.

    `volume_size` is in voxels or cells per edge. Cones and volumes are evaluated at 1/`cone_scale` of the picture.
    """

    volume_size: int
    cone_scale: int
    rsm_size: int
    triangle_budget: int


@dataclass(frozen=True, eq=False)
class Setup(Generic[Settings]):
    """Arguments of a method's declaration: settings, picture size (width, height), precomputed data of objects."""

    settings: Settings
    resolved: ResolvedSettings
    picture_size: tuple[int, int]
    fields: OcclusionFields


def march_defines(settings: VoxelConeSettings) -> dict[str, int]:
    """Returns the defines that march.glsl is compiled with."""
    defines = {
        "ISOTROPIC_VOXELS": settings.voxels == "isotropic",
        "MULTIPLIED_COVERAGE": settings.coverage == "multiplied",
    }
    return {name: 1 for name, wanted in defines.items() if wanted}


def resolve_voxel_cones(
    settings: VoxelConeSettings, *, software: bool, rsm_size: tuple[int, int] = RSM_SIZE
) -> ResolvedSettings:
    """Resolves the document's values, with the machine's defaults for null."""
    column = 0 if software else 1
    return ResolvedSettings(
        settings.volume_size or VOLUME_SIZE[column],
        settings.cone_scale or CONE_SCALE[column],
        settings.rsm_size or rsm_size[column],
        settings.triangle_budget or TRIANGLE_BUDGET[column],
    )


def resolve_dlpv(settings: DlpvMethod, *, software: bool) -> ResolvedSettings:
    """Resolves the document's values, with the machine's defaults for null."""
    column = 0 if software else 1
    return ResolvedSettings(
        settings.volume_size,
        settings.query_scale or CONE_SCALE[column],
        settings.rsm_size or RSM_SIZE[column],
        settings.triangle_budget or TRIANGLE_BUDGET[column],
    )


def resolve_aroof(settings: AroofMethod, *, software: bool) -> ResolvedSettings:
    """Resolves the document's values, with the machine's defaults for null."""
    column = 0 if software else 1
    return ResolvedSettings(
        SHOWN_CELLS,
        settings.shading_scale or CONE_SCALE[column],
        settings.rsm_size or RSM_SIZE[column],
        settings.triangle_budget or TRIANGLE_BUDGET[column],
    )
