"""What compiles every variant of every shader: scenes that together need all of them.

A context's `compile_watchers` are told of each, with its defines.
"""

import itertools
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from deltalight.benchmarks.gltf_plate import Plate, even
from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.scene import SceneDocument, parse_scene
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Kernel
from deltalight.render_server.gpu.raster_kernel import RasterKernel
from deltalight.render_server.passes.caustics import TILE
from deltalight.render_server.passes.composite import Crossfade, Enlarge
from deltalight.render_server.passes.cones import reuse_define
from deltalight.render_server.passes.depth_fit import DepthFit
from deltalight.render_server.passes.depth_mesh import DepthMesher
from deltalight.render_server.passes.depth_views import DepthViewLayers
from deltalight.render_server.passes.lpv import LightVolume, LpvPropagate, lobe_weights, medium_bindings
from deltalight.render_server.passes.matting import Matting
from deltalight.render_server.passes.real_surface import RealSurface
from deltalight.render_server.renderer import SceneRenderer
from deltalight.render_server.scene.material_file import write_material
from tests.render_server.brdf_samples import grey_brdf
from tests.render_server.protected_scenes import Case, frames_of, scene_of
from tests.render_server.scenes import Stage

CASES: dict[Case, dict[str, Any]] = {  # with changes of the method
    Case("exact", "depth", "mirror"): {},
    Case("exact", "fused", "antialiased"): {
        "voxels": "isotropic",
        "coverage": "multiplied",
        "shadow": "cone",
        "volume_size": 40,
    },
    Case("exact", "depth", "antialiased"): {"quality": "live"},
    Case("paper", "depth", "mirror"): {},
    Case("paper", "depth", "antialiased"): {"quality": "live"},
    Case("differential", "depth", "mirror"): {},
    Case("dlpv", "model", "mirror"): {},
    Case("dlpv-paper", "depth", "plain"): {"direct_filter": 1},
    Case("aroof", "depth", "mirror"): {},
}
TEXTURED: dict[Case, dict[str, Any]] = {
    Case("exact", "depth", "mirror"): {},
    Case("exact", "depth", "antialiased"): {"quality": "live"},
    Case("paper", "depth", "mirror"): {},
    Case("dlpv", "model", "mirror"): {},
    Case("dlpv-paper", "depth", "plain"): {"direct_filter": 1},
    Case("aroof", "depth", "mirror"): {},
}
GLASS: dict[Case, dict[str, Any]] = {
    Case("exact", "depth", "mirror"): {},
    Case("exact", "depth", "antialiased"): {"quality": "live"},
    Case("paper", "depth", "mirror"): {},
    Case("differential", "depth", "mirror"): {},
    Case("dlpv", "model", "mirror"): {},
    Case("aroof", "depth", "mirror"): {},
}
MEASURED = (
    Case("exact", "depth", "mirror"),
    Case("exact", "depth", "antialiased"),
    Case("paper", "depth", "mirror"),
    Case("dlpv", "model", "mirror"),
)
EXTENDED: dict[Case, dict[str, Any]] = {
    Case("exact", "depth", "mirror"): {},
    Case("exact", "depth", "antialiased"): {"quality": "live"},
    Case("exact", "model", "mirror"): {"quality": "balanced"},
    Case("paper", "depth", "mirror"): {},
    Case("differential", "depth", "mirror"): {},
    Case("dlpv", "model", "mirror"): {},
    Case("dlpv-paper", "depth", "plain"): {},
    Case("aroof", "depth", "mirror"): {},
}
APART = [
    Case("exact", "model", "mirror"),
    Case("paper", "model", "mirror"),
    Case("dlpv", "model", "mirror"),
    Case("dlpv-paper", "depth", "plain"),
]
SEVERAL = [Case(method, "depth", "plain") for method in ("exact", "paper", "differential", "dlpv")]
SURFACES = [  # what materials are shaded by maps of light
    dict.fromkeys(switches, 1)
    for count in range(4)
    for switches in combinations(("EXTENDED", "MATERIAL_MAPS", "MEASURED"), count)
]
ON_GPUS = [  # with what the others lack: edges that are unmixed, objects that change the light of both sets
    Case("exact", "depth", "antialiased"),
    Case("paper", "depth", "mirror"),
    Case("dlpv", "model", "mirror"),
]
VIEWS = {
    Case("exact", "depth", "mirror"): ("effects", "delta", "volume", "rsm"),
    Case("paper", "depth", "mirror"): ("volume", "error"),
    Case("dlpv", "model", "mirror"): ("volume",),
    Case("aroof", "depth", "mirror"): ("volume",),
}


def render(case: Case, changes: dict[str, Any], gpu: GpuContext, folder: Path) -> None:
    """Renders the case's first frame, in each debug view too that VIEWS names; assets go into the folder."""
    scene = changed(scene_of(case, Stage(folder)), "method", changes)
    renderer = SceneRenderer(gpu, scene)
    try:
        for view in ("composite", *VIEWS.get(case, ())):
            renderer.set_scene(changed(scene, "output", {"view": view}))
            renderer.render(frames_of(case)[0])
    finally:
        renderer.release()


def render_on_gpu(case: Case, gpu: GpuContext, folder: Path) -> None:
    """Renders the case's first frame by a GPU's paths, wherever this runs."""
    render(case, {}, replace(gpu, is_software=False), folder)


def render_textured(case: Case, changes: dict[str, Any], gpu: GpuContext, folder: Path) -> None:
    """Renders the case's first frame with a smooth object more that has maps and holes."""
    render_with(maps_and_holes(0.1), case, changes, gpu, folder)


def render_glass(case: Case, changes: dict[str, Any], gpu: GpuContext, folder: Path) -> None:
    """Renders the case's first frame with a sheet of glass more, plain and with maps and holes."""
    transmission = {"KHR_materials_transmission": {"transmissionFactor": 1}}
    plain, textured = Plate(0.1, 0.1), maps_and_holes(0.1)
    plain.material["pbrMetallicRoughness"] = {"metallicFactor": 0, "roughnessFactor": 0}
    for plate in (plain, textured):
        plate.material["extensions"] = transmission
        render_with(plate, case, changes, gpu, folder)


def render_measured(case: Case, changes: dict[str, Any], gpu: GpuContext, folder: Path) -> None:
    """Renders the case's first frame with a measured object more, beside a plain one and one of glass with maps."""
    write_material(folder / "paint.dlmat", grey_brdf(0.2, (0.1, 0.1, 0.5)))
    measured = {
        "id": "measured",
        "asset": str(Plate(0.1, 0.1).write(folder / "measured.glb")),
        "material": {"precomputed": str(folder / "paint.dlmat")},
    }
    glass = maps_and_holes(0.1)
    glass.material["extensions"] = {"KHR_materials_transmission": {"transmissionFactor": 1}}
    for plate in (Plate(0.1, 0.1), glass):
        render_with(plate, case, changes, gpu, folder, measured)


def render_coated(case: Case, changes: dict[str, Any], gpu: GpuContext, folder: Path) -> None:
    """Renders the case's first frame with a coated sheet more: plain, with maps and holes, of glass and not."""
    over: dict[str, Any] = {
        "KHR_materials_clearcoat": {"clearcoatFactor": 1.0},
        "KHR_materials_sheen": {"sheenColorFactor": [1, 1, 1], "sheenRoughnessFactor": 0.5},
    }
    for extensions in (over, {**over, "KHR_materials_transmission": {"transmissionFactor": 1}}):
        for plate in (Plate(0.1, 0.1), maps_and_holes(0.1)):
            plate.material["extensions"] = extensions
            render_with(plate, case, changes, gpu, folder)


def maps_and_holes(edge_m: float) -> Plate:
    plate = Plate(edge_m, edge_m)
    plate.material |= {
        "alphaMode": "MASK",
        "normalTexture": plate.texture(even(128, 128, 255)),
        "pbrMetallicRoughness": {
            "baseColorTexture": plate.texture(even(255, 255, 255, 255)),
            "metallicRoughnessTexture": plate.texture(even(0, 20, 200)),
        },
    }
    return plate


def render_several(case: Case, gpu: GpuContext, folder: Path) -> None:
    """Renders the case's first frame as that of two cameras."""
    renderer = SceneRenderer(gpu, scene_of(case, Stage(folder)))
    try:
        renderer.render_views(frames_of(case)[:1] * 2)
    finally:
        renderer.release()


def render_apart(case: Case, gpu: GpuContext, folder: Path, **method: Any) -> None:  # noqa: ANN401
    """Renders the case's objects, and one that has a volume of its own, in the composite, as voxels and its error."""
    document = scene_of(case, Stage(folder)).model_dump(mode="json", exclude_unset=True)
    far = {**document["objects"][0], "id": "far", "pose": {"translation_m": [2.0, 0, 0]}}
    document["objects"].append(far)
    scene = changed(parse_scene(document), "method", method)
    renderer = SceneRenderer(gpu, scene)
    try:
        for view in ("composite", "volume", "error"):
            renderer.set_scene(changed(scene, "output", {"view": view}))
            renderer.render(frames_of(case)[0])
    finally:
        renderer.release()


def render_with(
    plate: Plate, case: Case, changes: dict[str, Any], gpu: GpuContext, folder: Path, *more: dict[str, Any]
) -> None:
    """Renders the case's first frame with the plate more, and other objects."""
    asset = {
        "id": "plate",
        "asset": str(plate.write(folder / "plate.glb")),
        "pose": {"translation_m": [0, 0, 0.2]},
    }
    document = scene_of(case, Stage(folder)).model_dump(mode="json", exclude_unset=True)
    document["objects"] += [asset, *more]
    renderer = SceneRenderer(gpu, changed(parse_scene(document), "method", changes))
    try:
        renderer.render(frames_of(case)[0])
    finally:
        renderer.release()


def changed(scene: SceneDocument, part: str, changes: dict[str, Any]) -> SceneDocument:
    document = scene.model_dump(mode="json", exclude_unset=True)
    document[part] = {**document[part], **changes}
    return parse_scene(document)


def by_device(gpu: GpuContext, folder: Path) -> None:  # noqa: ARG001
    """Compiles what software and GPUs do differently, both ways wherever this runs, and what a budget brings."""
    light, medium = LightVolume(gpu, 8), medium_bindings(8, lobe_weights(), None)
    for tiled, in_place in itertools.product((False, True), repeat=2):
        propagate = LpvPropagate(gpu, tiled=tiled)
        propagate.run(light, medium, 5, in_place=in_place)  # four in a dispatch, and one
        propagate.release()
    light.release()
    for kind in ({"FIRST": 1}, {}, {"TAIL": 1}):
        Kernel(gpu, "lpv_add_bounce", CLEARS=1, **kind).release()
        Kernel(gpu, "lpv_small_volume", BOUNCE=1, CLEARS=1, **kind).release()
    for kind in ({"STARTS": 1}, {"CHANGE": 1}, {}):
        Kernel(gpu, "lpv_small_volume", **kind).release()
    Kernel(gpu, "clear_buffer").release()
    for kind in ({}, {"FUSED": 1}, {"LISTED": 1}):
        Kernel(gpu, "filter_voxels", **kind).release()
    for kind in ({}, {"FUSED": 1}):
        Kernel(gpu, "filter_isotropic", DIRECTIONS=1, **kind).release()
    for rows in (2, 8):
        for reuses in (False, True):
            Kernel(
                gpu, "caustic_gather", ROWS=rows, GROUP_ROWS=TILE // rows, **reuse_define(reuses)
            ).release()
    for fits in (False, True):
        RealSurface(gpu, (16, 16), fits_depth=fits).release()
    Kernel(gpu, "real_surface", FITS_DEPTH=1, DECLARED_SURFACES=1).release()
    DepthFit(gpu, (16, 16)).release()
    DepthMesher(gpu).release()
    for defines in ({"GRAZING": 1}, {"SEVERAL_DEPTHS": 1}, {"GRAZING": 1, "SEVERAL_DEPTHS": 1}):
        Kernel(gpu, "depth_nodes", **defines).release()
    DepthViewLayers(gpu, [CameraModel(16, 16, np.eye(3))]).release()
    Enlarge(gpu, (16, 16)).release()
    Crossfade(gpu, (16, 16)).release()


def image_based(gpu: GpuContext, folder: Path) -> None:  # noqa: ARG001
    """Compiles image-based shading, without and with a lens that bends, materials with maps and measured ones."""
    for defines in ({}, {"lens_bends": 1}):
        Kernel(gpu, "ambient_occlusion", **defines).release()
    for switches in SURFACES:
        Kernel(gpu, "image_based_radiance", **switches).release()


def precomputed_transfer(gpu: GpuContext, folder: Path) -> None:  # noqa: ARG001
    """Compiles shading by precomputed transfer, without and with materials that have maps or are measured."""
    for switches in SURFACES:
        Kernel(gpu, "image_based_radiance", PRECOMPUTED=1, **switches).release()
    Kernel(gpu, "transfer_light").release()
    RasterKernel(gpu, "transfer_raster").release()


def soft_mattes(gpu: GpuContext, folder: Path) -> None:  # noqa: ARG001
    """Compiles matting."""
    Matting(gpu, (16, 16), averages=True).release()


PARTS: dict[str, Callable[[GpuContext, Path], None]] = {
    **{str(case): partial(render, case, changes) for case, changes in CASES.items()},
    **{f"{case} textured": partial(render_textured, case, changes) for case, changes in TEXTURED.items()},
    **{f"{case} measured": partial(render_measured, case, {}) for case in MEASURED},
    **{f"{case} glass": partial(render_glass, case, changes) for case, changes in GLASS.items()},
    **{f"{case} coated": partial(render_coated, case, changes) for case, changes in EXTENDED.items()},
    **{f"{case}, two cameras": partial(render_several, case) for case in SEVERAL},
    **{f"{case}, objects far apart": partial(render_apart, case) for case in APART},
    **{f"{case}, objects far apart, live": partial(render_apart, case, quality="live") for case in APART[:2]},
    **{f"{case}, on a GPU": partial(render_on_gpu, case) for case in ON_GPUS},
    "by device": by_device,
    "image-based shading": image_based,
    "precomputed transfer": precomputed_transfer,
    "soft mattes": soft_mattes,
}
