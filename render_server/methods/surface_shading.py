"""Shades the visible surfaces by stages that methods share: direct light, cones, reflections (docs/method.md 3)."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, get_args, get_origin, get_type_hints

import moderngl

from deltalight.protocol.quality import BEST, QualityTier
from deltalight.render_server.frame import FrameResources, Observation
from deltalight.render_server.geometry_state import GeometryState
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Binding, Bindings
from deltalight.render_server.gpu.textures import release_all
from deltalight.render_server.graph import Graph, Resource
from deltalight.render_server.methods.caustic_beams import TracedBeams, beam_stages, casts_caustics
from deltalight.render_server.methods.light_maps import SELF_SHADOW_TEXELS, LitScene, Points, object_bvh
from deltalight.render_server.methods.method import ResolvedSettings
from deltalight.render_server.methods.volume_placement import object_boxes
from deltalight.render_server.passes.caustics import GREATEST_ALPHA, Caustics
from deltalight.render_server.passes.composite import ChangeRatio
from deltalight.render_server.passes.cones import ConeFields, LowResGrid
from deltalight.render_server.passes.lights import LightBuffers
from deltalight.render_server.passes.object_bvh import ObjectBvh
from deltalight.render_server.passes.reflections import (
    RAY_ROUGHNESS,
    ROUGHEST,
    MirrorRays,
    ScreenCones,
    TransmittedLight,
)
from deltalight.render_server.passes.shading import DirectLight, LightHistory, LightState, ObjectRadiance
from deltalight.render_server.passes.volumes import PlacedVolume
from deltalight.render_server.passes.voxels import VoxelMipmap, VoxelsOnDemand
from deltalight.render_server.view import CameraView, Rectangle


def no_voxels(_: object) -> None:
    """Returns None: the volume holds no voxels, or no shadow cones march through them."""


def no_bindings(_: object) -> dict[str, Binding]:
    """Returns no bindings, for methods that march no cones."""
    return {}


def reflects_screen(objects: GeometryState) -> bool:
    """Whether any object is smooth enough to reflect the picture."""
    return bool(min(objects.materials.smoothest, objects.materials.smoothest_coat) < ROUGHEST)


def mirrors_objects(objects: GeometryState) -> bool:
    """Whether any object is smooth enough to show objects, by rays."""
    return bool(min(objects.materials.smoothest, objects.materials.smoothest_coat) < RAY_ROUGHNESS)


@dataclass(frozen=True, eq=False)
class ShadingOptions:
    """Options of the shared shading.

    Attributes:
        tier: the quality.
        caustics: smooth objects cast beams.
        screen_space: smooth objects reflect the picture.
        mirror_gather: suffix of the kernel that lights reflected points (`mirror_...`); None: no rays at smooth real
            surfaces.
        march: defines of march.glsl, with which smooth objects look up in voxels what the picture does not show;
            None: they do not.
        lists_cones: the reduced grid lists where cones are to be traced at real surfaces.
        is_everywhere: shades all pixels, whether or not objects seem to reach them.
        texel_m: size of a shadow map's texel at a point (m), by which objects are lifted against self-shadowing;
            None: that of the objects' maps.
    """

    tier: QualityTier = BEST
    caustics: bool = False
    screen_space: bool = False
    mirror_gather: str | None = None
    march: Mapping[str, int] | None = None
    lists_cones: bool = False
    is_everywhere: bool = False
    texel_m: Callable[[Points], float] | None = None


@dataclass(frozen=True, eq=False)
class Layers:
    """The layers that a method declares for composition, which reads their values as `RelitLayers`.

    Attributes:
        direct, cones, grid: light at visible surfaces, and the grid that `cones` are on.
        change: where light at real surfaces changes, and by which ratio.
        radiance: the objects', on the picture's grid.
        reflection: of objects in smooth real surfaces; None if there are none, or `cones` have them.
        voxels, volume, lights, error: for debug views.
        direct_mu, cones_mu: light at real surfaces without the objects, where that is cheaper than `direct` and
            `cones`.
        transmit: declares the stage that adds light through transparent objects to their `radiance`.
    """

    direct: Resource[DirectLight]
    cones: Resource[ConeFields]
    grid: Resource[LowResGrid]
    change: Resource[ChangeRatio]
    radiance: Resource[moderngl.Texture]
    reflection: Resource[moderngl.Texture | None]
    voxels: Resource[VoxelMipmap | VoxelsOnDemand | None]
    volume: Resource[PlacedVolume]
    lights: Resource[LightBuffers]
    error: Resource[Callable[[], moderngl.Texture]] | None = None
    direct_mu: Resource[DirectLight] | None = None
    cones_mu: Resource[ConeFields] | None = None
    transmit: Callable[[Resource[moderngl.Texture]], Resource[moderngl.Texture]] | None = None


def layer_kinds() -> dict[str, Any]:
    """Returns the type of each layer that is a resource, as `isinstance` takes it."""
    kinds: dict[str, Any] = {}
    for name, hint in get_type_hints(Layers).items():
        for each in (hint, *get_args(hint)):
            if get_origin(each) is Resource:
                (kind,) = get_args(each)
                kinds[name] = Callable if get_origin(kind) is Callable else kind
    return kinds


class SurfaceShading:
    """Shades the visible surfaces: cones at reduced resolution, direct light and objects at full resolution.

    The method's own stages fill `cones`. Arguments `marching` are the bindings that its cones march with.
    """

    def __init__(
        self,
        gpu: GpuContext,
        size: tuple[int, int],
        resolved: ResolvedSettings,
        lights: LightBuffers,
        direct: DirectLight,
        options: ShadingOptions,
    ) -> None:
        self._gpu, self._options, self._lights, self._direct = gpu, options, lights, direct
        self.tier = options.tier
        self.size, self._scale = size, resolved.cone_scale
        self.reuses_light = options.tier.refresh_tiles > 0
        lists_quads = options.screen_space and options.tier.reflection_step > 1
        self.grid = LowResGrid(
            gpu,
            size,
            resolved.cone_scale,
            shadow_defines=direct.defines,
            lists_quads=lists_quads,
            lists_cones=options.lists_cones,
        )
        self.cones = ConeFields(gpu, self.grid.size, remembers=self.reuses_light)
        self._history: LightHistory | None = None
        if self.reuses_light:
            self._history = LightHistory(gpu, self.grid, direct, self.cones, options.tier.refresh_tiles)
        self._radiance = ObjectRadiance(gpu, size)
        self._change = ChangeRatio(gpu, self.grid.size)
        self._caustics: Caustics | None = None
        if options.caustics:
            self._caustics = Caustics(gpu, self.grid, reuses=self.reuses_light)
        self.has_caustics, self.has_shadow_cones = options.caustics, direct.has_shadow_cones
        self._screen: ScreenCones | None = None
        if options.screen_space:
            self._screen = ScreenCones(gpu, self.grid, options.march, options.tier)
        self._transmitted: TransmittedLight | None = None
        self._unchanged: DirectLight | None = None
        self._rays: MirrorRays | None = None
        self._object_rays: MirrorRays | None = None
        self._texel_m = options.texel_m or lights.object_texel_m

    def scene(
        self,
        geometry: Bindings,
        objects: GeometryState,
        view: CameraView,
        volume: PlacedVolume,
        area: Rectangle,
        *_lights: object,
    ) -> dict[str, Binding]:
        """Returns the bindings of stages that shade pixels.

        Geometry, lights, volume, and values derived from them.
        """
        has_caustics = self._caustics is not None and casts_caustics(objects)
        focal = float(view.camera.matrix[0, 0])
        return {
            **geometry,
            **self._lights.bindings,
            **volume.bindings,
            **object_boxes(objects, volume.placements),
            "normal_offset": self._normal_offset(objects),
            "pixel_size": 1.0 / focal,
            "sample_distance": 1.5 * self._scale / focal,
            "lit_area": (0, 0, *self.size) if self._options.is_everywhere else area,
            "has_caustics": has_caustics,
            "beam_alpha": GREATEST_ALPHA if has_caustics else 0.0,
            "hidden_too": objects.materials.transmits
            or (self._screen is not None and reflects_screen(objects)),
        }

    def _normal_offset(self, objects: GeometryState) -> float:
        low, high = objects.bounds
        return SELF_SHADOW_TEXELS * self._texel_m((low + high) / 2)

    def choose_pixels(self, scene: Bindings) -> LowResGrid:
        """Selects the pixel that represents each block of the picture; lists blocks where light may change."""
        self.grid.run(scene)
        return self.grid

    def reuse_light(
        self, scene: Bindings, _grid: LowResGrid, light: LightState, view: CameraView
    ) -> tuple[Bindings, DirectLight]:
        """Reuses the last frame's light where it is still right, and lists where light must be computed."""
        assert self._history is not None
        is_diffuse = not scene["specular_surfaces"]
        return {**scene, **self._history.run(scene, light if is_diffuse else None, view)}, self._direct

    def end_beams(self, traced: TracedBeams | None, seen: Observation) -> Caustics | None:
        """Ends beams where the camera sees a surface; None if there are none."""
        if self._caustics is None or traced is None:
            return None
        self._caustics.end_beams(traced.beams, seen.bindings, traced.reach_m)
        return self._caustics

    def cast_caustics(self, scene: Bindings, _grid: LowResGrid, beams: Caustics | None) -> Caustics | None:
        """Renders the light of the beams where they end."""
        if beams is not None:
            beams.run(scene)
        return beams

    def light_directly(
        self,
        scene: Bindings,
        grid: LowResGrid,
        caustics: Caustics | None,
        voxels: VoxelMipmap | None,
        bvh: ObjectBvh,
        *_kept: DirectLight,
    ) -> DirectLight:
        """Computes the direct light on the real surfaces, except where the last frame's is reused."""
        shadow_voxels = None if voxels is None else voxels.texture
        traced = bvh if scene["TRANSMISSION"] else None
        self._direct.run(grid, scene, shadow_voxels=shadow_voxels, caustics=caustics, objects=traced)
        return self._direct

    def light_unchanged(self, scene: Bindings, grid: LowResGrid) -> DirectLight:
        """Computes the direct light on the real surfaces without the objects, for estimates of light."""
        if self._unchanged is None:
            self._unchanged = DirectLight(self._gpu, self.size, objects_shadow=False)
        self._unchanged.run(grid, scene)
        return self._unchanged

    def reflect_objects(
        self, scene: Bindings, grid: LowResGrid, bvh: ObjectBvh, marching: Bindings
    ) -> moderngl.Texture | None:
        """Traces the objects that smooth real surfaces reflect; returns None if none is declared, or cones do it."""
        wanted = self._options.mirror_gather
        if wanted is None or not scene["specular_surfaces"]:
            if self._rays is not None:
                self._rays.release()
            self._rays = None
            return None
        if self._rays is None:
            self._rays = MirrorRays(self._gpu, grid, bvh, wanted, self._options.march or {})
        self._rays.run({}, {**scene, **marching})
        return self._rays.reflection

    def mirror_objects(
        self, objects: GeometryState, scene: Bindings, grid: LowResGrid, bvh: ObjectBvh, marching: Bindings
    ) -> moderngl.Texture | None:
        """Traces the objects that smooth objects reflect; returns None if none is smooth enough, or cones do it."""
        wanted = self._options.mirror_gather
        is_quick = self.tier.reflection_step > 1
        if wanted is None or self._screen is None or is_quick or not mirrors_objects(objects):
            release_all(self._object_rays)
            self._object_rays = None
            return None
        if self._object_rays is None:
            march = self._options.march or {}
            self._object_rays = MirrorRays(self._gpu, grid, bvh, wanted, march, of_objects=True)
        self._object_rays.run({}, {**scene, **marching})
        return self._object_rays.reflection

    def compare(
        self,
        grid: LowResGrid,
        direct: DirectLight,
        cones: ConeFields,
        reflection: moderngl.Texture | None,
        distant: Bindings | None = None,
    ) -> ChangeRatio:
        """Computes where light changes, and by which ratio."""
        self._change.run(grid, direct, cones, reflection, distant)
        return self._change

    def trace_screen(
        self,
        objects: GeometryState,
        scene: Bindings,
        direct: DirectLight,
        cones: ConeFields,
        bvh: ObjectBvh,
        seen: Observation,
        marching: Bindings,
        mirrored: moderngl.Texture | None,
    ) -> moderngl.Texture | None:
        """Traces what smooth objects reflect of the picture, and adds the objects `mirrored` in them."""
        if self._screen is None or not reflects_screen(objects):
            return None
        seen.image.build_levels()
        self._screen.run(direct, cones, bvh, {**scene, **marching}, mirrored)
        return self._screen.reflected

    def shade_objects(
        self,
        scene: Bindings,
        grid: LowResGrid,
        cones: ConeFields,
        caustics: Caustics | None,
        screen: moderngl.Texture | None,
    ) -> moderngl.Texture:
        """Shades the objects."""
        self._radiance.run(cones, grid, scene, screen=screen, caustics=caustics)
        return self._radiance.texture

    def add_transmitted(
        self,
        radiance: moderngl.Texture,
        objects: GeometryState,
        scene: Bindings,
        direct: DirectLight,
        cones: ConeFields,
        bvh: ObjectBvh,
        seen: Observation,
        marching: Bindings,
    ) -> moderngl.Texture:
        """Adds what transparent objects show of what is behind them, if there are any."""
        if not objects.materials.transmits:
            release_all(self._transmitted)
            self._transmitted = None
            return radiance
        if self._transmitted is None:
            self._transmitted = TransmittedLight(
                self._gpu, self.grid, self._options.march, self._options.tier
            )
        seen.image.build_levels()
        self._transmitted.run(radiance, direct, cones, bvh, {**scene, **marching})
        return self._transmitted.radiance

    def release(self) -> None:
        """Frees the GL objects."""
        held = (
            self.grid,
            self._history,
            self.cones,
            self._direct,
            self._unchanged,
            self._radiance,
            self._change,
            self._caustics,
            self._screen,
            self._transmitted,
            self._rays,
            self._object_rays,
        )
        for item in held:
            if item is not None:
                item.release()


class RayInputs(NamedTuple):
    """Inputs of stages that trace rays from the objects, in the order of their arguments."""

    objects: Resource[GeometryState]
    scene: Resource[Bindings]
    direct: Resource[DirectLight]
    cones: Resource[ConeFields]
    bvh: Resource[ObjectBvh]
    observation: Resource[Observation]
    marching: Resource[dict[str, Binding]]


@dataclass(frozen=True, eq=False)
class MethodStages:
    """What a method brings to the shared shading.

    Attributes:
        volume: where its light is stored.
        trace: declares the stages that fill the cones, given the shading scene and the grid.
        voxels: those of the `volume`, for its debug view and for shadow cones; None if it has none.
        marching: bindings of what rays march through; None if they march through nothing.
        light_directly: computes the direct light; None: `SurfaceShading` does.
        find_distant: finds the change of light beyond the volume.
        refract: changes the cones' light where it passes through transparent objects.
    """

    volume: Resource[PlacedVolume]
    trace: Callable[[Resource[Bindings], Resource[LowResGrid]], Resource[ConeFields]]
    voxels: Resource[VoxelMipmap] | Resource[VoxelsOnDemand] | None = None
    marching: Resource[dict[str, Binding]] | None = None
    light_directly: Callable[..., DirectLight] | None = None
    find_distant: Callable[..., Bindings] | None = None
    refract: Callable[..., ConeFields] | None = None


def shading_stages(
    g: Graph, s: FrameResources, shading: SurfaceShading, lit: LitScene, own: MethodStages
) -> Layers:
    """Declares grid, cones, caustics, direct light, reflections, change of light, and objects."""
    volume = own.volume
    voxels: Resource[Any] = own.voxels or g.value("voxels", no_voxels, volume)
    marching = own.marching or g.value("marching", no_bindings, volume)
    g.section("shading")
    scene = plain_scene = g.value(
        "shading scene", shading.scene, s.geometry, s.objects, s.view, volume, s.lit_area, *lit.all, s.lights
    )
    bvh = object_bvh(g, s)
    traced_beams = beam_stages(g, s, lit, shading.tier, volume, bvh, casts=shading.has_caustics)
    beams = g.stage("caustic ends", shading.end_beams, traced_beams, s.own_measured)
    grid = g.stage("low res grid", shading.choose_pixels, scene)
    kept: list[Resource[Any]] = []
    if shading.reuses_light:
        state = _light_state(g, s, lit, volume, voxels, marching, beams)
        outputs = "reusing scene", "kept light"
        scene, *kept = g.stages(
            "light reuse", shading.reuse_light, scene, grid, state, s.view, outputs=outputs
        )
    direct_mu = None
    if own.light_directly is None:
        # For estimates, which try other lights: nothing of the last frame's light serves.
        direct_mu = g.stage("direct light mu", shading.light_unchanged, plain_scene, grid)
    cones = own.trace(scene, grid)
    caustics = g.stage("caustics", shading.cast_caustics, scene, grid, beams)
    light = own.light_directly or shading.light_directly
    marches = own.light_directly is not None or shading.has_shadow_cones
    shadow_voxels = voxels if marches else g.value("shadow voxels", no_voxels, volume)
    direct = g.stage("direct light", light, scene, grid, caustics, shadow_voxels, bvh, *kept)
    if own.refract is not None:
        traced = s.objects, scene, grid, direct, bvh, s.observation, marching
        cones = g.stage("refracted cones", own.refract, cones, *traced)
    rays = RayInputs(s.objects, scene, direct, cones, bvh, s.observation, marching)
    reflection, change = _change_stages(g, shading, grid, rays, own.find_distant)
    radiance = _surface_stages(g, shading, grid, caustics, rays)

    def transmit(opaque: Resource[moderngl.Texture]) -> Resource[moderngl.Texture]:
        return g.stage("transmitted light", shading.add_transmitted, opaque, *rays)

    layers = Layers(direct, cones, grid, change, radiance, reflection, voxels, volume, lit.real_maps)
    return replace(layers, direct_mu=direct_mu, transmit=transmit)


def _change_stages(
    g: Graph,
    shading: SurfaceShading,
    grid: Resource[LowResGrid],
    rays: RayInputs,
    find_distant: Callable[..., Bindings] | None,
) -> tuple[Resource[moderngl.Texture | None], Resource[ChangeRatio]]:
    """Declares what smooth real surfaces reflect, and the change of light."""
    _, scene, direct, cones, bvh, _, marching = rays
    reflection = g.stage("reflections", shading.reflect_objects, scene, grid, bvh, marching)
    distant: list[Resource[Bindings]] = []
    if find_distant is not None:
        distant.append(g.stage("distant change", find_distant, scene, grid, direct, cones, marching))
    return reflection, g.stage("change of light", shading.compare, grid, direct, cones, reflection, *distant)


def _surface_stages(
    g: Graph,
    shading: SurfaceShading,
    grid: Resource[LowResGrid],
    caustics: Resource[Caustics | None],
    rays: RayInputs,
) -> Resource[moderngl.Texture]:
    """Declares what smooth objects reflect, and the objects' radiance."""
    objects, scene, _, cones, bvh, _, marching = rays
    mirrored = g.stage("mirrored objects", shading.mirror_objects, objects, scene, grid, bvh, marching)
    screen = g.stage("screen cones", shading.trace_screen, *rays, mirrored)
    return g.stage("object radiance", shading.shade_objects, scene, grid, cones, caustics, screen)


def _light_state(g: Graph, s: FrameResources, lit: LitScene, *bounces: Resource[Any]) -> Resource[LightState]:
    """Declares what light at real surfaces depends on besides the camera: a new value whenever any of it changes."""
    shared: tuple[Resource[Any], ...] = (s.surfaces, s.lit_area, s.lights, lit.environment)
    unblocked = g.value("unblocked light state", _new_object, *shared, lit.real_maps, *lit.mirrored)
    bounced = g.value("bounced light state", _new_object, *shared, *bounces)
    direct = g.value("direct light state", _new_object, unblocked, bounced, s.objects, lit.object_maps)
    return g.value("light state", LightState, unblocked, direct, bounced)


def _new_object(*_: object) -> object:
    """Returns a value that equals no other."""
    return object()
