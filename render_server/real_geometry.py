"""The real scene's triangles: meshed from the frame's depth, fused from all frames, or given as a model."""

from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.scene_objects import ModelGeometry, RealScene
from deltalight.render_server.frame import Measurement, Scan
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu_scene import GeometryState
from deltalight.render_server.passes.gbuffer import MaterialTable, MeshBuffers, triangle_corners
from deltalight.render_server.scene.depth_mesh import depth_mesh
from deltalight.render_server.scene.depth_surface import (
    DepthSurface,
    depth_surface,
    grazing_depth_fill,
    noise_sigma,
)
from deltalight.render_server.scene.mesh_loading import load_mesh
from deltalight.render_server.scene.motion_detection import FrameSamples, KeptWorld, MotionDetector
from deltalight.render_server.scene.triangle_mesh import TriangleMesh, merge_for_gpu
from deltalight.render_server.scene.tsdf_mesh import TsdfScene
from deltalight.render_server.view import CameraView, PosedFrame

COARSE_DIVISOR = 8  # of the triangles, for the coarse volume: its voxels are several times larger
BOUND_POINTS = 4000  # sampled from a mesh for fitting light views
# Frames averaged while nothing moves: their noise is a quarter of one frame's. Then the average is frozen, so
# that a scene at rest gives the same picture bit for bit.
STILL_FRAMES = 16
# A voxel's surface cuts the corner where two surfaces meet at a right angle, by up to sqrt(2) / 4 of its edge.
ROUNDED_VOXELS = 0.35


# A kept world that explains the picture no longer is renewed no more often than this,
RENEWAL_NS = 400_000_000
# one that does once all has been at rest for so long: a camera that only pauses must not wait for it.
SETTLING_NS = 1_500_000_000


class RealGeometry:
    """Holds the real scene, and rebuilds it when it moves (MotionDetector).

    With `keeps_world`, only when what was built no longer explains what the camera sees (KeptWorld), and once more
    from the frame in which everything comes to rest. `state` is a new object whenever the triangles change, `seen`
    (the frame) whenever anything moved, the camera included.
    """

    def __init__(
        self, gpu: GpuContext, real: RealScene, triangle_budget: int, *, keeps_world: bool = False
    ) -> None:
        self._gpu = gpu
        self.budget = triangle_budget
        self._motion = MotionDetector()
        self._kept = KeptWorld() if keeps_world else None
        self._last: FrameSamples | None = None  # in which anything moved
        self._buffers = MeshBuffers(gpu)
        self._materials: MaterialTable | None = None
        self.state: GeometryState | None = None
        self.material_names: tuple[str, ...] = ()
        self.is_model = isinstance(real.geometry, ModelGeometry)
        self.seen: PosedFrame | None = None
        self._built_from: PosedFrame | None = None
        self._surfaces: dict[PosedFrame, DepthSurface] = {}
        self._scans: dict[PosedFrame, Scan] = {}
        self._measurements: dict[tuple[int, int], Measurement] = {}
        self._world_from_tsdf = np.eye(4)
        self._tsdf_meshes: tuple[list[TriangleMesh], list[TriangleMesh]] = [], []
        self._tsdf = TsdfScene() if real.geometry == "fused" else None
        self._still_frames = 0
        self.model: list[TriangleMesh] = []
        if isinstance(real.geometry, ModelGeometry):
            self.model = self._load_model(real.geometry)
            self.material_names = tuple(mesh.material.name for mesh in self.model)

    def _load_model(self, model: ModelGeometry) -> list[TriangleMesh]:
        matrix = model.pose.matrix()
        return [mesh.transformed(matrix) for mesh in load_mesh(Path(model.model))]

    @property
    def has_unseen(self) -> bool:
        """Whether surfaces exist that the camera may not see: those of a model or of earlier frames."""
        return self.is_model or self._tsdf is not None

    def measurement(self, size: tuple[int, int]) -> Measurement:
        """Returns the frame that the real scene was last built from, at a picture's size, always the same object."""
        if size not in self._measurements:
            assert self._built_from is not None
            taken = self._built_from.at(size)
            self._measurements[size] = Measurement(taken.frame, taken.view, self._scan_of(taken))
        return self._measurements[size]

    @property
    def is_settled(self) -> bool:
        """Whether a kept world was built from the frame in which everything came to rest."""
        return self._kept is not None and self._kept.built_from is self._last

    def scan(self, size: tuple[int, int]) -> Scan:
        """Returns the camera's measurement from when something last moved, at a picture's size."""
        assert self.seen is not None
        return self._scan_of(self.seen.at(size))

    def _scan_of(self, taken: PosedFrame) -> Scan:
        if taken not in self._scans:
            self._scans[taken] = self._scanned(taken)
        return self._scans[taken]

    def _scanned(self, taken: PosedFrame) -> Scan:
        """Collects depth, its noise, and the tolerance of the fused surface. A model has no noise.

        Three standard deviations of the noise cover at least what voxels round off.
        """
        depth, fitted = None if self.is_model else taken.frame.depth, partial(self._surface_of, taken)
        if depth is None:
            return Scan(None, fitted, 0.0, 1.0, None)
        known = depth.depth_m[depth.valid]
        typical_depth = float(np.median(known)) if known.size else 1.0
        rounded_m = 0.0 if self._tsdf is None else ROUNDED_VOXELS * self._tsdf.voxel_m
        sigma = max(noise_sigma(depth), rounded_m / (3 * typical_depth**2))
        # The fused surface agrees with depth up to half a voxel, and three standard deviations of the depth's noise.
        tolerance = None if self._tsdf is None else (0.5 * self._tsdf.voxel_m, 3 * sigma)
        return Scan(depth, fitted, sigma, typical_depth, tolerance)

    def _surface_of(self, taken: PosedFrame) -> DepthSurface:
        """Returns the surface fitted to a frame's depth."""
        if taken not in self._surfaces:
            assert taken.frame.depth is not None
            self._surfaces[taken] = depth_surface(taken.frame.depth, taken.view.camera)
        return self._surfaces[taken]

    def update(self, taken: PosedFrame) -> bool:
        """Updates the geometry from the frame if something moved; returns whether it did.

        Raises:
            DeltalightError: the scene requires depth and the frame has none.
        """
        if not self.is_model and taken.frame.depth is None:
            raise DeltalightError(
                "The source has no depth: record depth, or give the scene a model (`real: {geometry: {model: ...}}`)."
            )
        samples = FrameSamples.of(taken.frame)
        # Depth without a surface (a camera that starts) explains nothing: the next frame counts as another scene.
        moved = self._motion.update(samples) or self.state is None
        if moved:
            self._last, self.seen = samples, taken
            self._surfaces.clear()
            self._scans.clear()
        if self._kept is not None and not self._is_due(self._kept, samples, moved=moved):
            return moved
        return self._rebuild(taken, moved=moved)

    def _is_due(self, kept: KeptWorld, samples: FrameSamples, *, moved: bool) -> bool:
        """Returns whether a kept world must be rebuilt: it explains the frame no longer, or all came to rest."""
        built, last = kept.built_from, self._last
        if built is None or self.state is None:
            return True
        if moved:
            too_soon = abs(samples.frame.timestamp_ns - built.frame.timestamp_ns) < RENEWAL_NS
            return not too_soon and not kept.explains(samples)
        if built is last:
            return self._tsdf is not None  # which averages some more frames
        assert last is not None
        wait_ns = SETTLING_NS if kept.explains(last) else RENEWAL_NS
        return samples.frame.timestamp_ns - last.frame.timestamp_ns >= wait_ns

    def _rebuild(self, taken: PosedFrame, *, moved: bool) -> bool:
        """Builds the real scene from the frame in which anything last moved; returns whether it changed."""
        if self._kept is not None and self._kept.built_from is not self._last:
            assert self.seen is not None
            taken, moved = self.seen, True
            self._kept.built_from = self._last
        if self._tsdf is not None:
            changed = self._integrate(self._tsdf, taken, moved)
        else:
            changed = moved
            if moved and self.is_model and self.state is None:
                self._build(self.model, None)
            elif moved and not self.is_model:
                self._build_from_depth(taken)
        if changed:
            self._built_from = self.seen
            self._scans.clear()
            self._measurements.clear()
        return changed

    def _integrate(self, tsdf: TsdfScene, taken: PosedFrame, moved: bool) -> bool:
        """Integrates a frame unless the scene has been at rest for long; returns whether anything changed."""
        self._still_frames = 0 if moved else self._still_frames + 1
        if self._still_frames > STILL_FRAMES:
            return False
        pose, depth = taken.frame.pose, taken.frame.depth
        assert depth is not None
        renewed = tsdf.add(
            self._surface_of(taken),
            taken.view,
            noise_sigma(depth),
            align=pose is not None and pose.reprojection_error_px is not None,
            settle=self._still_frames == STILL_FRAMES,
        )
        if renewed:
            fine, coarse = tsdf.meshes(self.budget, self.budget // COARSE_DIVISOR)
            self._tsdf_meshes = fine, coarse
        displaced = moved and self._realign(tsdf, taken.view)
        if renewed or displaced:
            self._build_from_tsdf()
        return moved or renewed

    def _realign(self, tsdf: TsdfScene, view: CameraView) -> bool:
        """Aligns the fused surface to this frame's pose; returns whether that moved it.

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
            [mesh.transformed(self._world_from_tsdf) for mesh in meshes] for meshes in self._tsdf_meshes
        )
        if not any(len(mesh.triangles) for mesh in coarse):
            self.state = None
            return
        self._build(fine, triangle_corners(merge_for_gpu(coarse)))

    def _build_from_depth(self, taken: PosedFrame) -> None:
        """Meshes the depth image, and a second time with few triangles for geometry far from the objects."""
        depth, camera, place = taken.frame.depth, taken.view.camera, taken.view.world_from_camera
        assert depth is not None
        surface = self._surface_of(taken)
        grazing = grazing_depth_fill(depth, taken.frame.color, camera)
        fine, coarse = (
            depth_mesh(depth, camera, place, budget, surface, grazing=grazing)
            for budget in (self.budget, self.budget // COARSE_DIVISOR)
        )
        if not len(fine.triangles):
            self.state = None
            return
        self._build([fine], triangle_corners(merge_for_gpu([coarse])), is_open=True)

    def _build(
        self,
        meshes: list[TriangleMesh],
        coarse_corners: Float32[np.ndarray, "k 3 10"] | None,
        *,
        is_open: bool = False,
    ) -> None:
        """Merges the meshes and uploads them."""
        merged = merge_for_gpu(meshes)
        self._buffers.write(merged)
        if self._materials is None:
            self._materials = MaterialTable(self._gpu, merged, draws_maps=False)
        self.state = GeometryState(
            self._buffers,
            triangle_corners(merged),
            _sample(merged.vertices[:, :3]),
            self._materials,
            coarse_corners,
            is_open=is_open,
        )

    def release(self) -> None:
        """Frees the GL objects."""
        self._buffers.release()
        if self._materials is not None:
            self._materials.release()


def _sample(positions: np.ndarray) -> Float64[np.ndarray, "n 3"]:
    """Returns at most BOUND_POINTS of the positions, including the extremes of each axis."""
    stride = max(1, len(positions) // BOUND_POINTS)
    extremes = np.concatenate([positions.argmin(axis=0), positions.argmax(axis=0)])
    return np.concatenate([positions[::stride], positions[extremes]]).astype(np.float64)
