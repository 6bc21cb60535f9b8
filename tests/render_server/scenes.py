"""Small scenes for the renderer's tests: models, cameras, pictures, documents, and the fields computed from them."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import moderngl
import numpy as np
import trimesh
from scipy.ndimage import binary_erosion

from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.frames import BoardPose, DepthImage, ViewFrame
from deltalight.protocol.scene import SceneDocument, parse_scene
from deltalight.protocol.scene_method import NoneMethod
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.passes.caustics import HEADER_BYTES, SENT_BEAM_BYTES
from deltalight.render_server.renderer import CompositeFrame, SceneRenderer

WIDTH, HEIGHT = 160, 120
FOCAL = 150.0
EYE, TARGET = (0.25, -0.9, 0.65), (0.0, 0.0, 0.06)
GREY = 150  # code of a plain picture

Vector = tuple[float, float, float]


def camera(
    width: int = WIDTH, height: int = HEIGHT, focal: float = FOCAL, distortion: tuple[float, ...] = (0.0,) * 5
) -> CameraModel:
    matrix = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
    return CameraModel(width, height, matrix, "plumb_bob", np.array(distortion))


def look_at(eye: Vector = EYE, target: Vector = TARGET) -> BoardPose:
    """Camera at `eye`, +x right and +y down in the picture, world up is up."""
    z = np.subtract(target, eye)
    z = z / np.linalg.norm(z)
    up = (0, 0, 1) if abs(z[2]) < 0.999 else (0, 1, 0)
    x = np.cross(z, up)
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    pose[:3, 3] = eye
    return BoardPose(pose)


def plain(code: int = GREY) -> np.ndarray:
    return np.full((HEIGHT, WIDTH, 3), code, np.uint8)


def noisy(seed: int = 0) -> np.ndarray:
    """Every code in every channel, so that bytes which must be copied are told from computed ones."""
    return np.random.default_rng(seed).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)


def checkered() -> np.ndarray:
    """A floor of light and dark squares as the usual camera sees it, brighter to the right."""
    rays = np.dstack([camera().rays(), np.ones((HEIGHT, WIDTH))])
    matrix = look_at().world_from_camera
    along = rays @ matrix[:3, :3].T
    place = matrix[:3, 3] - along * (matrix[2, 3] / along[..., 2:])
    light = (np.floor(place[..., 0] * 8) + np.floor(place[..., 1] * 8)) % 2
    brightness = 70 + 70 * light + np.linspace(0, 60, WIDTH)
    return np.stack([brightness, 0.95 * brightness, 0.85 * brightness], axis=-1).astype(np.uint8)


def frame(color: np.ndarray | None = None, *, pose: BoardPose | None = None, **changes: Any) -> ViewFrame:  # noqa: ANN401
    color = plain() if color is None else color
    given = {"frame_id": 0, "timestamp_ns": 0, "camera": camera(), "pose": pose or look_at()}
    return ViewFrame(color=color, **{**given, **changes})


def floor_depth(pose: BoardPose, height: float = 0.0) -> np.ndarray:
    """Depth along the optical axis of the plane z = `height` at each pixel, 0 where it is not seen."""
    rays = np.dstack([camera().rays(), np.ones((HEIGHT, WIDTH))])
    matrix = pose.world_from_camera
    slope = rays @ matrix[2, :3]
    with np.errstate(divide="ignore"):
        depth = (height - matrix[2, 3]) / slope
    return np.where((depth > 0) & (depth < 20), depth, 0.0).astype(np.float32)


def depth_image(depth: np.ndarray, valid: np.ndarray | None = None) -> DepthImage:
    known = depth > 0
    return DepthImage(depth, known if valid is None else known & valid, camera(), 0.001)


def shifted(mesh: trimesh.Trimesh, *offset: float) -> trimesh.Trimesh:
    moved = mesh.copy()
    moved.apply_translation(offset)
    return moved


def floor(half: float = 2.0) -> trimesh.Trimesh:
    """A slab whose top is the plane z = 0."""
    return shifted(trimesh.creation.box((2 * half, 2 * half, 0.02)), 0, 0, -0.01)


def cube(edge: float = 0.12, at: Vector = (0.0, 0.0, 0.0)) -> trimesh.Trimesh:
    """Stands with the middle of its bottom at `at`."""
    return shifted(trimesh.creation.box((edge,) * 3), at[0], at[1], at[2] + edge / 2)


def ball(radius: float = 0.06, at: Vector = (0.0, 0.0, 0.06), detail: int = 3) -> trimesh.Trimesh:
    return shifted(trimesh.creation.icosphere(detail, radius), *at)


def stored(folder: Path, name: str, mesh: trimesh.Trimesh) -> str:
    path = folder / f"{name}.ply"
    mesh.export(path)
    return str(path)


def directional(
    direction: Vector = (0.0, 0.0, -1.0), irradiance: float = 2.0, angular_radius_deg: float = 0.0
) -> dict[str, Any]:
    return {
        "type": "directional",
        "direction": direction,
        "irradiance": irradiance,
        "angular_radius_deg": angular_radius_deg,
    }


def sphere_light(position: Vector, intensity: float = 2.0, radius: float = 0.0) -> dict[str, Any]:
    return {"type": "sphere", "position_m": position, "intensity": intensity, "radius_m": radius}


def ambient(radiance: float) -> dict[str, Any]:
    return {"type": "ambient", "radiance": radiance}


COARSE: dict[str, object] = {"cone_scale": 4, "cone_count": 4, "triangle_budget": 4000}
"""For tests of something else than the light of cones, which takes most of a picture's time."""


@dataclass
class Stage:
    """Writes assets into a folder and makes documents of them; `settings` of the method are those of all."""

    folder: Path
    settings: dict[str, object] = field(default_factory=dict)
    count: int = 0

    def asset(self, mesh: trimesh.Trimesh) -> str:
        self.count += 1
        return stored(self.folder, f"mesh{self.count}", mesh)

    def virtual(
        self,
        mesh: trimesh.Trimesh,
        base_color: Vector = (0.5, 0.5, 0.5),
        material: dict[str, Any] | None = None,
        **more: object,
    ) -> dict[str, Any]:
        material = {"base_color": base_color, "specular": 0, **(material or {})}
        return {"asset": self.asset(mesh), "material": material, **more}

    def document(
        self,
        objects: list[dict[str, Any]],
        lights: list[dict[str, Any]],
        real: trimesh.Trimesh | None = None,
        **method: object,
    ) -> SceneDocument:
        """`real`: the given model; None: the depth of each frame. Only the lights shine, nothing is learnt."""
        geometry: Any = "depth" if real is None else {"model": self.asset(real)}
        usual = {"volume_size": 32, "volume_edge_m": 0.6, "cone_scale": 1, "rsm_size": 256}
        return parse_scene(
            {
                "real": {"geometry": geometry, "unseen_albedo": 0.5},
                "objects": objects,
                "lights": {"manual": lights, "surroundings": "none"},
                "method": {**usual, **self.settings, **method},
            }
        )


def everyday(stage: Stage, **method: object) -> SceneDocument:
    """A red ball and a green box on a floor beside a wall, under a lamp and a little light from everywhere."""
    wall = shifted(trimesh.creation.box((0.02, 2, 0.6)), -0.3, 0, 0.3)
    objects = [
        stage.virtual(ball(), (0.8, 0.2, 0.1), id="ball", material={"roughness": 0.4, "specular": 0.5}),
        stage.virtual(cube(0.08, (0.12, 0.08, 0)), (0.2, 0.7, 0.2), id="box"),
    ]
    lights = [sphere_light((0.5, -0.4, 1.0), 2.0, 0.05), ambient(0.15)]
    return stage.document(objects, lights, trimesh.util.concatenate([floor(), wall]), **method)


def array_of(texture: moderngl.Texture) -> np.ndarray:
    """(h, w, components) of a texture, floats as float64."""
    kind = {"f2": np.float16, "f4": np.float32, "u1": np.uint8, "i2": np.int16}[texture.dtype]
    width, height = texture.size
    array = np.frombuffer(texture.read(alignment=1), kind).reshape(height, width, texture.components)
    return array.astype(np.float64) if texture.dtype[0] == "f" else array.copy()


@dataclass
class Fields:
    """Irradiances before composition (cones at the picture's size if cone_scale is 1), and where things are."""

    direct_mu: np.ndarray
    direct_rho: np.ndarray
    cones_mu: np.ndarray
    cones_rho: np.ndarray
    fade: np.ndarray  # of the volume, 1 inside
    on_object: np.ndarray  # irradiance of the cones on virtual surfaces
    matte: np.ndarray
    position: np.ndarray  # real surface, world; w = depth
    normal: np.ndarray
    virtual_radiance: np.ndarray


def with_neighbours(pixels: np.ndarray) -> np.ndarray:
    """Those of the pixels (h, w; bool) whose eight neighbours are among them too: joined cones look there."""
    return np.asarray(binary_erosion(pixels, np.ones((3, 3), bool), border_value=1))


OWN_RADIANCE = ("image-based radiance", "precomputed radiance", "object radiance")
"""Stages that shade the objects; the first of them in a graph does."""


def fields_of(renderer: SceneRenderer) -> Fields:
    """What the graph of the newest frame holds."""
    graph = renderer.graph
    assert graph is not None
    cones = graph["refracted cones" if "refracted cones" in graph else "cones"]
    direct, real = graph["direct light"], graph["real surface"].surface
    cones_rho = array_of(cones.rho)
    return Fields(
        array_of(direct.light.mu)[..., :3],
        array_of(direct.light.rho)[..., :3],
        array_of(cones.mu)[..., :3],
        cones_rho[..., :3],
        cones_rho[..., 3],
        array_of(cones.virtual)[..., :3],
        array_of(graph["object surface"].coverage.texture)[..., 0],
        array_of(real.position),
        array_of(real.normal)[..., :3],
        array_of(graph[next(name for name in OWN_RADIANCE if name in graph)])[..., :3],
    )


def solve(gpu: GpuContext, document: SceneDocument, view: ViewFrame | None = None) -> Fields:
    """Fields of one frame by a renderer of its own."""
    renderer = SceneRenderer(gpu, document)
    renderer.render(frame() if view is None else view)
    found = fields_of(renderer)
    renderer.release()
    return found


def composite(gpu: GpuContext, document: SceneDocument, view: ViewFrame | None = None) -> np.ndarray:
    """Picture of one frame by a renderer of its own."""
    renderer = SceneRenderer(gpu, document)
    color = renderer.render(frame() if view is None else view).color
    renderer.release()
    return color


def psnr_db(a: np.ndarray, b: np.ndarray) -> float:
    """Of two pictures of codes; infinite if they are the same."""
    error = np.mean((a.astype(float) - b.astype(float)) ** 2)
    return float("inf") if error == 0 else float(10 * np.log10(255**2 / error))


def pass_times_ms(renderer: SceneRenderer) -> dict[str, float]:
    """Times of the newest frame's passes: of a GPU, composites carry those of an earlier frame."""
    assert renderer.graph is not None
    timers = renderer.graph.timers
    assert timers is not None
    timers.wait()
    return dict(timers.times_ms)


def unlit(document: SceneDocument) -> SceneDocument:
    """Objects are drawn, and nothing else about the picture changes."""
    return document.replaced(method=NoneMethod())


class ObjectsRenderer:
    """Draws the objects of one `unlit` scene after the other: kernels are compiled once for all.

    Each picture is the first of its real scene, whose mesh is coarse: nothing but voxels is made of it.
    """

    def __init__(self, gpu: GpuContext, stage: Stage) -> None:
        document = stage.document([stage.virtual(cube())], [ambient(0.2)], triangle_budget=1000)
        self.renderer = SceneRenderer(gpu, document, with_linear=True)  # `none` keeps its budget

    def draw(self, document: SceneDocument, view: ViewFrame) -> CompositeFrame:
        assert isinstance(document.method, NoneMethod)
        another = document.replaced(real=document.real.replaced(unseen_albedo=0.25))
        self.renderer.set_scene(another)  # forgets what was seen
        self.renderer.set_scene(document)
        return self.renderer.render(view)

    def linear(self, document: SceneDocument, view: ViewFrame) -> np.ndarray:
        linear = self.draw(document, view).linear
        assert linear is not None
        return linear

    def coverage(self, document: SceneDocument, view: ViewFrame) -> np.ndarray:
        """Share of each pixel that objects cover."""
        self.draw(document, view)
        return self.newest_coverage()

    def newest_coverage(self) -> np.ndarray:
        graph = self.renderer.graph
        assert graph is not None
        return array_of(graph["object surface"].coverage.texture)[..., 0]


def sent_flux(renderer: SceneRenderer) -> float:
    """Flux of all beams that leave the objects, as shaders/common/sent_beams.glsl packs them."""
    assert renderer.graph is not None
    data = renderer.graph["caustic beams"].beams.bindings["SentBeams"].read()
    count = int(np.frombuffer(data[:4], np.uint32)[0])
    beams = np.frombuffer(data, np.float32, count * SENT_BEAM_BYTES // 4, HEADER_BYTES)
    return float(beams.reshape(count, -1)[:, 8].sum())
