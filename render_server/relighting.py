"""From a frame and a scene to relit layers: geometry, lights, registration, and the method that the scene names."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import count
from typing import Any

from protocol.frames import ViewFrame
from protocol.scene import SceneDocument
from protocol.scene_method import NoneMethod
from protocol.scene_objects import Material
from render_server.albedo_watch import AlbedoWatch
from render_server.gpu.context import GpuContext
from render_server.gpu.timers import PassTimers
from render_server.lighting import VERSION_STEP, Lighting
from render_server.occlusion_fields import OcclusionFields
from render_server.passes.composite import RelitLayers
from render_server.picture_resources import PictureResources
from render_server.real_geometry import RealGeometry
from render_server.relight.frame import RelightInput
from render_server.relight.methods import MethodChoice, choose_method
from render_server.relight.relight_base import RelightBase
from render_server.scene.declared_surfaces import build_surface_table
from render_server.scene.triangle_mesh import TriangleMesh
from render_server.view import CameraView
from render_server.virtual_objects import VirtualObjects


@dataclass(frozen=True, eq=False)
class RelitFrame:
    """Layers and what composition needs beside them."""

    input: RelightInput
    layers: RelitLayers
    uniforms: dict[str, Any]

    @property
    def timers(self) -> PassTimers:
        """The frame's pass timers."""
        return self.input.timers


@dataclass(frozen=True, eq=False)
class _Plan:
    """A scene whose files and memory were checked."""

    scene: SceneDocument
    method: MethodChoice
    lighting: Lighting


class Relighting:
    """Holds everything that lives longer than a frame."""

    def __init__(
        self, gpu: GpuContext, scene: SceneDocument, notices: list[str], *, waits: bool = True
    ) -> None:
        self._gpu = gpu
        self._notices = notices
        self._timers = PassTimers(gpu)
        self._objects = VirtualObjects(gpu)
        self._real: RealGeometry | None = None
        self._real_versions = count(1)
        self._resources: PictureResources | None = None
        self._albedo = AlbedoWatch(gpu)
        self._method: RelightBase | None = None
        self._fields = OcclusionFields(self._say, waits=waits)
        self._lights_versions = count(VERSION_STEP, VERSION_STEP)
        self._relit: ViewFrame | None = None  # the last frame, as far as what it shows was taken over
        self._plan = self._planned(scene)
        self.lighting = self._plan.lighting
        self._take(self._plan)

    def _planned(self, scene: SceneDocument) -> _Plan:
        """Check everything that can fail before anything is replaced."""
        method = choose_method(scene.method, software=self._gpu.is_software)
        if method.remark is not None:
            self._say(method.remark)
        method.require(scene.objects)
        self._objects.load(scene.objects)
        for sentence in ignored_wishes(scene):
            self._say(sentence)
        return _Plan(scene, method, Lighting(scene.lights, self._lights_versions, self._say))

    def _say(self, sentence: str) -> None:
        if sentence not in self._notices:
            self._notices.append(sentence)

    def set_scene(self, scene: SceneDocument) -> None:
        """Replace the scene; nothing changes if it cannot be used. Pictures do not wait for what is precomputed."""
        self._take(self._planned(scene))
        self._fields.waits = False

    def _take(self, plan: _Plan) -> None:
        old = self._plan
        budget = plan.method.resolved.triangle_budget
        if self._real is not None and isinstance(plan.scene.method, NoneMethod):
            budget = self._real.budget  # it asks for none
        if self._real is None or plan.scene.real != old.scene.real or budget != self._real.budget:
            real = RealGeometry(self._gpu, plan.scene.real, budget, self._real_versions)
            if self._real is not None:
                self._real.release()
            self._real = real
            self._albedo.begin(plan.scene.real.unseen_albedo)
            self._relit = None
        if plan.method != old.method and self._method is not None:
            self._method.release()
            self._method = None
        if plan.scene.lights != old.scene.lights:
            self.lighting = plan.lighting
            self._relit = None
        self._plan = plan

    def begin_source(self) -> None:
        """Forget all that was seen and found: another camera shows another room."""
        plan = self._planned(self._plan.scene)
        for item in (self._real, self._resources, self._method):
            if item is not None:
                item.release()
        self._real = self._resources = self._method = None
        self.lighting = plan.lighting
        self._take(plan)

    @property
    def model(self) -> Sequence[TriangleMesh]:
        """The real scene's, if it is given."""
        return () if self._real is None else self._real.model

    def relight(self, frame: ViewFrame, view: CameraView) -> RelitFrame | None:
        """Relit layers of one frame; None if no object is visible, or no light yet.

        The same frame again, in another view or by another method, adds nothing to what is averaged over frames.
        """
        again, self._relit = frame is self._relit, None
        lit = again or self.lighting.follow(frame)
        virtual = self._objects.update(self._plan.scene.objects, frame.board, frame.timestamp_ns)
        if virtual is None or self._real is None or not lit:
            return None
        resources = self._resources_for(view)
        timers = self._timers
        with timers.measure("upload"):
            resources.picture.upload(frame)
        moved = not again and self._real.update(frame, view)
        assert self._real.view is not None
        view = self._real.view  # while nothing moves, the pose's own jitter must not shake the picture
        if self._real.state is None:
            self._say(
                "Depth showed no surface in some frames; they are passed through as the camera saw them."
            )
            return None
        with timers.measure("geometry buffer"):
            if moved:
                surfaces = self._plan.scene.real.surfaces
                table = build_surface_table(
                    surfaces, frame.board if surfaces else None, self._real.material_names
                )
                resources.declare_surfaces(table)
            antialiasing = self._plan.scene.output.antialiasing
            resources.rasterise(self._real, virtual, view, moved, antialiasing)
        lights = self.lighting.lights
        assert lights is not None
        relight_input = RelightInput(
            view.with_antialiasing if antialiasing else view,
            resources.picture,
            resources.real_surface,
            resources.virtual_raster,
            resources.matte.texture,
            self._real.state,
            virtual,
            lights,
            self.lighting.version,
            self._real.noise_sigma,
            self._real.typical_depth,
            resources.surface_uniforms,
            self._albedo.texture,
            timers,
            resources.surface_table,
        )
        method = self._method_for(view)
        relight_input = self.lighting.complete(frame, relight_input, method.relight, moved=moved)
        if moved and self._real.has_unseen and self._albedo.look(frame, relight_input, method.relight):
            relight_input = self.lighting.renewed(relight_input)
        layers = method.relight(relight_input)
        if antialiasing:
            with timers.measure("inner edges"):
                radiance = resources.with_inner_edges(layers.virtual_radiance)
            layers = replace(layers, virtual_radiance=radiance)
        self._relit = frame
        uniforms = {
            "additive": self._plan.method.composition == "additive",
            "relights_real": not isinstance(self._plan.scene.method, NoneMethod),
            "sample_distance": self._sample_distance(view),
        }
        return RelitFrame(relight_input, layers, uniforms)

    def _sample_distance(self, view: CameraView) -> float:
        """What a texel of the cones' grid spans at 1 m, m."""
        return float(1.5 * self._plan.method.resolved.cone_scale / view.camera.matrix[0, 0])

    def _resources_for(self, view: CameraView) -> PictureResources:
        """Textures of the picture's size; made anew when the lens or size changes."""
        key = (view.size, view.raster[1])
        if self._resources is None or self._resources.key != key:
            if self._resources is not None:
                self._resources.release()
            if self._method is not None:
                self._method.release()
                self._method = None
            self._resources = PictureResources(self._gpu, view)
        return self._resources

    def _method_for(self, view: CameraView) -> RelightBase:
        if self._method is None:
            self._method = self._plan.method.make(self._gpu, view.size, self._fields)
        return self._method

    def describe_lights(self) -> list[dict[str, Any]]:
        """Plain values of the lights, registration included."""
        return [] if self.lighting.lights is None else self.lighting.lights.describe()

    def release(self) -> None:
        """Free all GL objects."""
        for item in (self._objects, self._real, self._resources, self._albedo, self._method, self._fields):
            if item is not None:
                item.release()


def ignored_wishes(scene: SceneDocument) -> list[str]:
    """Sentences on what the document asks for and this release leaves out of the picture."""
    materials = [item.material for item in scene.objects if isinstance(item.material, Material)]
    wishes = {
        "output.camera_artifacts": scene.output.camera_artifacts,
        f"shading.name `{scene.shading.name}`": scene.shading.name not in ("auto", "volume"),
        "a material's transmission": any(material.transmission > 0 for material in materials),
    }
    return [
        f"{name} arrives with a later release and is left out." for name, asked in wishes.items() if asked
    ]
