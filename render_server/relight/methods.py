"""Which class relights for a scene document's `method`, and with what settings."""

from dataclasses import dataclass
from typing import Literal

from protocol.errors import DeltalightError
from protocol.scene_method import DlpvMethod, DvctMethod, Method, NoneMethod
from render_server.gpu.context import GpuContext
from render_server.passes.volume import memory_statement
from render_server.relight.defaults import ResolvedSettings, resolve_dlpv, resolve_dvct
from render_server.relight.dlpv import Dlpv
from render_server.relight.dvct import DvctExact
from render_server.relight.dvct_base import DvctBase
from render_server.relight.dvct_paper import DvctPaper
from render_server.relight.relight_base import RelightBase

OPERATORS: dict[str, type[DvctBase]] = {"exact": DvctExact, "paper": DvctPaper}


@dataclass(frozen=True)
class MethodChoice:
    """A method whose settings and memory were checked. `remark`: a sentence for the user, or none."""

    settings: DvctMethod | DlpvMethod
    resolved: ResolvedSettings
    remark: str | None

    @property
    def composition(self) -> Literal["ratio", "additive"]:
        """How the delta meets the picture."""
        return self.settings.resolved_composition

    def make(self, gpu: GpuContext, size: tuple[int, int]) -> RelightBase:
        """Make the method for pictures of this size."""
        if isinstance(self.settings, DlpvMethod):
            return Dlpv(gpu, self.settings, self.resolved, size)
        return OPERATORS[self.settings.operator](gpu, self.settings, self.resolved, size)


def choose_method(method: Method, *, software: bool) -> MethodChoice:
    """Check what the document asks for; `none` draws the objects as dvct does.

    Raises:
        DeltalightError: a method of a later release, or more memory than its budget.
    """
    settings = DvctMethod() if isinstance(method, NoneMethod) else method
    if isinstance(settings, DlpvMethod):
        return MethodChoice(settings, resolve_dlpv(settings, software=software), None)
    if not isinstance(settings, DvctMethod):
        raise DeltalightError(f"method `{settings.name}` arrives with a later release: use dvct or dlpv.")
    resolved = resolve_dvct(settings, software=software)
    directions = OPERATORS[settings.operator].directions
    remark = memory_statement(resolved.volume_size, directions, settings.memory_budget_mb)
    return MethodChoice(settings, resolved, remark)
