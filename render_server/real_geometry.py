"""The real scene's triangles: meshed from the frame's depth, fused from all frames, or given as a model."""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.scene_objects import ModelGeometry, RealScene
from deltalight.render_server.camera_history import CameraHistory
from deltalight.render_server.geometry_state import ChooseBacks, DrawnMesh, GeometryState
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.passes.depth_mesh import DepthFrame, DepthMesher
from deltalight.render_server.passes.mesh_buffers import MaterialTable, MeshBuffers
from deltalight.render_server.passes.voxelize import Chosen
from deltalight.render_server.scene.depth_mesh import BACK_OFFSET_VOXELS, BOUND_POINTS, REAL_MATERIAL
from deltalight.render_server.scene.depth_surface import noise_sigma
from deltalight.render_server.scene.depth_views import PosedSurface
from deltalight.render_server.scene.gpu_mesh import GpuMesh, merge_for_gpu
from deltalight.render_server.scene.mesh_loading import load_mesh
from deltalight.render_server.scene.moved_meshes import transformed
from deltalight.render_server.scene.seen_depth import Grazing, SeenDepth
from deltalight.render_server.scene.threads import submit
from deltalight.render_server.scene.triangle_mesh import TriangleMesh
from deltalight.render_server.scene.tsdf_mesh import TsdfScene
from deltalight.render_server.view import CameraView, PosedFrame

COARSE_DIVISOR = 8  # of the triangles, for the coarse volume: its voxels are several times larger
# Frames averaged while nothing moves: their noise is a quarter of one frame's. Then the average is frozen, so
# that a scene at rest gives the same picture bit for bit.
STILL_FRAMES = 16
EMPTY_MESH = TriangleMesh(
    np.zeros((0, 3), np.float32),
    np.zeros((0, 3), np.float32),
    np.zeros((0, 3), np.int32),
    None,
    REAL_MATERIAL,
)


class RealGeometry:
    """Holds the real scene of all cameras in a room, and rebuilds it when it moves (CameraHistory).

    `state` is a new object whenever the triangles change. `cameras` are in the order of the frames. `meshes_on_gpu`:
    the GPU makes the triangles of depth; default: if it is one, because numpy is quicker than Mesa's software
    renderer.
    """

    def __init__(
        self,
        gpu: GpuContext,
        real: RealScene,
        triangle_budget: int,
        *,
        keeps_world: bool = False,
        meshes_on_gpu: bool | None = None,
    ) -> None:
        self._gpu = gpu
        on_gpu = not gpu.is_software if meshes_on_gpu is None else meshes_on_gpu
        self._mesher = DepthMesher(gpu) if on_gpu else None
        self.budget = triangle_budget
        self._keeps_world = keeps_world
        self._buffers, self._coarse_buffers = MeshBuffers(gpu), MeshBuffers(gpu)
        self._materials: MaterialTable | None = None
        self.state: GeometryState | None = None
        self.material_names: tuple[str, ...] = ()
        self.is_model = isinstance(real.geometry, ModelGeometry)
        self.cameras: list[CameraHistory] = []
        self._world_from_tsdf = np.eye(4)
        self._tsdf_meshes: tuple[list[TriangleMesh], list[TriangleMesh]] = [], []
        self._tsdf = TsdfScene() if real.geometry == "fused" else None
        self._still_frames = 0
        self._used_coarse = False  # of the state before
        self.model: list[TriangleMesh] = []
        if isinstance(real.geometry, ModelGeometry):
            self.model = self._load_model(real.geometry)
            self.material_names = tuple(mesh.material.name for mesh in self.model)

    def _load_model(self, model: ModelGeometry) -> list[TriangleMesh]:
        matrix = model.pose.matrix()
        return [transformed(mesh, matrix) for mesh in load_mesh(Path(model.model))]

    @property
    def has_unseen(self) -> bool:
        """Whether surfaces exist that the camera may not see: those of a model or of earlier frames."""
        return self.is_model or self._tsdf is not None

    @property
    def is_settled(self) -> bool:
        """Whether a kept world was built from the frames in which everything came to rest."""
        return all(camera.is_settled for camera in self.cameras)

    def expect(self, taken: Sequence[PosedFrame]) -> None:
        """Begins to look at the frames that `update` is given next, on other threads."""
        for camera, each in zip(self.cameras, taken, strict=False):
            camera.expect(each)

    def update(self, taken: Sequence[PosedFrame]) -> bool:
        """Updates the geometry from a frame of each camera if something moved; returns whether it did.

        Raises:
            DeltalightError: the scene requires depth and a frame has none.
        """
        if not self.is_model and any(each.frame.depth is None for each in taken):
            raise DeltalightError(
                "The source has no depth: record depth, or give the scene a model (`real: {geometry: {model: ...}}`)."
            )
        if len(taken) != len(self.cameras):
            self.cameras = [self._new_camera() for _ in taken]
        pairs, is_unknown = list(zip(self.cameras, taken, strict=True)), self.state is None
        moved = [camera.update(each, is_unknown=is_unknown) for camera, each in pairs]
        if not any(camera.is_due(is_unknown=is_unknown) for camera in self.cameras):
            return any(moved)
        return self._rebuild([camera.renew(each) for camera, each in pairs])

    def _new_camera(self) -> CameraHistory:
        on_gpu = None if self._mesher is None else self._mesher.fitted
        return CameraHistory(keeps_world=self._keeps_world, has_depth=not self.is_model, on_gpu=on_gpu)

    def _rebuild(self, taken: Sequence[PosedFrame]) -> bool:
        """Builds the real scene from the frames in which anything last moved; returns whether it changed."""
        changed = moved = any(camera.moved for camera in self.cameras)
        if self._tsdf is not None:
            changed = self._integrate(self._tsdf, taken, moved=moved)
        elif moved and self.is_model and self.state is None:
            self._build(self.model, None)
        elif moved and not self.is_model:
            self._build_from_depth()
        if changed:
            for camera in self.cameras:
                camera.set_built()
        return changed

    def _integrate(self, tsdf: TsdfScene, taken: Sequence[PosedFrame], *, moved: bool) -> bool:
        """Integrates the frames unless the scene has been at rest for long; returns whether anything changed."""
        self._still_frames = 0 if moved else self._still_frames + 1
        if self._still_frames > STILL_FRAMES:
            return False
        renewed = tsdf.add(
            *(_posed_surface(camera, each) for camera, each in zip(self.cameras, taken, strict=True)),
            settle=self._still_frames == STILL_FRAMES,
        )
        for camera in self.cameras:
            camera.voxel_m = tsdf.voxel_m
        if renewed:
            fine, coarse = tsdf.meshes(self.budget, self.budget // COARSE_DIVISOR)
            self._tsdf_meshes = fine, coarse
        displaced = moved and self._realign(tsdf, taken[0].view)
        if renewed or displaced:
            self._build_from_tsdf()
        return moved or renewed

    def _realign(self, tsdf: TsdfScene, view: CameraView) -> bool:
        """Aligns the fused surface to the first camera's pose; returns whether that moved it.

        The picture is rendered with the frame's pose, so the surface must lie where that pose places the
        frame's depth.
        """
        assert tsdf.view is not None
        before = self._world_from_tsdf
        exact = tsdf.view is view
        self._world_from_tsdf = np.eye(4) if exact else view.world_from_camera @ tsdf.view.camera_from_world
        return not np.array_equal(before, self._world_from_tsdf)

    def _build_from_tsdf(self) -> None:
        fine, coarse = (
            [transformed(mesh, self._world_from_tsdf) for mesh in meshes] for meshes in self._tsdf_meshes
        )
        if not any(len(mesh.triangles) for mesh in coarse):
            self.state = None
            return
        self._build(fine, lambda: self._uploaded(merge_for_gpu(coarse)))

    def _build_from_depth(self) -> None:
        """Meshes the depth images, and with few triangles again once geometry far from the objects is asked for.

        What several cameras see is kept of the one that shows it largest.
        """
        frames = [camera.moved_frame for camera in self.cameras]
        surfaces = [partial(_posed_surface, *each) for each in zip(self.cameras, frames, strict=True)]
        seen = SeenDepth(frames, surfaces)
        budget = self.budget // len(frames)  # of the room, however many cameras see it
        if self._mesher is not None:
            self._mesh_on_gpu(self._mesher, seen, (budget, budget // COARSE_DIVISOR))
            return
        coarse = self._begun_coarse(lambda: merge_for_gpu(seen.meshes(budget // COARSE_DIVISOR)))
        fine = seen.meshes(budget)
        if not any(len(mesh.triangles) for mesh in fine):
            self.state = None
            return

        def choose_backs(mesh: DrawnMesh, voxel_edge: float) -> Chosen:
            return seen.without_backs_in_sight(mesh.corners, voxel_edge)

        self._build(fine, coarse, is_open=True, choose_backs=choose_backs if len(frames) > 1 else None)

    def _mesh_on_gpu(self, mesher: DepthMesher, seen: SeenDepth, budgets: tuple[int, int]) -> None:
        """Lets the GPU mesh the depth images; the CPU makes the same triangles only when asked for them."""
        bounds = seen.begun_bounds()
        mesher.take(list(map(_depth_frame, seen.frames, seen.grazing)), budgets)
        points = bounds()
        if not len(points):
            self.state = None
            return
        empty = merge_for_gpu([EMPTY_MESH])

        def filled() -> MeshBuffers:
            mesher.fill(self._buffers, empty)
            return self._buffers

        def made(budget: int) -> GpuMesh:
            return merge_for_gpu(seen.meshes(budget))

        def choose_backs(mesh: DrawnMesh, voxel_edge: float) -> Chosen:
            return mesher.backs_of(mesh.buffers, mesh.triangles, BACK_OFFSET_VOXELS * voxel_edge)

        # Filled as late as the triangles are needed: grazing surfaces are searched for meanwhile.
        fine = DrawnMesh(filled, partial(made, budgets[0]))
        coarse = DrawnMesh(lambda: fine.buffers, partial(made, budgets[1]), is_behind=True)
        self._show(fine, points, empty, lambda: coarse, is_open=True, choose_backs=choose_backs)

    def _begun_coarse(self, make: Callable[[], GpuMesh]) -> Callable[[], DrawnMesh]:
        """Returns what makes coarse triangles when asked; begun now if the last ones were asked for too."""
        meanwhile = submit(make) if self._used_coarse else None
        self._used_coarse = False

        def coarse() -> DrawnMesh:
            self._used_coarse = True
            return self._uploaded(make() if meanwhile is None else meanwhile.result())

        return coarse

    def _build(
        self,
        meshes: list[TriangleMesh],
        coarse: Callable[[], DrawnMesh] | None,
        *,
        is_open: bool = False,
        choose_backs: ChooseBacks | None = None,
    ) -> None:
        """Merges the meshes and uploads them."""
        merged = merge_for_gpu(meshes)
        self._buffers.write(merged)
        points = _sample(merged.vertices[:, :3])
        drawn = DrawnMesh(self._buffers, merged)
        self._show(drawn, points, merged, coarse, is_open=is_open, choose_backs=choose_backs)

    def _show(
        self,
        drawn: DrawnMesh,
        points: Float64[np.ndarray, "n 3"],
        materials: GpuMesh,
        coarse: Callable[[], DrawnMesh] | None,
        *,
        is_open: bool,
        choose_backs: ChooseBacks | None = None,
    ) -> None:
        """Sets the state."""
        if self._materials is None:
            self._materials = MaterialTable(self._gpu, materials, draws_maps=False)
        self.state = GeometryState(
            drawn, points, self._materials, coarse, is_open=is_open, choose_backs=choose_backs
        )

    def _uploaded(self, coarse: GpuMesh) -> DrawnMesh:
        """Uploads the mesh of what lies far."""
        self._coarse_buffers.write(coarse)
        return DrawnMesh(self._coarse_buffers, coarse)

    def release(self) -> None:
        """Frees the GL objects."""
        self._buffers.release()
        self._coarse_buffers.release()
        for each in (self._materials, self._mesher):
            if each is not None:
                each.release()


def _depth_frame(seen: PosedFrame, grazing: Grazing) -> DepthFrame:
    assert seen.frame.depth is not None
    return DepthFrame(seen.frame.depth, seen.view, grazing)


def _posed_surface(camera: CameraHistory, taken: PosedFrame) -> PosedSurface:
    """Returns the surface of a frame's depth; poses by a board may be aligned."""
    pose, depth = taken.frame.pose, taken.frame.depth
    assert depth is not None
    aligns = pose is not None and pose.reprojection_error_px is not None
    return PosedSurface(camera.surface_of(taken), taken.view, noise_sigma(depth), aligns)


def _sample(positions: np.ndarray) -> Float64[np.ndarray, "n 3"]:
    """Returns at most BOUND_POINTS of the positions, including the extremes of each axis."""
    stride = max(1, len(positions) // BOUND_POINTS)
    extremes = np.concatenate([positions.argmin(axis=0), positions.argmax(axis=0)])
    return np.concatenate([positions[::stride], positions[extremes]]).astype(np.float64)
