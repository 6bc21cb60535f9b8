"""The demo, small, and what skips tests that count arithmetic where something is missing."""

import shutil

import pytest

from deltalight.benchmarks.speed.counting_shaders import TOOLS
from deltalight.benchmarks.speed.motions import STANDING, SWING, Take
from deltalight.protocol.source import open_source
from deltalight.sensor_node.view_frames import ViewFrameBuilder
from deltalight.services.demo import RECORDING

MISSING_TOOLS = [tool for tool in TOOLS if shutil.which(tool) is None]
needs_tools = pytest.mark.skipif(
    bool(MISSING_TOOLS),
    reason=f"not installed: {', '.join(MISSING_TOOLS)} (packages {', '.join(TOOLS.values())})",
)
needs_demo = pytest.mark.skipif(
    not RECORDING.is_file(), reason="the demo's recording is not in this checkout"
)


METHOD = "paper:volume_size=32,rsm_size=128"
SIZE = (80, 60)  # no power of two (CONTRIBUTING.md)


def small_take(size: tuple[int, int]) -> Take:
    source = open_source(RECORDING)
    builder = ViewFrameBuilder(source)
    return Take(*([builder(source[number]) for number in numbers[:2]] for numbers in (STANDING, SWING))).at(
        size
    )
