"""Which class relights for a scene document's `method`, and with what settings."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from protocol.scene_method import AroofMethod, DifferentialMethod, DlpvMethod, DvctMethod, Method, NoneMethod
from protocol.scene_objects import SceneObject
from render_server.gpu.context import GpuContext
from render_server.occlusion_fields import OcclusionFields, require_rigid
from render_server.passes.volume import memory_statement
from render_server.relight.aroof import Aroof
from render_server.relight.defaults import (
    JOINT_RSM_SIZE,
    ResolvedSettings,
    resolve_aroof,
    resolve_dlpv,
    resolve_voxel_cones,
)
from render_server.relight.differential import Differential
from render_server.relight.dlpv import Dlpv
from render_server.relight.dvct import DvctExact
from render_server.relight.dvct_base import DvctBase
from render_server.relight.dvct_paper import DvctPaper
from render_server.relight.relight_base import RelightBase

OPERATORS: dict[str, type[DvctBase]] = {"exact": DvctExact, "paper": DvctPaper}


@dataclass(frozen=True)
class MethodChoice:
    """A method whose settings and memory were checked. `remark`: a sentence for the user, or none."""

    settings: DvctMethod | DlpvMethod | AroofMethod | DifferentialMethod
    resolved: ResolvedSettings
    remark: str | None

    @property
    def composition(self) -> Literal["ratio", "additive"]:
        """How the delta meets the picture."""
        return self.settings.resolved_composition

    def require(self, objects: Sequence[SceneObject]) -> None:
        """Refuse visible objects that the method cannot show.

        Raises:
            DeltalightError: an object's shape may change, and the method precomputes.
        """
        if isinstance(self.settings, AroofMethod):
            for item in objects:
                if item.visible:
                    require_rigid(item)

    def make(self, gpu: GpuContext, size: tuple[int, int], fields: OcclusionFields) -> RelightBase:
        """Make the method for pictures of this size; `fields` are what is precomputed of objects."""
        if isinstance(self.settings, AroofMethod):
            return Aroof(gpu, self.settings, self.resolved, size, fields)
        if isinstance(self.settings, DlpvMethod):
            return Dlpv(gpu, self.settings, self.resolved, size)
        if isinstance(self.settings, DifferentialMethod):
            return Differential(gpu, self.settings, self.resolved, size)
        return OPERATORS[self.settings.operator](gpu, self.settings, self.resolved, size)


def choose_method(method: Method, *, software: bool) -> MethodChoice:
    """Check what the document asks for; `none` draws the objects as dvct does.

    Raises:
        DeltalightError: more memory than its budget.
    """
    settings = DvctMethod() if isinstance(method, NoneMethod) else method
    if isinstance(settings, DlpvMethod):
        return MethodChoice(settings, resolve_dlpv(settings, software=software), None)
    if isinstance(settings, AroofMethod):
        return MethodChoice(settings, resolve_aroof(settings, software=software), None)
    if isinstance(settings, DifferentialMethod):
        resolved = resolve_voxel_cones(settings, software=software, rsm_size=JOINT_RSM_SIZE)
        directions = Differential.directions
    else:
        resolved = resolve_voxel_cones(settings, software=software)
        directions = OPERATORS[settings.operator].directions
    remark = memory_statement(resolved.volume_size, directions, settings.memory_budget_mb)
    return MethodChoice(settings, resolved, remark)
