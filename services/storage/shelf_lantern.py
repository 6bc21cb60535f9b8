"""The shelf's lantern: a dark metal frame about a frosted glass that glows."""

from typing import TYPE_CHECKING

import numpy as np

from deltalight.services.storage.shelf_glb import glb

if TYPE_CHECKING:
    import trimesh

BASE_M, BASE_HEIGHT_M = 0.09, 0.012  # edge and height of the square base
BODY_HEIGHT_M = 0.095  # between base and roof
POST_M, POST_INSET_M = 0.007, 0.004
ROOF_HEIGHT_M, ROOF_RADIUS_M = 0.035, 0.068
GLASS_RADIUS_M, GLASS_HEIGHT_M = 0.026, 0.08
RING_RADII_M = (0.014, 0.0025)  # of the ring and of its wire
SECTIONS = 48

METAL, GLASS = "Lantern metal", "Lantern glass"
GLOW_LINEAR = (1.0, 0.45, 0.14)  # near a black body of 2000 K
GLOW_RADIANCE = 2.2  # in camera units, where the camera shows 1 as white


def lantern_glb() -> bytes:
    """Generates the file."""
    import trimesh
    from trimesh.visual import TextureVisuals
    from trimesh.visual.material import PBRMaterial

    metal = PBRMaterial(
        name=METAL, baseColorFactor=[0.12, 0.1, 0.08, 1.0], metallicFactor=1.0, roughnessFactor=0.4
    )
    glass = PBRMaterial(
        name=GLASS,
        baseColorFactor=[0.8, 0.75, 0.65, 1.0],
        emissiveFactor=list(GLOW_LINEAR),
        metallicFactor=0.0,
        roughnessFactor=0.6,
    )
    scene = trimesh.Scene()
    for material, part in ((metal, _frame()), (glass, _glass())):
        part.visual = TextureVisuals(material=material)
        scene.add_geometry(part, node_name=material.name, geom_name=material.name)
    return glb(scene, {GLASS: GLOW_RADIANCE})


def _glass() -> "trimesh.Trimesh":
    from trimesh.creation import cylinder

    glass = cylinder(radius=GLASS_RADIUS_M, height=GLASS_HEIGHT_M, sections=SECTIONS)
    glass.apply_translation((0, 0, BASE_HEIGHT_M + GLASS_HEIGHT_M / 2))
    return glass


def _frame() -> "trimesh.Trimesh":
    """Returns base, posts, roof and ring; each of them is closed."""
    from trimesh.creation import box
    from trimesh.util import concatenate

    base = box((BASE_M, BASE_M, BASE_HEIGHT_M))
    base.apply_translation((0, 0, BASE_HEIGHT_M / 2))
    reach_m = (BASE_M - POST_M) / 2 - POST_INSET_M
    posts = []
    for x, y in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
        post = box((POST_M, POST_M, BODY_HEIGHT_M))
        post.apply_translation((x * reach_m, y * reach_m, BASE_HEIGHT_M + BODY_HEIGHT_M / 2))
        posts.append(post)
    frame: trimesh.Trimesh = concatenate([base, *posts, *_top(BASE_HEIGHT_M + BODY_HEIGHT_M)])
    return frame


def _top(height_m: float) -> "list[trimesh.Trimesh]":
    """Returns the roof, a pyramid, and the ring to hang it by, from a height on."""
    from trimesh.creation import cone, torus
    from trimesh.transformations import rotation_matrix

    roof = cone(radius=ROOF_RADIUS_M, height=ROOF_HEIGHT_M, sections=4)
    roof.apply_transform(rotation_matrix(np.pi / 4, (0, 0, 1)))
    roof.apply_translation((0, 0, height_m))
    ring = torus(*RING_RADII_M, major_sections=SECTIONS, minor_sections=SECTIONS // 4)
    ring.apply_transform(rotation_matrix(np.pi / 2, (1, 0, 0)))
    ring.apply_translation((0, 0, height_m + ROOF_HEIGHT_M + RING_RADII_M[0] - RING_RADII_M[1]))
    return [roof, ring]
