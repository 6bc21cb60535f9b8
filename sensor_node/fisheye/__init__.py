"""Fish-eye light: exposure bracket -> linear radiance on the hemisphere (docs/method.md 2)."""

from deltalight.sensor_node.fisheye.radiance import light_warnings, radiance_map
from deltalight.sensor_node.fisheye.response import estimate_response

__all__ = ["estimate_response", "light_warnings", "radiance_map"]
