"""Scenes lit by DLPV, and the light that its volumes are given."""

from typing import Any

import numpy as np
from jaxtyping import Float64

from deltalight.protocol.scene import SceneDocument
from deltalight.protocol.scene_method import DlpvMethod
from deltalight.render_server.graph import Graph
from deltalight.render_server.passes.lpv import LOBE
from deltalight.render_server.renderer import SceneRenderer

INJECTED_STEPS = 2**20  # a unit of injected light, as shaders/common/light_cells.glsl has it
AT_EVERY_PIXEL: dict[str, Any] = {"name": "dlpv", "volume_edge_m": 0.6, "query_scale": 1, "rsm_size": 256}


def dlpv(document: SceneDocument, **settings: object) -> SceneDocument:
    """The document with this method, queried at every pixel."""
    return document.replaced(method=DlpvMethod.model_validate({**AT_EVERY_PIXEL, **settings}))


def graph_of(renderer: SceneRenderer) -> Graph:
    assert renderer.graph is not None
    return renderer.graph


def injected_flux(graph: Graph, name: str) -> Float64[np.ndarray, "z y x 3"]:
    """Of each cell of the first volume, W in the picture's units."""
    placement = graph["volume"].placement
    sums = np.frombuffer(graph[name][0].read(), np.int32).reshape((*(placement.size,) * 3, 3, 4))
    return np.asarray(sums[..., 0] / INJECTED_STEPS * np.pi / LOBE[0] * placement.voxel_edge**2)
