"""One scene across frames: geometry, lights and estimates that outlive a frame, and the frame graph."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from protocol.frames import ViewFrame
from protocol.scene import SceneDocument
from protocol.scene_method import Output
from protocol.scene_objects import Material
from render_server.estimation.albedo import AlbedoEstimator
from render_server.estimation.lighting import LightEstimator
from render_server.frame_graph import CompositeOptions, FrameGraph, FrameInputs, ShownBuffers
from render_server.gpu.context import GpuContext
from render_server.gpu.textures import release_all
from render_server.gpu.timers import PassTimers
from render_server.methods.registry import MethodChoice, choose_method
from render_server.occlusion_fields import OcclusionFields
from render_server.passes.composite import Composite
from render_server.real_geometry import RealGeometry
from render_server.scene.declared_surfaces import SurfaceTable, build_surface_table
from render_server.scene.triangle_mesh import TriangleMesh
from render_server.view import CameraView
from render_server.virtual_objects import VirtualObjects

# Work on a frame at rest, until its picture has the best quality; a stage that was begun is finished.
REFINE_S = 0.05
REST_NS = 300_000_000  # without any change, after which a picture is refined


@dataclass(frozen=True, eq=False)
class RelitFrame:
    """A frame that `graph` can compose."""

    graph: FrameGraph
    options: CompositeOptions

    def compose(self, *, with_linear: bool) -> Composite:
        """Renders the picture, and its linear radiance if `with_linear`."""
        options = self.options
        return self.graph.render(
            CompositeOptions(options.output, options.additive, options.relights_real, with_linear)
        )

    def shown(self) -> ShownBuffers:
        """Returns the geometry buffers."""
        return self.graph.shown()


@dataclass(frozen=True, eq=False)
class _Plan:
    """A scene whose files and memory have been checked."""

    scene: SceneDocument
    method: MethodChoice
    lighting: LightEstimator


class LiveScene:
    """Holds everything that lives longer than a frame. `checks` is `Graph`'s."""

    def __init__(
        self,
        gpu: GpuContext,
        scene: SceneDocument,
        notices: list[str],
        *,
        waits: bool = True,
        checks: bool = False,
    ) -> None:
        self._gpu = gpu
        self._checks = checks
        self._notices = notices
        self.timers = PassTimers(gpu)
        self._objects = VirtualObjects(gpu)
        self._real: RealGeometry | None = None
        self._surfaces: SurfaceTable | None = None
        self._albedo = AlbedoEstimator(gpu)
        self.graph: FrameGraph | None = None
        self._best: FrameGraph | None = None
        self._changing: tuple[
            object, ...
        ] = ()  # what the newest picture was made from, camera and room left out,
        self._changed_ns = 0  # and when that or anything else last changed
        self._fields = OcclusionFields(self._notify, waits=waits)
        self._accumulated: ViewFrame | None = None  # last frame already accumulated
        self._plan = self._planned(scene)
        self.lighting = self._plan.lighting
        self._apply(self._plan)

    def _planned(self, scene: SceneDocument) -> _Plan:
        """Checks everything that can fail before anything is replaced."""
        method = choose_method(scene.method, software=self._gpu.is_software)
        if method.remark is not None:
            self._notify(method.remark)
        method.require(scene.objects)
        self._objects.load(scene.objects)
        for sentence in unsupported_requests(scene):
            self._notify(sentence)
        return _Plan(scene, method, LightEstimator(scene.lights, self._notify))

    def _notify(self, sentence: str) -> None:
        if sentence not in self._notices:
            self._notices.append(sentence)

    def set_scene(self, scene: SceneDocument) -> None:
        """Replaces the scene, or raises and changes nothing. Pictures do not wait for precomputation."""
        self._apply(self._planned(scene))
        self._fields.waits = False

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
        release_all(self.graph, self._best)
        self.graph = self._best = None

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

    def relight(self, frame: ViewFrame, view: CameraView) -> RelitFrame | None:
        """Prepares a frame for composition; returns None if no object is visible or there is no light yet.

        Relighting the same frame again, in another view or by another method, adds nothing to averages over
        frames.
        """
        again, self._accumulated = frame is self._accumulated, None
        lit = again or self.lighting.update(frame)
        objects = self._objects.update(self._plan.scene.objects, frame.board, frame.timestamp_ns)
        if objects is None or self._real is None or not lit:
            return None
        graph = self._graph_for(view)
        with self.timers.measure("upload"):
            graph.upload(frame)
        moved = not again and self._real.update(frame, view)
        assert self._real.view is not None
        view = self._real.view  # while nothing moves, the pose's own jitter must not shake the picture
        if self._real.state is None:
            self._notify(
                "Depth showed no surface in some frames; they are passed through as the camera saw them."
            )
            return None
        output = self._plan.scene.output
        assert self.lighting.lights is not None
        inputs = FrameInputs(
            frame,
            view.with_antialiasing if output.antialiasing else view,
            self._real.scan,
            self._real.measurement,
            self._real.state,
            objects,
            self._surface_table(frame, moved=moved),
            self.lighting.lights,
            self._albedo.texture,
        )
        graph.set_inputs(inputs)
        graph.set_lights(self.lighting.estimate(graph, moved=moved))
        if moved and self._real.has_unseen and self._albedo.observe(graph, self.lighting.lights):
            graph.renew_albedo()
            graph.set_lights(self.lighting.lights)
            if self._best is not None:
                self._best.renew_albedo()
        self._accumulated = frame
        changing = (objects, self.lighting.lights, self._plan)
        if moved or not _same_objects(changing, self._changing):
            self._changing, self._changed_ns = changing, frame.timestamp_ns
        if self._real.is_settled and frame.timestamp_ns - self._changed_ns >= REST_NS:
            graph = self._refined(graph, frame, replace(inputs, lights=self.lighting.lights))
        return RelitFrame(graph, self._options(output))

    def _refined(self, graph: FrameGraph, frame: ViewFrame, inputs: FrameInputs) -> FrameGraph:
        """Works on the frame in the best quality for REFINE_S; returns its graph once it is ready, else `graph`."""
        if self._best is None:
            best = self._plan.method.in_best_quality(software=self._gpu.is_software)
            self._best = FrameGraph(
                self._gpu, inputs.view, best, self._fields, self.timers, checks=self._checks
            )
        self._best.upload(frame)
        self._best.set_inputs(inputs)
        options = self._options(self._plan.scene.output)
        ready = self._best.advance(options, time.monotonic() + REFINE_S)
        return self._best if ready else graph

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
        """Returns the graph for the picture's size; a new one if lens or size changed."""
        key = (view.size, view.raster[1])
        if self.graph is not None and self.graph.buffers.key != key:
            self._drop_graph()
        if self.graph is None:
            self.graph = FrameGraph(
                self._gpu, view, self._plan.method, self._fields, self.timers, checks=self._checks
            )
        return self.graph

    def describe_lights(self) -> list[dict[str, Any]]:
        """Returns the lights as plain values, registration included."""
        return [] if self.lighting.lights is None else self.lighting.lights.describe()

    def release(self) -> None:
        """Frees all GL objects."""
        release_all(self._objects, self._real, self.graph, self._best, self._albedo, self._fields)


def _same_objects(some: Sequence[object], others: Sequence[object]) -> bool:
    return len(some) == len(others) and all(one is other for one, other in zip(some, others, strict=True))


def unsupported_requests(scene: SceneDocument) -> list[str]:
    """Returns sentences on requests of the document that this release does not render."""
    materials = [item.material for item in scene.objects if isinstance(item.material, Material)]
    requests = {
        "output.camera_artifacts": scene.output.camera_artifacts,
        f"shading.name `{scene.shading.name}`": scene.shading.name not in ("auto", "volume"),
        "a material's transmission": any(material.transmission > 0 for material in materials),
    }
    return [
        f"{name} arrives with a later release and is left out." for name, asked in requests.items() if asked
    ]
