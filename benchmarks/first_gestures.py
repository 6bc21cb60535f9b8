"""What the first gestures wait for: `python -m deltalight.benchmarks.first_gestures` (some minutes).

The demo in `quality: live`, as a live server renders it: at rest at first, then an object is dragged, a lamp dimmed,
the camera moved. MESA_SHADER_CACHE_DISABLE=true leaves aside what Mesa compiled before.
"""

import argparse
import time
from collections.abc import Iterable
from dataclasses import dataclass, field, replace

from rich.progress import Progress

from deltalight.benchmarks.speed.motions import FRAME_NS, Step, prepare_take, steps_of
from deltalight.protocol.method_names import METHODS
from deltalight.render_server.gpu.context import create_context
from deltalight.render_server.renderer import SceneRenderer
from deltalight.services.demo import demo_scene

FRAMES = {"still": 30, "object": 8, "lamps": 8, "camera": 8}


@dataclass
class Player:
    """Renders frames one after another; after each, it compiles ahead if it `prepares`.

    `compiled` takes the labels of programs as they are compiled.
    """

    renderer: SceneRenderer
    prepares: bool
    compiled: list[str] = field(default_factory=list)
    count: int = 0

    def play(self, steps: Iterable[Step]) -> str:
        """Returns the figures of a motion's frames: the longest one, the last one, programs that they waited for."""
        spent_ms, programs = zip(*[self._show(step) for step in steps], strict=True)
        return f"{max(spent_ms):>11.0f} {spent_ms[-1]:>8.0f} {sum(programs):>9}"

    def _show(self, step: Step) -> tuple[float, int]:
        """Returns the processor time of a frame, ms, and how many programs it waited for."""
        self.count += 1
        frame = replace(step.frame, frame_id=self.count, timestamp_ns=self.count * FRAME_NS)
        start_s = time.process_time()
        if step.scene is not self.renderer.scene:
            self.renderer.set_scene(step.scene)
        self.renderer.render(frame)
        spent_ms, programs = 1e3 * (time.process_time() - start_s), len(self.compiled)
        if self.prepares:
            self.renderer.compile_ahead()
        self.compiled.clear()
        return spent_ms, programs


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--method", choices=METHODS, default="exact", help="Method of the demo.")
    parser.add_argument("--unprepared", action="store_true", help="Compile nothing ahead.")
    arguments = parser.parse_args()
    scene = demo_scene(arguments.method)
    scene = scene.replaced(method=scene.method.replaced(quality="live"))
    with Progress() as progress:
        take = prepare_take(progress)
    gpu = create_context()
    player = Player(SceneRenderer(gpu, scene, waits=False), prepares=not arguments.unprepared)
    gpu.compile_watchers.append(lambda label, _sources: player.compiled.append(label))
    print("motion  longest, ms  last, ms  programs   (processor time of frames)")
    for motion, frames in FRAMES.items():
        print(f"{motion:<8}{player.play(steps_of(motion, take, scene, frames))}", flush=True)
    player.renderer.release()
    gpu.release()


if __name__ == "__main__":
    main()
