"""Lights of a glTF document (KHR_lights_punctual) at its nodes."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from deltalight.render_server.lights.light_models import DirectionalLight, Light
from deltalight.render_server.lights.punctual_light import PunctualLight
from deltalight.render_server.scene.asset_check import LIGHTS_EXTENSION
from deltalight.render_server.scene.gltf_document import GltfDocument, GltfFaultError, NodeTree

MOST_LAMPS = 64  # as a scene may list
LEAST_RANGE_M = 1e-6
_ORIGIN, _AWAY = np.zeros(3, np.float32), np.array([0, 0, -1], np.float32)
_NO_LIGHT = np.zeros(3, np.float32)


@dataclass(frozen=True, eq=False)
class GltfLamp:
    """A light in the frame of its node, which shines along -z.

    `light` is in camera units as materials' emission is: cd/m^2 times m^2 of an intensity, or an irradiance.
    """

    node: int
    light: PunctualLight | DirectionalLight

    def is_aimless(self, world_from_node: Float64[np.ndarray, "4 4"]) -> bool:
        """Whether it needs a direction, and the node's scale, 0 along z, leaves it none."""
        is_aimed = isinstance(self.light, DirectionalLight) or self.light.cone is not None
        return is_aimed and not world_from_node[:3, 2].any()

    def placed(self, world_from_node: Float64[np.ndarray, "4 4"]) -> Light:
        """Returns the light in the world, dark where it has no direction."""
        if self.is_aimless(world_from_node):
            upright = np.eye(4)
            upright[:3, 3] = world_from_node[:3, 3]
            return replace(self, light=self.light.scaled(_NO_LIGHT)).placed(upright)
        if isinstance(self.light, PunctualLight):
            return self.light.placed(world_from_node)
        axis = -world_from_node[:3, 2]
        unit = axis / max(float(np.linalg.norm(axis)), 1e-30)
        return replace(self.light, direction=unit.astype(np.float32))


def read_lamps(gltf: GltfDocument, nodes: NodeTree) -> tuple[GltfLamp, ...]:
    """Returns the lights of the nodes that are shown.

    Raises:
        GltfFaultError: a light that does not exist, of an unknown type, or with values that make
            no light; or too many.
    """
    described: Sequence[dict[str, Any]] = (
        gltf.root.get("extensions", {}).get(LIGHTS_EXTENSION, {}).get("lights", [])
    )
    lamps = []
    for node in nodes.shown:
        named = gltf.root["nodes"][node].get("extensions", {}).get(LIGHTS_EXTENSION)
        if named is not None:
            index = named["light"]
            if type(index) is not int or not 0 <= index < len(described):
                raise GltfFaultError(f"node {node} names a light that does not exist")
            lamps.append(GltfLamp(node, _light(described[index], index)))
    if len(lamps) > MOST_LAMPS:
        raise GltfFaultError(f"it has {len(lamps)} lights; at most {MOST_LAMPS} can be drawn")
    return tuple(lamps)


def dark_lamps(path: Path, lamps: Sequence[GltfLamp], nodes: NodeTree) -> str | None:
    """Returns a sentence about lights that nodes at rest leave without direction; None if there are none."""
    placed = nodes.asset_from_node(nodes.rest)
    dark = [str(lamp.node) for lamp in lamps if lamp.is_aimless(placed[lamp.node])]
    if not dark:
        return None
    return (
        f"{path} has lights that are dark while the scale of their nodes is 0 along z (node {', '.join(dark)}): "
        "they have no direction; give these nodes another scale."
    )


def _light(description: dict[str, Any], index: int) -> PunctualLight | DirectionalLight:
    name = f"its light `{description.get('name', index)}`"
    strength = float(description.get("intensity", 1.0)) * np.array(
        description.get("color", [1, 1, 1]), np.float32
    )
    range_m = float(description.get("range", math.inf))
    is_usable = (
        strength.shape == (3,)
        and np.isfinite(strength).all()
        and (strength >= 0).all()
        and range_m >= LEAST_RANGE_M
    )
    if not is_usable:
        raise GltfFaultError(f"{name} has a colour, an intensity or a range that makes no light")
    match description.get("type"):
        case "directional":
            return DirectionalLight(_AWAY, strength, 0.0)
        case "point":
            return PunctualLight(_ORIGIN, _AWAY, strength, range_m=range_m)
        case "spot":
            return PunctualLight(_ORIGIN, _AWAY, strength, *_cone(description.get("spot", {}), name), range_m)
    raise GltfFaultError(f"{name} is neither directional nor a point nor a spot")


def _cone(spot: dict[str, Any], name: str) -> tuple[float, float]:
    inner, outer = float(spot.get("innerConeAngle", 0.0)), float(spot.get("outerConeAngle", math.pi / 4))
    if not 0 <= inner < outer <= math.pi / 2 + 1e-6:
        raise GltfFaultError(
            f"{name} has an inner cone that is not within its outer one of at most 90 degrees"
        )
    return inner, min(outer, math.pi / 2)  # single precision rounds it up
