"""Sizes of light propagation volumes, and the memory that they take (docs/method.md 5)."""

import math
from dataclasses import dataclass
from operator import itemgetter

from deltalight.protocol.scene_method import DlpvMethod
from deltalight.render_server.methods.method import ResolvedSettings
from deltalight.render_server.passes.lpv import (
    COVERED_BYTES,
    INJECTED_BYTES,
    JOINED_BYTES,
    LIGHT_BYTES,
    TRANSMITTED_BYTES,
)
from deltalight.render_server.passes.volumes import MOST_VOLUMES
from deltalight.render_server.passes.voxels import MEGABYTE, SLOT_BYTES, mipmap_bytes, within_budget

# Per cell of `LpvCells`: two sums each of light and of covered faces, transmittances, and grids of eight half cells.
CELL_BYTES = 2 * (INJECTED_BYTES + COVERED_BYTES + TRANSMITTED_BYTES + 8 * SLOT_BYTES)


@dataclass(frozen=True)
class PrintedSizes:
    """Cells an edge of V_rho, of V_delta, and of the direct change."""

    objects: int
    indirect: int
    direct: int

    @classmethod
    def of(cls, settings: DlpvMethod) -> "PrintedSizes":
        """Returns what the settings say."""
        size = settings.volume_size
        return cls(settings.objects_volume_size or size, size, settings.direct_volume_size or size)

    @property
    def counts(self) -> list[int]:
        """Each number of cells once."""
        return sorted({self.objects, self.indirect, self.direct})


def volumes_bytes(settings: DlpvMethod, count: int = 1) -> int:
    """Returns the bytes of `count` sets of volumes and grids; surfels come on top, as many as there are."""
    joined = 0 if count == 1 else _joined_bytes(settings)
    return count * (_set_bytes(settings) + joined)


def _joined_bytes(settings: DlpvMethod) -> int:
    """Returns the bytes of one set of volumes in the textures that surfaces read, where several are joined."""
    sizes = PrintedSizes.of(settings)
    read = [sizes.objects, sizes.indirect]
    if settings.resolved_shadow == "lobe":
        read.append(sizes.direct)
    return sum(JOINED_BYTES * n**3 for n in read)


def affordable_count(settings: DlpvMethod) -> int:
    """Returns how many sets of volumes the budget has room for; a single one that does not fit is refused."""
    budget = settings.memory_budget_mb * MEGABYTE
    counts = range(2, MOST_VOLUMES + 1)
    return max((count for count in counts if volumes_bytes(settings, count) <= budget), default=1)


def _set_bytes(settings: DlpvMethod) -> int:
    sizes = PrintedSizes.of(settings)
    common = sum(CELL_BYTES * n**3 for n in sizes.counts) + mipmap_bytes(sizes.indirect, 1)
    if settings.operator == "difference":
        return common + 2 * (LIGHT_BYTES + INJECTED_BYTES) * sizes.indirect**3
    direct_light = LIGHT_BYTES if settings.resolved_shadow == "lobe" else 0
    propagated = LIGHT_BYTES * (sizes.objects**3 + sizes.indirect**3)
    return common + propagated + (direct_light + INJECTED_BYTES) * sizes.direct**3


def state_memory(settings: DlpvMethod, _resolved: ResolvedSettings) -> str:
    """One sentence on the volumes' memory.

    Raises:
        DeltalightError: it is beyond the budget.
    """
    names = ("volume_size", "objects_volume_size", "direct_volume_size")
    size, name = max(((getattr(settings, name) or 0, name) for name in names), key=itemgetter(0))
    budget_mb, what = settings.memory_budget_mb, f"A volume set of {size}^3 cells"
    needed = within_budget(volumes_bytes(settings), what, budget_mb, f"method.{name}")
    stated = f"volume set {size}^3: {needed} MB of a budget of {budget_mb} MB"
    count = affordable_count(settings)
    if settings.volume_edge_m is not None or count == 1:
        return stated
    several_mb = math.ceil(volumes_bytes(settings, count) / MEGABYTE)
    return f"{stated}; objects far apart: up to {count} sets, {several_mb} MB"
