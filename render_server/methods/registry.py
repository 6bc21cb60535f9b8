"""Selects the relighting method, with its settings, for a scene document's `method`."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from deltalight.protocol.array_checks import kind_of
from deltalight.protocol.methods import PLUGINS
from deltalight.protocol.plugins import Plugin, blamed
from deltalight.protocol.quality import Quality
from deltalight.protocol.scene_method import DvctMethod, MethodSettings, NoneMethod
from deltalight.protocol.scene_objects import SceneObject
from deltalight.protocol.scene_output import Shading
from deltalight.render_server.frame import FrameResources
from deltalight.render_server.graph import Graph, Resource
from deltalight.render_server.methods.aroof import AROOF
from deltalight.render_server.methods.differential import DIFFERENTIAL
from deltalight.render_server.methods.dvct import DVCT
from deltalight.render_server.methods.image_based import image_based_radiance
from deltalight.render_server.methods.lpv import DLPV
from deltalight.render_server.methods.method import (
    GPU_DEFAULTS,
    SOFTWARE_DEFAULTS,
    RelightingMethod,
    ResolvedSettings,
    Setup,
)
from deltalight.render_server.methods.precomputed_transfer import precomputed_radiance
from deltalight.render_server.methods.surface_shading import Layers, layer_kinds
from deltalight.render_server.precomputation.light_transfers import ObjectTransfers, require_rigid_transfer
from deltalight.render_server.precomputation.occlusion_fields import OcclusionFields

BUILT_IN: tuple[RelightingMethod[Any], ...] = (DVCT, DLPV, AROOF, DIFFERENTIAL)
_BY_SETTINGS = {method.settings: method for method in BUILT_IN}


@dataclass(frozen=True)
class MethodChoice:
    """A method whose settings and memory were checked.

    Attributes:
        document: the settings as the scene document has them.
        settings: the same within the limits of its quality.
        shading: how objects get their light.
        remark: a sentence for the user, if any.
        relights_real: the real scene changes too.
        plugin: the plugin that the method comes from, unless it is the project's own.
    """

    method: RelightingMethod[Any]
    document: MethodSettings
    settings: MethodSettings
    resolved: ResolvedSettings
    shading: Shading = field(default_factory=Shading)
    remark: str | None = None
    relights_real: bool = field(default=True, compare=False)
    plugin: Plugin | None = None

    @property
    def keeps_world(self) -> bool:
        """Whether the real scene is kept while it explains what a moving camera sees."""
        return self.settings.tier.refresh_tiles > 0

    def in_best_quality(self, *, software: bool) -> "MethodChoice":
        """Returns the same method in the quality for frames at rest."""
        return choose_method(self.document.replaced(quality="best"), self.shading, software=software)

    @property
    def composition(self) -> Literal["ratio", "additive"]:
        """How the change of light is composed with the picture."""
        return self.settings.resolved_composition

    def require(self, objects: Sequence[SceneObject]) -> None:
        """Refuses visible objects that the method or the shading cannot render.

        Raises:
            DeltalightError: an object's shape may change, but the method or the shading precomputes it; or a plugin
                cannot look at one.
        """
        shading = require_rigid_transfer if self.shading.is_precomputed else None
        for require, plugin in ((self.method.require, self.plugin), (shading, None)):
            for item in objects:
                if item.visible and require is not None:
                    with blamed(plugin):
                        require(item)

    def setup(self, picture_size: tuple[int, int], fields: OcclusionFields) -> Setup[Any]:
        """Returns the arguments of the method's declaration, for pictures of this size."""
        return Setup(self.settings, self.resolved, picture_size, fields)

    def declare(self, graph: Graph, resources: FrameResources, setup: Setup[Any]) -> Layers:
        """Declares the method's stages.

        Raises:
            DeltalightError: a plugin cannot, or declares something else.
        """
        with blamed(self.plugin), graph.of_plugin(self.plugin):
            layers = self.method.declare(graph, resources, setup)
        if self.plugin is not None:
            _require_layers(layers, self.plugin)
        return layers

    def shaded(
        self,
        graph: Graph,
        resources: FrameResources,
        layers: Layers,
        size: tuple[int, int],
        transfers: ObjectTransfers,
    ) -> Layers:
        """Declares the shading that replaces the method's own, if any, and the light through transparent objects."""
        radiance = layers.radiance
        if self.shading.is_image_based:
            radiance = image_based_radiance(graph, resources, self.shading, size)
        elif self.shading.is_precomputed:
            radiance = precomputed_radiance(graph, resources, self.shading, size, transfers)
        if layers.transmit is not None:
            with blamed(self.plugin), graph.of_plugin(self.plugin):
                radiance = layers.transmit(radiance)
        return replace(layers, radiance=radiance)


def choose_method(
    document: MethodSettings, shading: Shading | None = None, *, software: bool
) -> MethodChoice:
    """Checks the document's settings; `none` draws the objects as dvct does. `shading` None: the method's own.

    Raises:
        DeltalightError: more memory than its budget, or a plugin that cannot be used.
    """
    if isinstance(document, NoneMethod):
        drawn = choose_method(DvctMethod(quality=document.quality), shading, software=software)
        return replace(drawn, relights_real=False, remark=None)  # `none` has no setting for the memory
    method, plugin = _registered(document)
    with blamed(plugin):
        resolved = method.resolve(document, SOFTWARE_DEFAULTS if software else GPU_DEFAULTS)
        remark = None if method.state_memory is None else method.state_memory(document, resolved)
    asked = Shading() if shading is None else shading
    return MethodChoice(method, document, document.limited(), resolved, asked, remark, plugin=plugin)


def _require_layers(layers: object, plugin: Plugin) -> None:
    """Checks what a plugin declared, and has the graph check what its stages will return for it.

    Raises:
        DeltalightError: it is no `Layers`, or holds something else than resources.
    """
    if not isinstance(layers, Layers):
        raise plugin.fault(f"its `declare` returns {kind_of(layers)}, not Layers")
    for name, kind in layer_kinds().items():
        resource = getattr(layers, name)
        if resource is None and hasattr(Layers, name):  # what may be left out
            continue
        if not isinstance(resource, Resource):
            raise plugin.fault(f"`{name}` of its Layers is {kind_of(resource)}, not a Resource")
        resource.kind = kind


class MethodChooser:
    """Chooses methods, and caches the last choice: while an object is dragged, every frame asks for the same."""

    def __init__(self, *, software: bool) -> None:
        self._software = software
        self._last: tuple[object, MethodChoice] | None = None  # and what was asked for

    def choose(self, document: MethodSettings, shading: Shading | None, quality: Quality) -> MethodChoice:
        """Returns `choose_method` of the document at that quality."""
        asked = document, shading, quality
        if self._last is None or self._last[0] != asked:
            wanted = document.replaced(quality=quality)
            self._last = asked, choose_method(wanted, shading, software=self._software)
        return self._last[1]


def _registered(settings: MethodSettings) -> tuple[RelightingMethod[Any], Plugin | None]:
    """The method that has such settings, and the plugin that it comes from."""
    built_in = _BY_SETTINGS.get(type(settings))
    if built_in is not None:
        return built_in, None
    installed = PLUGINS.values[settings.method_name()]
    if not isinstance(installed.value, RelightingMethod):
        raise installed.plugin.fault("it names no RelightingMethod")
    return installed.value, installed.plugin
