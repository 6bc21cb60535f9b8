"""Selects the relighting method, with its settings, for a scene document's `method`."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from protocol.scene_method import AroofMethod, DifferentialMethod, DlpvMethod, DvctMethod, Method, NoneMethod
from protocol.scene_objects import SceneObject
from render_server.frame import FrameResources
from render_server.graph import Graph
from render_server.methods.aroof import aroof
from render_server.methods.differential import differential
from render_server.methods.dvct import dvct_exact, dvct_paper
from render_server.methods.lighting import Layers
from render_server.methods.lpv import dlpv
from render_server.methods.settings import (
    JOINT_RSM_SIZE,
    ResolvedSettings,
    Setup,
    resolve_aroof,
    resolve_dlpv,
    resolve_voxel_cones,
)
from render_server.occlusion_fields import OcclusionFields, require_rigid
from render_server.passes.voxels import DIRECTIONS, memory_statement

Declare = Callable[[Graph, FrameResources, Setup[Any]], Layers]


@dataclass(frozen=True)
class MethodChoice:
    """A method with checked settings and memory. `remark`: a sentence for the user, or none."""

    settings: Any
    resolved: ResolvedSettings
    declare: Declare
    remark: str | None = None

    @property
    def composition(self) -> Literal["ratio", "additive"]:
        """How the change of light is composed with the picture."""
        composition: Literal["ratio", "additive"] = self.settings.resolved_composition
        return composition

    def require(self, objects: Sequence[SceneObject]) -> None:
        """Refuses visible objects that the method cannot render.

        Raises:
            DeltalightError: an object's shape may change, but the method precomputes it.
        """
        if isinstance(self.settings, AroofMethod):
            for item in objects:
                if item.visible:
                    require_rigid(item)

    def setup(self, picture_size: tuple[int, int], fields: OcclusionFields) -> Setup[Any]:
        """Returns what the method's stages are declared with, for pictures of this size."""
        return Setup(self.settings, self.resolved, picture_size, fields)


def choose_method(method: Method, *, software: bool) -> MethodChoice:
    """Selects the method that the document requests; `none` draws the objects as dvct does.

    Raises:
        DeltalightError: the method exceeds its memory budget.
    """
    settings = DvctMethod() if isinstance(method, NoneMethod) else method
    if isinstance(settings, DlpvMethod):
        return MethodChoice(settings, resolve_dlpv(settings, software=software), dlpv)
    if isinstance(settings, AroofMethod):
        return MethodChoice(settings, resolve_aroof(settings, software=software), aroof)
    if isinstance(settings, DifferentialMethod):
        resolved = resolve_voxel_cones(settings, software=software, rsm_size=JOINT_RSM_SIZE)
        remark = memory_statement(resolved.volume_size, DIRECTIONS, settings.memory_budget_mb)
        return MethodChoice(settings, resolved, differential, remark)
    exact = settings.operator == "exact"
    resolved = resolve_voxel_cones(settings, software=software)
    remark = memory_statement(resolved.volume_size, DIRECTIONS if exact else 1, settings.memory_budget_mb)
    return MethodChoice(settings, resolved, dvct_exact if exact else dvct_paper, remark)
