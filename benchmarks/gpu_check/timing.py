"""Times of one method's frames: the one place that knows what `measure_speed` returns."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Timing:
    """Medians in milliseconds, of frames by kind and of stages by name."""

    frames_ms: dict[str, float]
    stages_ms: dict[str, float]


def time_method(method: str, frames: int, size: tuple[int, int], volume: int) -> Timing:
    """Time a method on the demo's recording; `size` in pixels, `volume` in voxels an edge.

    Raises:
        DeltalightError: no OpenGL, missing demo files, or a volume beyond the memory budget.
    """
    from benchmarks.speed import measure_speed

    report = measure_speed([method], frames, size=size, device=None, end_to_end=False, volume=volume)
    found = report["methods"][method]
    kinds = {"all": "frame_ms", "still": "still_frame_ms", "camera moves": "moving_frame_ms"}
    return Timing(
        {kind: found[key] for kind, key in kinds.items() if found[key] is not None},
        {name: stage["median_ms"] for name, stage in found["passes"].items()},
    )
