"""What a renderer keeps that shows all methods again and again: `python -m tests.render_server.method_rounds`."""

import argparse
import ctypes
import gc
import json
import tempfile
import time
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar
from unittest import mock

import psutil

from deltalight.render_server import freed_memory
from deltalight.render_server.gpu.context import GpuContext, count_gl_objects, create_context
from deltalight.render_server.renderer import SceneRenderer
from tests.render_server.protected_scenes import METHODS
from tests.render_server.scenes import Stage, everyday, frame, look_at, noisy

WIDTH = 96
MOTION_NS, REST_NS, PAUSE_NS = 50_000_000, 700_000_000, 1_000_000_000
FRAMES_AT_REST = 6
MALLINFO2 = (
    *("arena", "ordblks", "smblks", "hblks", "hblkhd"),
    *("usmblks", "fsmblks", "uordblks", "fordblks", "keepcost"),
)


class MallInfo(ctypes.Structure):
    """What glibc tells of its heap (malloc.h, struct mallinfo2), bytes."""

    _fields_: ClassVar = [(name, ctypes.c_size_t) for name in MALLINFO2]


@dataclass
class Clock:
    """Time stamps of frames."""

    now_ns: int = 0

    def after(self, passed_ns: int) -> int:
        self.now_ns += passed_ns
        return self.now_ns


def main() -> None:
    """Prints a line of JSON for each round."""
    parser = argparse.ArgumentParser(prog="python -m tests.render_server.method_rounds", description=__doc__)
    parser.add_argument("--rounds", type=int, default=10)
    parser.add_argument("--keep", action="store_true", help="give no free memory back, as before")
    options = parser.parse_args()
    with ExitStack() as stack:
        if options.keep:
            stack.enter_context(mock.patch.object(freed_memory, "give_back_freed_memory"))
        folder = stack.enter_context(tempfile.TemporaryDirectory())
        rounds(Path(folder), create_context(), options.rounds)


def rounds(folder: Path, gpu: GpuContext, count: int) -> None:
    """Shows all methods so often, in motion and at rest."""
    document, clock = everyday(Stage(folder)), Clock()
    document = document.replaced(output=document.output.replaced(width=WIDTH))
    renderer = SceneRenderer(gpu, document)
    for number in range(1, count + 1):
        began_s = time.process_time()
        for method in METHODS.values():
            quality = {} if method["name"] == "none" else {"quality": "live"}
            renderer.set_scene(document.replaced(method={**method, **quality}))
            show(renderer, clock)
        cpu_s = round(time.process_time() - began_s, 1)
        print(json.dumps({"round": number, "cpu_s": cpu_s, **held(gpu)}), flush=True)
    renderer.release()


def show(renderer: SceneRenderer, clock: Clock) -> None:
    """Shows a camera that moves, and then stands still."""
    clock.after(PAUSE_NS)
    waits_ns = (MOTION_NS, MOTION_NS, *(REST_NS,) * FRAMES_AT_REST)
    for number, wait_ns in enumerate(waits_ns):
        pose = look_at((0.25 + 0.01 * min(number, 1), -0.9, 0.65))
        renderer.render(
            frame(noisy(min(number, 1)), pose=pose, frame_id=number, timestamp_ns=clock.after(wait_ns))
        )


def held(gpu: GpuContext) -> dict[str, object]:
    """Returns memory (MB), GL objects and linked programs."""
    gc.collect()
    libc = ctypes.CDLL(None)
    libc.mallinfo2.restype = MallInfo
    heap = libc.mallinfo2()
    return {
        "in_use_mb": round(heap.uordblks / 1e6, 1),
        "free_mb": round(heap.fordblks / 1e6, 1),
        "rss_mb": round(psutil.Process().memory_info().rss / 1e6, 1),
        "gl_objects": sum(count_gl_objects().values()),
        "programs": len(gpu.programs),
    }


if __name__ == "__main__":
    main()
