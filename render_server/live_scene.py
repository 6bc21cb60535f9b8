"""One scene across frames: geometry, lights and estimates that outlive a frame, and the frame graph."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import ViewFrame
from deltalight.protocol.scene import SceneDocument
from deltalight.protocol.scene_fields import View
from deltalight.protocol.scene_output import Output
from deltalight.render_server.estimation.albedo import AlbedoEstimator
from deltalight.render_server.estimation.lighting import LightEstimator
from deltalight.render_server.frame_budget import FrameBudget, Level
from deltalight.render_server.frame_graph import CompositeOptions, FrameGraph, FrameInputs, ShownBuffers
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.textures import release_all
from deltalight.render_server.gpu.timers import PassTimers
from deltalight.render_server.gpu_scene import GeometryState
from deltalight.render_server.methods.registry import MethodChoice, choose_method
from deltalight.render_server.passes.composite import Composite, Crossfade, Enlarge, Picture
from deltalight.render_server.precomputed import Precomputed
from deltalight.render_server.real_geometry import RealGeometry
from deltalight.render_server.scene.declared_surfaces import SurfaceTable, build_surface_table
from deltalight.render_server.scene.triangle_mesh import TriangleMesh
from deltalight.render_server.view import CameraView, PosedFrame
from deltalight.render_server.virtual_objects import VirtualObjects

# Work on a frame at rest, until its picture has the best quality; a stage that was begun is finished.
REFINE_S = 0.05
REST_NS = 300_000_000  # without any change, after which a picture is refined
FADE_NS = 400_000_000  # in which the refined picture takes the place of the one before


@dataclass(frozen=True, eq=False)
class Fade:
    """How much (`share`, 0..1) of a refined picture shows, and the frame that it takes the place of."""

    before: "RelitFrame"
    share: float
    crossfade: Crossfade


@dataclass(frozen=True, eq=False)
class RelitFrame:
    """A frame that `graph` can compose, at `level`; `enlarge` brings it to the camera's size.

    `moves`: something in it does. `fade`: its picture is not shown whole yet.
    """

    frame: ViewFrame
    graph: FrameGraph
    options: CompositeOptions
    level: Level
    moves: bool
    enlarge: Enlarge | None
    fade: Fade | None = None

    def compose(self, *, with_linear: bool) -> Picture:
        """Renders the picture (its `code`), and its linear radiance if `with_linear`, unless it is enlarged."""
        options = self.options
        composite = self.graph.render(
            CompositeOptions(options.output, options.additive, options.relights_real, with_linear)
        )
        if self.enlarge is not None:
            coverage = self.shown().object_coverage
            self.enlarge.run(self.frame.color, self.graph.buffers.image, composite, coverage)
            return self.enlarge
        if self.fade is None or with_linear:
            return composite
        before = self.fade.before.compose(with_linear=False)
        self.fade.crossfade.run(before.code, composite.code, self.fade.share)
        return self.fade.crossfade

    def compose_view(self, view: View) -> Composite:
        """Renders the frame in another view, at the size of its graph."""
        output = self.options.output.replaced(view=view)
        with_linear = view == "composite" and output.has_bloom
        return self.graph.render_view(replace(self.options, output=output, with_linear=with_linear))

    def shown(self) -> ShownBuffers:
        """Returns the geometry buffers."""
        return self.graph.shown()

    def radiance(self) -> Float64[np.ndarray, "h w 3"]:
        """Returns the radiance of the virtual objects, camera units."""
        return self.graph.radiance()


@dataclass(frozen=True, eq=False)
class _Plan:
    """A scene whose files and memory have been checked."""

    scene: SceneDocument
    method: MethodChoice
    lighting: LightEstimator


class LiveScene:
    """Holds everything that lives longer than a frame. `checks` is `Graph`'s.

    `is_paced`: frames in which something moves heed the document's budget (FrameBudget).
    """

    def __init__(
        self,
        gpu: GpuContext,
        scene: SceneDocument,
        notices: list[str],
        *,
        waits: bool = True,
        is_paced: bool = True,
        checks: bool = False,
    ) -> None:
        self._gpu = gpu
        self._is_paced = is_paced
        self._checks = checks
        self._notices = notices
        self.timers = PassTimers(gpu)
        self._objects = VirtualObjects(gpu)
        self._real: RealGeometry | None = None
        self._surfaces: SurfaceTable | None = None
        self._albedo = AlbedoEstimator(gpu)
        self.graph: FrameGraph | None = None
        self._best: FrameGraph | None = None
        self._spare: FrameGraph | None = None  # of the picture size before, which a budget may choose again
        self._refused: tuple[tuple[MethodChoice, tuple[int, int]], str] | None = None
        self._enlarge: Enlarge | None = None
        self._crossfade: Crossfade | None = None
        self._refined_ns: int | None = None  # the refined picture has shown since
        self._changing: tuple[
            object, ...
        ] = ()  # what the newest picture was made from, camera and room left out,
        self._changed_ns = 0  # and when that or anything else last changed
        self._precomputed = Precomputed(self._notify, waits=waits)
        self._waits = waits
        self._unobserved = False  # the real scene moved while its lights were provisional
        self._accumulated: ViewFrame | None = None  # last frame already accumulated
        self._budget = self._new_budget(scene)
        self._plan = self._planned(scene)
        self._waits = True  # from now on, what is shown already would change twice
        self.lighting = self._plan.lighting
        self._apply(self._plan)

    def _planned(self, scene: SceneDocument, before: LightEstimator | None = None) -> _Plan:
        """Checks everything that can fail before anything is replaced. `before`: the lights so far, of this room."""
        document = scene.method.replaced(quality=self._budget.level.quality)
        method = choose_method(document, scene.shading, software=self._gpu.is_software)
        if method.remark is not None:
            self._notify(method.remark)
        method.require(scene.objects)
        self._objects.load(scene.objects)
        for sentence in self._objects.left_out(scene.objects):
            self._notify(sentence)
        known = before if method.keeps_world else None
        return _Plan(scene, method, LightEstimator(scene.lights, self._notify, known, waits=self._waits))

    def _notify(self, sentence: str) -> None:
        if sentence not in self._notices:
            self._notices.append(sentence)

    def set_scene(self, scene: SceneDocument) -> None:
        """Replaces the scene, or raises and changes nothing. Pictures do not wait for precomputation."""
        before, old = self._budget, self._plan.scene
        if (scene.method, scene.output.frame_budget_ms) != (old.method, old.output.frame_budget_ms):
            self._budget = self._new_budget(scene)
        try:
            self._apply(self._planned(scene, self.lighting))
        except BaseException:
            self._budget = before
            raise
        self._precomputed.stop_waiting()

    def _new_budget(self, scene: SceneDocument) -> FrameBudget:
        budget_ms = scene.output.frame_budget_ms if self._is_paced else None
        return FrameBudget(budget_ms, scene.method.quality)

    def account(self, relit: RelitFrame, frame_ms: float) -> None:
        """Takes how long a frame took; the next ones may be rendered at another level."""
        if not relit.moves or relit.level != self._budget.level:
            return
        self._budget.add(frame_ms)
        if self._budget.remark is not None:
            self._notify(self._budget.remark)

    def _apply(self, plan: _Plan) -> None:
        old = self._plan
        budget = plan.method.resolved.triangle_budget
        if self._real is not None and not plan.method.relights_real:
            budget = self._real.budget  # `none` asks for none
        key = plan.scene.real, budget, plan.method.keeps_world
        if self._real is None or key != (old.scene.real, self._real.budget, old.method.keeps_world):
            real = RealGeometry(self._gpu, plan.scene.real, budget, keeps_world=plan.method.keeps_world)
            if self._real is not None:
                self._real.release()
            self._real = real
            self._albedo.reset(plan.scene.real.unseen_albedo)
            self._surfaces = self._accumulated = None
        if plan.method != old.method:
            self._drop_graph()
        if plan.scene.lights != old.scene.lights:
            self.lighting = plan.lighting
            self._accumulated = None
        self._plan = plan

    def _drop_graph(self) -> None:
        release_all(self.graph, self._best, self._spare)
        self.graph = self._best = self._spare = None

    def forget_frames(self) -> None:
        """Forgets all observations and estimates: another camera shows another room."""
        plan = self._planned(self._plan.scene)
        if self._real is not None:
            self._real.release()
        self._real = None
        self._drop_graph()
        self.lighting = plan.lighting
        self._apply(plan)

    @property
    def model(self) -> Sequence[TriangleMesh]:
        """The real scene's meshes, if a model is given."""
        return () if self._real is None else self._real.model

    @property
    def room_corners(self) -> Float32[np.ndarray, "m 3 3"] | None:
        """Corners of the real scene's triangles in the world, m; None before the first."""
        state = None if self._real is None else self._real.state
        return None if state is None else state.corners[..., :3]

    def relight(self, frame: ViewFrame, view: CameraView, *, whole: bool = False) -> RelitFrame | None:
        """Prepares a frame for composition; returns None if no object is visible or there is no light yet.

        `whole`: at the camera's size, whatever the budget.

        Relighting the same frame again, in another view or by another method, adds nothing to averages over
        frames.
        """
        if self._plan.method.document.quality != self._budget.level.quality:
            self._apply(self._planned(self._plan.scene))
        again, self._accumulated = frame is self._accumulated, None
        lit = again or self.lighting.update(frame)
        objects = self._objects.update(self._plan.scene.objects, frame.board, frame.timestamp_ns)
        if objects is None or self._real is None or not lit:
            return None
        taken, level = PosedFrame(frame, view), self._level(whole=whole)
        size = _scaled(view.size, level.scale)
        graph = self._graph_for(taken.at(size).view)
        with self.timers.measure("upload"):
            graph.upload(taken.at(size).frame)
        moved = not again and self._real.update(taken)
        if self._real.state is None:
            self._notify(
                "Depth showed no surface in some frames; they are passed through as the camera saw them."
            )
            return None
        assert self.lighting.lights is not None
        surfaces = self._surface_table(frame, moved=moved)
        inputs = self._inputs(self._real, taken, size, objects, surfaces)
        graph.set_inputs(inputs)
        changed = self._note_change(objects, frame, moved=moved)
        graph.set_lights(self.lighting.estimate(graph, moved=moved, is_at_rest=self._is_at_rest(frame)))
        self._unobserved |= moved
        is_due = self._unobserved and not self.lighting.is_provisional
        self._unobserved &= not is_due
        if is_due and self._real.has_unseen and self._albedo.observe(graph, self.lighting.lights):
            graph.renew_albedo()
            graph.set_lights(self.lighting.lights)
            if self._best is not None:
                self._best.renew_albedo()
            if self._spare is not None:
                self._spare.renew_albedo()
        self._accumulated = frame
        changed |= self._note_change(objects, frame, moved=False)
        options = self._options(self._plan.scene.output)
        enlarge = None if size == view.size else self._enlarged_to(view.size)
        relit = RelitFrame(frame, graph, options, level, changed, enlarge)
        best = None
        if self._is_at_rest(frame):
            best = self._refined(self._inputs(self._real, taken, view.size, objects, surfaces))
        if best is None:
            self._refined_ns = None
            return relit
        return self._fading(relit, best, is_whole=whole or again)

    def _note_change(self, objects: GeometryState, frame: ViewFrame, *, moved: bool) -> bool:
        """Returns whether anything differs from what the newest picture was made from, and notes when it did."""
        changing = (objects, self.lighting.lights, self._plan)
        changed = moved or not _same_objects(changing, self._changing)
        if changed:
            self._changing, self._changed_ns = changing, frame.timestamp_ns
        return changed

    def _is_at_rest(self, frame: ViewFrame) -> bool:
        assert self._real is not None
        return self._real.is_settled and frame.timestamp_ns - self._changed_ns >= REST_NS

    def _level(self, *, whole: bool) -> Level:
        """Returns what the next frame is rendered at; views of the inside are never enlarged."""
        level = self._budget.level
        whole = whole or self._plan.scene.output.view != "composite"
        return replace(level, scale=1.0) if whole else level

    def _inputs(
        self,
        real: RealGeometry,
        taken: PosedFrame,
        size: tuple[int, int],
        objects: GeometryState,
        surfaces: SurfaceTable,
    ) -> FrameInputs:
        """Returns what a graph of this picture size renders the frame from."""
        assert real.seen is not None
        assert real.state is not None
        assert self.lighting.lights is not None
        # While nothing moves, the pose's own jitter must not shake the picture.
        view, output = real.seen.at(size).view, self._plan.scene.output
        view = view.with_antialiasing if output.antialiasing else view
        return FrameInputs(
            taken.at(size).frame,
            view.with_matting(output.matting_px),
            real.scan(size),
            real.measurement(size),
            real.state,
            objects,
            surfaces,
            self.lighting.lights,
            self._albedo.texture,
        )

    def _refined(self, inputs: FrameInputs) -> FrameGraph | None:
        """Works on the frame in the best quality for REFINE_S; returns its graph once it is ready."""
        best = self._plan.method.in_best_quality(software=self._gpu.is_software)
        before, self._best = self._best, None
        self._best = self._fitting(before, inputs.view, best)
        self._best.upload(inputs.frame)
        self._best.set_inputs(inputs)
        options = self._options(self._plan.scene.output)
        return self._best if self._best.advance(options, time.monotonic() + REFINE_S) else None

    def _fading(self, before: RelitFrame, best: FrameGraph, *, is_whole: bool) -> RelitFrame:
        """Returns the refined frame, which takes the place of the one before within FADE_NS unless `is_whole`."""
        if self._refined_ns is None:
            self._refined_ns = before.frame.timestamp_ns - FADE_NS * is_whole
        share = (before.frame.timestamp_ns - self._refined_ns) / FADE_NS
        refined = replace(before, graph=best, level=Level("best"), moves=False, enlarge=None)
        if is_whole or not 0 <= share < 1 or before.options.output.view != "composite":
            return refined
        size = before.frame.color.shape[1::-1]
        if self._crossfade is None or self._crossfade.size != size:
            release_all(self._crossfade)
            self._crossfade = Crossfade(self._gpu, size)
        return replace(refined, level=before.level, fade=Fade(before, share, self._crossfade))

    def _enlarged_to(self, size: tuple[int, int]) -> Enlarge:
        if self._enlarge is None or self._enlarge.size != size:
            release_all(self._enlarge)
            self._enlarge = Enlarge(self._gpu, size)
        return self._enlarge

    def _options(self, output: Output) -> CompositeOptions:
        method = self._plan.method
        return CompositeOptions(
            output, method.composition == "additive", method.relights_real, with_linear=False
        )

    def _surface_table(self, frame: ViewFrame, *, moved: bool) -> SurfaceTable:
        """Returns the declared surfaces, the board's sheet included; rebuilt when something moved."""
        assert self._real is not None
        if self._surfaces is None or moved:
            declared = self._plan.scene.real.surfaces
            board = frame.board if declared else None
            found = build_surface_table(declared, board, self._real.material_names)
            if self._surfaces is None or not found.equals(self._surfaces):
                self._surfaces = found
        return self._surfaces

    def _graph_for(self, view: CameraView) -> FrameGraph:
        """Returns the graph for this picture size; a new one if lens or size changed.

        In software the one before is kept: a GPU builds what it holds in no time, and its memory is scarcer.
        """
        if self._gpu.is_software and self.graph is not None and not self.graph.fits(view):
            self.graph, self._spare = self._spare, self.graph
        before, self.graph = self.graph, None
        self.graph = self._fitting(before, view, self._plan.method)
        return self.graph

    def _fitting(self, graph: FrameGraph | None, view: CameraView, method: MethodChoice) -> FrameGraph:
        """Returns this graph if it fits, else a new one in its place.

        Raises:
            DeltalightError: something is larger than this GPU allows; it is not tried again for every frame.
        """
        if graph is not None and graph.fits(view):
            return graph
        release_all(graph)
        wanted = method, view.size
        if self._refused is not None and self._refused[0] == wanted:
            raise DeltalightError(self._refused[1])
        try:
            return FrameGraph(self._gpu, view, method, self._precomputed, self.timers, checks=self._checks)
        except DeltalightError as refusal:
            self._refused = wanted, str(refusal)
            raise

    def describe_lights(self) -> list[dict[str, Any]]:
        """Returns the lights as plain values, registration included."""
        return [] if self.lighting.lights is None else self.lighting.lights.describe()

    def release(self) -> None:
        """Frees all GL objects."""
        release_all(
            self._objects,
            self._real,
            self.graph,
            self._best,
            self._spare,
            self._enlarge,
            self._crossfade,
            self._albedo,
            self._precomputed,
        )


def _scaled(size: tuple[int, int], scale: float) -> tuple[int, int]:
    """Returns a picture size at that scale."""
    return max(round(size[0] * scale), 1), max(round(size[1] * scale), 1)


def _same_objects(some: Sequence[object], others: Sequence[object]) -> bool:
    return len(some) == len(others) and all(one is other for one, other in zip(some, others, strict=True))
