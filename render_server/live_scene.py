"""One scene across frames: geometry, lights and estimates that outlive a frame, and the frame graph."""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float32

from deltalight.protocol.frames import ViewFrame
from deltalight.protocol.scene import SceneDocument
from deltalight.protocol.scene_objects import SceneObject
from deltalight.protocol.scene_output import Output
from deltalight.render_server.estimation.albedo import AlbedoEstimator
from deltalight.render_server.estimation.flat_things import SurfaceTables
from deltalight.render_server.estimation.lighting import LightEstimator
from deltalight.render_server.frame_budget import FrameBudget, HeldLevels, Level
from deltalight.render_server.frame_graph import (
    CompositeOptions,
    FrameGraph,
    FrameInputs,
)
from deltalight.render_server.frame_graph_pool import FrameGraphPool
from deltalight.render_server.geometry_state import GeometryState
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.textures import release_all
from deltalight.render_server.gpu.timers import PassTimers
from deltalight.render_server.methods.registry import MethodChoice, MethodChooser
from deltalight.render_server.passes.composite import Crossfade, Enlarge
from deltalight.render_server.passes.shadow_maps import most_maps_bytes
from deltalight.render_server.passes.voxels import MEGABYTE
from deltalight.render_server.precomputation.precomputed import Precomputed
from deltalight.render_server.real_geometry import RealGeometry
from deltalight.render_server.relit_frame import Fade, RelitFrame
from deltalight.render_server.scene.declared_surfaces import SurfaceTable
from deltalight.render_server.scene.triangle_mesh import TriangleMesh
from deltalight.render_server.view import PosedFrame, scaled_size
from deltalight.render_server.virtual_objects import VirtualObjects

REFINE_S = 0.05  # of work on each frame at rest, until its picture has the best quality
REST_NS = 300_000_000  # without any change, after which a picture is refined
FADE_NS = 400_000_000  # in which the refined picture replaces the one before


@dataclass(frozen=True, eq=False)
class _Plan:
    """A scene whose files and memory have been checked."""

    scene: SceneDocument
    method: MethodChoice
    lighting: LightEstimator


class LiveScene:
    """Holds everything that outlives a frame: real scene, objects, lights, estimates and frame graphs.

    Args:
        gpu: the context to render with.
        scene: the scene document.
        notices: receives sentences that a user should read, each once.
        waits: as for `SceneRenderer`.
        is_paced: frames in which something moves keep to the document's budget (`FrameBudget`).
        checks: as for `Graph`.
        held: quality levels that held the budget before; rendering begins at them.
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
        held: HeldLevels | None = None,
    ) -> None:
        self._gpu = gpu
        self._is_paced, self._held = is_paced, held
        self._notices = notices
        self.timers = PassTimers(gpu)
        self._objects = VirtualObjects(gpu)
        self._real: RealGeometry | None = None
        self._surfaces = SurfaceTables()
        self._albedo = AlbedoEstimator(gpu)
        self._chooser = MethodChooser(software=gpu.is_software)
        self._enlarge: Enlarge | None = None
        self._crossfade: Crossfade | None = None
        self._refined_ns: int | None = None  # when the refined picture began to fade in
        # Objects, lights and document of the newest picture, and when any of them or the real scene changed.
        self._changing: tuple[object, ...] = ()
        self._changed_ns = 0
        self._precomputed = Precomputed(self._notify, waits=waits)
        self._graphs = FrameGraphPool(gpu, self._precomputed, self.timers, checks=checks)
        self._waits = waits
        self._unobserved = False  # the real scene moved while its lights were provisional
        self._accumulated: tuple[ViewFrame, ...] = ()  # last frames already accumulated
        self.is_at_rest = False  # everything in the newest frame
        self._budget = self._new_budget(scene)
        self._plan = self._planned(scene)
        self._waits = True  # from now on; otherwise a picture that is shown already would change twice
        self.lighting = self._plan.lighting
        self._apply(self._plan)

    def _planned(self, scene: SceneDocument, before: LightEstimator | None = None) -> _Plan:
        """Checks all that can fail before anything is replaced. `before`: lights estimated in this room so far."""
        method = self._chooser.choose(scene.method, scene.shading, self._budget.level.quality)
        if method.remark is not None:
            self._notify(method.remark)
        method.require(scene.objects)
        self._objects.load(scene.objects)
        for sentence in self._objects.left_out(scene.objects):
            self._notify(sentence)
        self._state_lamps(scene.objects, method)
        if before is not None and scene.lights == self._plan.scene.lights:
            # Reading them anew takes a tenth of a millisecond of each drag.
            return _Plan(scene, method, before)
        known = before if method.keeps_world else None
        return _Plan(scene, method, LightEstimator(scene.lights, self._notify, known, waits=self._waits))

    def _state_lamps(self, objects: Sequence[SceneObject], method: MethodChoice) -> None:
        """Notifies the user how much memory the shadow maps of the objects' lamps may take."""
        lamps = self._objects.lamps_of(objects)
        if lamps:
            maps_mb = math.ceil(most_maps_bytes(lamps, method.resolved.rsm_size) / MEGABYTE)
            self._notify(f"shadow maps of the objects' lamps ({len(lamps)}): up to {maps_mb} MB")

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
        if self._held is not None and self._is_paced:
            return self._held.budget(scene.method, scene.output, self._gpu.renderer_name)
        return FrameBudget(scene.output.frame_budget_ms if self._is_paced else None, scene.method.quality)

    def account(self, relit: RelitFrame, frame_ms: float) -> None:
        """Accounts a frame's time; the budget may choose another level for the next ones."""
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
            self._surfaces, self._accumulated = SurfaceTables(), ()
        if plan.method != old.method:
            self._graphs.clear()
        if plan.scene.lights != old.scene.lights:
            self.lighting = plan.lighting
            self._accumulated = ()
        self._plan, self.is_at_rest = plan, False

    def forget_frames(self) -> None:
        """Forgets all observations and estimates: another camera shows another room."""
        plan = self._planned(self._plan.scene)
        if self._real is not None:
            self._real.release()
        self._real = None
        self._graphs.clear()
        self.lighting = plan.lighting
        self._apply(plan)

    @property
    def graph(self) -> FrameGraph | None:
        """The first camera's graph of the newest frame; None before the first."""
        return self._graphs.newest[0] if self._graphs.newest else None

    @property
    def model(self) -> Sequence[TriangleMesh]:
        """The real scene's meshes, if a model is given."""
        return () if self._real is None else self._real.model

    @property
    def room_corners(self) -> Float32[np.ndarray, "m 3 3"] | None:
        """Corners of the real scene's triangles in the world, m; None before the first."""
        state = None if self._real is None else self._real.state
        return None if state is None else state.corners

    def relight(self, taken: Sequence[PosedFrame], *, full_size: bool = False) -> list[RelitFrame]:
        """Prepares a frame of each camera in the room for composition.

        Returns none if there is nothing to compose, because no object is visible or no light is known yet.
        `full_size`: at the camera's size, whatever the budget. Boards on objects, and the lights, are those of the
        first camera. Relighting the same frames again, in another view or by another method, adds nothing to averages
        over frames.
        """
        if self._plan.method.document.quality != self._budget.level.quality:
            self._apply(self._planned(self._plan.scene))
        frames, first = tuple(each.frame for each in taken), taken[0].frame
        self.is_at_rest = False
        again, self._accumulated = _same_objects(frames, self._accumulated), ()
        if self._real is not None and not again:
            self._real.expect(taken)
        lit = again or self.lighting.update(first)
        objects = self._objects.update(self._plan.scene.objects, first.board, first.timestamp_ns)
        if objects is None or self._real is None or not lit:
            return []
        level = self._level(full_size=full_size)
        sized = [each.at(scaled_size(each.view.size, level.scale)) for each in taken]
        graphs = self._upload(sized)
        moved = not again and self._real.update(taken)
        if self._real.state is None:
            self._notify(
                "Depth showed no surface in some frames; they are passed through as the camera saw them."
            )
            return []
        declared = self._plan.scene.real.surfaces
        surfaces = self._surfaces.update(declared, taken[0], self._real.material_names, moved=moved)
        self._set_inputs(graphs, self._real, sized, objects, surfaces)
        changed = self._note_change(objects, first, moved=moved)
        self._estimate_lights(self._real, first, moved=moved)
        self._accumulated = frames
        changed |= self._note_change(objects, first, moved=False)
        relit = self._relit(taken, level, changed=changed)
        self.is_at_rest = self._has_come_to_rest(first)
        best = self._refined(self._real, taken, objects, surfaces) if self.is_at_rest else []
        if not best:
            self._refined_ns = None
            return relit
        pairs = zip(relit, best, strict=True)
        return [self._fading(each, graph, at_once=full_size or again) for each, graph in pairs]

    def _upload(self, sized: Sequence[PosedFrame]) -> list[FrameGraph]:
        """Uploads the frames' pictures; returns the graphs that fit them."""
        graphs = self._graphs.fit([each.view for each in sized], self._plan.method)
        with self.timers.measure("upload"):
            for graph, each in zip(graphs, sized, strict=True):
                graph.upload(each.frame)
        return graphs

    def _relit(self, taken: Sequence[PosedFrame], level: Level, *, changed: bool) -> list[RelitFrame]:
        options = self._options(self._plan.scene.output)
        return [
            RelitFrame(
                each.frame,
                graph,
                options,
                level,
                changed,
                self._enlarged_to(each.view.size, level.scale),
            )
            for graph, each in zip(self._graphs.newest, taken, strict=True)
        ]

    def _estimate_lights(self, real: RealGeometry, frame: ViewFrame, *, moved: bool) -> None:
        """Estimates light, and the albedo of surfaces that may go out of view, with the first camera's graph."""
        graph = self._graphs.newest[0]
        graph.set_lights(self.lighting.estimate(graph, moved=moved, is_at_rest=self._has_come_to_rest(frame)))
        self._unobserved |= moved
        is_due = self._unobserved and not self.lighting.is_provisional
        self._unobserved &= not is_due
        assert self.lighting.lights is not None
        if is_due and real.has_unseen and self._albedo.observe(graph, self.lighting.lights):
            graph.set_lights(self.lighting.lights)
            for each in self._graphs.of_first_camera():
                each.renew_albedo()

    def _note_change(self, objects: GeometryState, frame: ViewFrame, *, moved: bool) -> bool:
        """Returns whether anything changed since the newest picture; remembers when it did."""
        changing = (objects, self.lighting.lights, self._plan)
        changed = moved or not _same_objects(changing, self._changing)
        if changed:
            self._changing, self._changed_ns = changing, frame.timestamp_ns
        return changed

    def _has_come_to_rest(self, frame: ViewFrame) -> bool:
        assert self._real is not None
        return self._real.is_settled and frame.timestamp_ns - self._changed_ns >= REST_NS

    def _level(self, *, full_size: bool) -> Level:
        """Returns the level of the next frame; debug views are never enlarged."""
        level = self._budget.level
        full_size = full_size or self._plan.scene.output.view != "composite"
        return replace(level, scale=1.0) if full_size else level

    def _set_inputs(
        self,
        graphs: Sequence[FrameGraph],
        real: RealGeometry,
        taken: Sequence[PosedFrame],
        objects: GeometryState,
        surfaces: SurfaceTable,
    ) -> None:
        """Sets the inputs of graphs whose sizes are those of the frames."""
        assert real.state is not None
        assert self.lighting.lights is not None
        output = self._plan.scene.output
        for graph, camera, each in zip(graphs, real.cameras, taken, strict=True):
            size = each.view.size
            # While nothing moves, the pose's own jitter must not shake the picture.
            view = camera.moved_frame.at(size).view
            view = view.with_antialiasing if output.antialiasing else view
            graph.set_inputs(
                FrameInputs(
                    each.frame,
                    view.with_matting(output.matting_px),
                    camera.scan(size),
                    camera.measurement(size),
                    real.state,
                    objects,
                    surfaces,
                    self.lighting.lights,
                    self._albedo.texture,
                )
            )

    def _refined(
        self,
        real: RealGeometry,
        taken: Sequence[PosedFrame],
        objects: GeometryState,
        surfaces: SurfaceTable,
    ) -> list[FrameGraph]:
        """Refines the frames for REFINE_S; returns their graphs once all have pictures of the best quality."""
        method = self._plan.method.in_best_quality(software=self._gpu.is_software)
        best = self._graphs.fit_best([each.view for each in taken], method)
        for graph, each in zip(best, taken, strict=True):
            graph.upload(each.frame)
        self._set_inputs(best, real, taken, objects, surfaces)
        options, until_s = self._options(self._plan.scene.output), time.monotonic() + REFINE_S
        return best if all(graph.advance(options, until_s) for graph in best) else []

    def _fading(self, before: RelitFrame, best: FrameGraph, *, at_once: bool) -> RelitFrame:
        """Returns the refined frame, faded in within FADE_NS unless it is shown `at_once`."""
        if self._refined_ns is None:
            self._refined_ns = before.frame.timestamp_ns - FADE_NS * at_once
        fraction = (before.frame.timestamp_ns - self._refined_ns) / FADE_NS
        refined = replace(before, graph=best, level=Level("best"), moves=False, enlarge=None)
        if at_once or not 0 <= fraction < 1 or before.options.output.view != "composite":
            return refined
        size = before.frame.color.shape[1::-1]
        if self._crossfade is None or self._crossfade.size != size:
            release_all(self._crossfade)
            self._crossfade = Crossfade(self._gpu, size)
        return replace(refined, level=before.level, fade=Fade(before, fraction, self._crossfade))

    def _enlarged_to(self, size: tuple[int, int], scale: float) -> Enlarge | None:
        """Returns the pass that enlarges pictures of that scale to the size; None if they have it."""
        if scaled_size(size, scale) == size:
            return None
        if self._enlarge is None or self._enlarge.size != size:
            release_all(self._enlarge)
            self._enlarge = Enlarge(self._gpu, size)
        return self._enlarge

    def _options(self, output: Output) -> CompositeOptions:
        method = self._plan.method
        return CompositeOptions(
            output, method.composition == "additive", method.relights_real, with_linear=False
        )

    def describe_lights(self) -> list[dict[str, Any]]:
        """Returns the lights as plain values, registration included."""
        return [] if self.lighting.lights is None else self.lighting.lights.describe()

    def release(self) -> None:
        """Frees all GL objects."""
        release_all(
            self.timers,
            self._objects,
            self._real,
            self._graphs,
            self._enlarge,
            self._crossfade,
            self._albedo,
            self._precomputed,
        )


def _same_objects(some: Sequence[object], others: Sequence[object]) -> bool:
    return len(some) == len(others) and all(one is other for one, other in zip(some, others, strict=True))
