"""A relighting method, as the registry and plugins know it (docs/plugins.md).

Light to import: processes that have no OpenGL load plugins too.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Generic

from protocol.scene_objects import SceneObject
from render_server.methods.settings import ResolvedSettings, Settings, Setup

if TYPE_CHECKING:
    from render_server.frame import FrameResources
    from render_server.graph import Graph
    from render_server.methods.lighting import Layers


def keep_defaults(_settings: object, defaults: ResolvedSettings) -> ResolvedSettings:
    """Resolves settings that leave everything to the machine."""
    return defaults


@dataclass(frozen=True)
class RelightingMethod(Generic[Settings]):
    """A way to find the change of light.

    Attributes:
        settings: model of the scene document's `method`; its `name` is the method's.
        declare: declares the method's stages in a graph and returns what is composed.
        resolve: fills in what the settings leave open, from the machine's defaults.
        state_memory: a sentence on the memory that it takes; raises DeltalightError beyond the settings' budget.
        require: raises DeltalightError for an object that the method cannot show.
    """

    settings: type[Settings]
    declare: "Callable[[Graph, FrameResources, Setup[Settings]], Layers]"
    resolve: Callable[[Settings, ResolvedSettings], ResolvedSettings] = keep_defaults
    state_memory: Callable[[Settings, ResolvedSettings], str] | None = None
    require: Callable[[SceneObject], None] | None = None
