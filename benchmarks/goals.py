"""What cone tracing reaches of the goals of docs/method.md 7.2.

`python -m deltalight.benchmarks.goals` takes minutes in software.
"""

import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import moderngl
import numpy as np
import trimesh
from jaxtyping import Bool, Float32, Float64
from rich.console import Console
from rich.table import Table

from deltalight.benchmarks.ground_truth.parts import Matrix, looking, placed, turned
from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.frames import BoardPose, DepthImage, ViewFrame
from deltalight.protocol.scene import SceneDocument, parse_scene
from deltalight.render_server.gpu.context import GpuContext, create_context
from deltalight.render_server.graph import Graph
from deltalight.render_server.renderer import SceneRenderer

WIDTH, HEIGHT, FOCAL = 160, 120, 150.0
WORLD_FROM_CAMERA = looking((0.25, -0.9, 0.65), (0.0, 0.0, 0.06))
METHOD = {
    "volume_size": 32,
    "volume_edge_m": 0.7,
    "cone_scale": 1,
    "rsm_size": 512,
    "triangle_budget": 40_000,
}
GREY = 150  # code of the picture
SURROUNDINGS = 0.25  # radiance, over the floor that a depth camera sees
INSIDE = 0.99  # of the delta, which fades towards the volume's border
DEPTH_NOISE_M = 0.003  # at 1 m; grows with the square of the distance
DEPTH_GOAL = 0.02


@dataclass(frozen=True, eq=False)
class LightChange:
    """What objects change of the lights' irradiance and of the cones'. `inside`: real surfaces in the volume."""

    direct: Float64[np.ndarray, "h w 3"]
    cones: Float64[np.ndarray, "h w 3"]
    inside: Bool[np.ndarray, "h w"]


@dataclass(frozen=True)
class Difference:
    """Of one change from another, relative to that one: of the means, and pixel by pixel (RMS)."""

    mean: float
    rms: float


@dataclass(frozen=True)
class Goal:
    """The mean change may differ by `bound` under other settings, or where the scene is turned against the voxels."""

    bound: float
    settings: Mapping[str, object]
    reference: Mapping[str, object] = field(default_factory=dict)
    turn_deg: float = 0.0


GOALS = {
    "light maps of 256 texels, not 512": Goal(0.02, {"rsm_size": 256}),
    "light maps of 1024 texels, not 512": Goal(0.02, {"rsm_size": 1024}),
    "volume of 32 voxels, not 64": Goal(0.05, {"volume_size": 32}, {"volume_size": 64}),
    "volume of 128 voxels, not 64": Goal(0.05, {"volume_size": 128}, {"volume_size": 64}),
    "scene turned by 20 degrees": Goal(0.05, {"volume_size": 64}, {"volume_size": 64}, 20.0),
    "scene turned by 45 degrees": Goal(0.05, {"volume_size": 64}, {"volume_size": 64}, 45.0),
}


@dataclass(frozen=True, eq=False)
class Rooms:
    """What objects change in the room (`change_in_room`), rendered once for each of the settings."""

    gpu: GpuContext
    folder: Path
    _found: dict[tuple[object, ...], LightChange] = field(default_factory=dict)

    def change(self, settings: Mapping[str, object], turn_deg: float = 0.0) -> LightChange:
        """Returns the change under these settings."""
        key = (*sorted(settings.items()), turn_deg)
        if key not in self._found:
            self._found[key] = change_in_room(self.gpu, self.folder, settings, turn_deg)
        return self._found[key]


def differences(rooms: Rooms, goal: Goal) -> dict[str, Difference]:
    """How much direct light and that of cones differ between a goal's two scenes."""
    reference = rooms.change(goal.reference)
    other = rooms.change(goal.settings, goal.turn_deg)
    inside = reference.inside & other.inside
    return {
        "direct": _difference(reference.direct[inside], other.direct[inside]),
        "cones": _difference(reference.cones[inside], other.cones[inside]),
    }


def _difference(reference: Float64[np.ndarray, "k 3"], other: Float64[np.ndarray, "k 3"]) -> Difference:
    rms = np.sqrt(np.mean((other - reference) ** 2) / np.mean(reference**2))
    return Difference(abs(float(other.mean() / reference.mean()) - 1), float(rms))


def change_in_room(
    gpu: GpuContext, folder: Path, settings: Mapping[str, object], turn_deg: float = 0.0
) -> LightChange:
    """What a ball and a cube change beside a wall, under a lamp and light from everywhere; all turned about z."""
    turn = turned("z", turn_deg)
    document = _room(folder, settings, turn)
    with _rendered(gpu, document, _frame(GREY, turn @ WORLD_FROM_CAMERA)) as graph:
        direct, cones = graph["direct light"], graph["cones"]
        mu, rho = _texels(cones.mu), _texels(cones.rho)
        uncovered = _texels(graph["object surface"].coverage.texture)[..., 0] == 0
        change = _texels(direct.light.rho) - _texels(direct.light.mu)
    return LightChange(change[..., :3], (rho - mu)[..., :3], uncovered & (rho[..., 3] > INSIDE))


def floor_irradiance(gpu: GpuContext, folder: Path, noise_m: float) -> Float64[np.ndarray, " n"]:
    """Irradiance of an open floor under radiance R from everywhere, as a depth camera sees it, in units of pi R."""
    buried = _mesh(folder, "buried", trimesh.creation.box((0.02,) * 3), placed((0.0, 0.0, -0.29)))
    lights = [{"type": "ambient", "radiance": SURROUNDINGS}]
    method = {**METHOD, "volume_size": 64, "volume_edge_m": 0.9}
    document = _document("depth", [buried], lights, method)
    depth = _floor_depth()
    noise = np.random.default_rng(0).normal(size=depth.shape) * noise_m * depth**2
    measured = np.where(depth > 0, depth + noise, 0).astype(np.float32)
    seen = DepthImage(measured, measured > 0, _camera(), 0.001)
    with _rendered(gpu, document, _frame(0, WORLD_FROM_CAMERA, seen)) as graph:
        cones = graph["cones"]
        inside = _texels(cones.rho)[..., 3] > INSIDE
        irradiance = _texels(cones.mu)[inside][:, :3].mean(axis=1)
    return np.asarray(irradiance / (np.pi * SURROUNDINGS))


@contextmanager
def _rendered(gpu: GpuContext, document: SceneDocument, frame: ViewFrame) -> Iterator[Graph]:
    """The graph of one frame."""
    renderer = SceneRenderer(gpu, document)
    renderer.render(frame)
    assert renderer.graph is not None
    yield renderer.graph
    renderer.release()


def _texels(texture: moderngl.Texture) -> Float64[np.ndarray, "h w c"]:
    values = np.frombuffer(texture.read(alignment=1), np.float16)
    return values.reshape(texture.height, texture.width, texture.components).astype(np.float64)


def _room(folder: Path, settings: Mapping[str, object], turn: Matrix) -> SceneDocument:
    boxes = (((2.0, 2.0, 0.02), (0.0, 0.0, -0.01)), ((0.02, 1.0, 0.5), (-0.2, 0.0, 0.25)))
    real = trimesh.util.concatenate(
        [trimesh.creation.box(size).apply_transform(placed(middle)) for size, middle in boxes]
    )
    objects = [
        _mesh(folder, "ball", trimesh.creation.icosphere(3, 0.06), turn @ placed((0.0, 0.0, 0.06))),
        _mesh(folder, "cube", trimesh.creation.box((0.08,) * 3), turn @ placed((0.12, 0.08, 0.04))),
    ]
    lamp_m = (turn @ (0.5, -0.4, 1.0, 1.0))[:3].tolist()
    lights: list[dict[str, Any]] = [
        {"type": "sphere", "position_m": lamp_m, "intensity": 2.0, "radius_m": 0.05},
        {"type": "ambient", "radiance": 0.3},
    ]
    model = {"model": _mesh(folder, "room", real, turn)}
    return _document(model, objects, lights, {**METHOD, **settings})


def _mesh(folder: Path, name: str, mesh: trimesh.Trimesh, place: Matrix) -> str:
    path = folder / f"{name}.ply"
    mesh.copy().apply_transform(place).export(path)
    return str(path)


def _document(
    geometry: object,
    assets: list[str],
    lights: list[dict[str, Any]],
    method: Mapping[str, object],
) -> SceneDocument:
    """Grey, diffuse objects under these lights; nothing is learnt from the frame."""
    material = {"base_color": (0.5, 0.5, 0.5), "specular": 0}
    return parse_scene(
        {
            "real": {"geometry": geometry, "unseen_albedo": 0.5},
            "objects": [{"asset": asset, "material": material} for asset in assets],
            "lights": {"manual": lights, "surroundings": "none"},
            "method": method,
        }
    )


def _camera() -> CameraModel:
    matrix = np.array([[FOCAL, 0, (WIDTH - 1) / 2], [0, FOCAL, (HEIGHT - 1) / 2], [0, 0, 1]])
    return CameraModel(WIDTH, HEIGHT, matrix, "plumb_bob", np.zeros(5))


def _frame(code: int, world_from_camera: Matrix, depth: DepthImage | None = None) -> ViewFrame:
    color = np.full((HEIGHT, WIDTH, 3), code, np.uint8)
    pose = BoardPose(world_from_camera)
    return ViewFrame(frame_id=0, timestamp_ns=0, color=color, camera=_camera(), depth=depth, pose=pose)


def _floor_depth() -> Float32[np.ndarray, "h w"]:
    """Depth of the plane z = 0 at each pixel."""
    rays = np.dstack([_camera().rays(), np.ones((HEIGHT, WIDTH))])
    return np.asarray(-WORLD_FROM_CAMERA[2, 3] / (rays @ WORLD_FROM_CAMERA[2, :3]), np.float32)


def _row(name: str, goal: float, found: Mapping[str, Difference]) -> tuple[str, ...]:
    verdict = "reached" if all(part.mean <= goal for part in found.values()) else "missed"
    cells = (f"{part.mean:.1%} ({part.rms:.1%})" for part in found.values())
    return name, f"{goal:.0%}", *cells, verdict


def main() -> None:
    """Measures and prints."""
    table = Table(title="What objects change, mean (pixel by pixel, RMS)")
    table.add_column("independence of")
    for head in ("goal", "direct light", "cones", "goal is"):
        table.add_column(head, justify="right")
    gpu = create_context()
    with tempfile.TemporaryDirectory() as path:
        folder = Path(path)
        rooms = Rooms(gpu, folder)
        for name, goal in GOALS.items():
            table.add_row(*_row(name, goal.bound, differences(rooms, goal)))
        for noise_m in (0.0, DEPTH_NOISE_M):
            off = abs(floor_irradiance(gpu, folder, noise_m).mean() - 1)
            verdict = "reached" if off <= DEPTH_GOAL else "missed"
            name = f"depth noise of {1e3 * noise_m:.0f} mm at 1 m (E / pi R of a floor)"
            table.add_row(name, f"{DEPTH_GOAL:.0%}", "", f"{off:.1%}", verdict)
    Console().print(table)
    gpu.release()


if __name__ == "__main__":
    main()
