"""Make the walking figure that the project ships: `python -m deltalight.benchmarks.walking_figure --out DIR`.

Writes figure.glb, a skinned figure of 18 cm with the clips `round` (once around a circle, 3 s) and `walk` (on the
spot, 1 s), and figure.json, which puts it into the demo's room.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from jaxtyping import Float32, Float64, Int32

from deltalight.benchmarks.glb_builder import GlbBuilder
from deltalight.benchmarks.ground_truth import scene_demo
from deltalight.render_server.scene.triangle_mesh import face_normals, smooth_normals

SIDES = 12
BLEND_M = 0.008
"""A limb bends over this length on either side of a joint."""
THIGH_M, SHIN_M, SOLE_M = 0.042, 0.036, 0.007
TOE_M, HEEL_M = 0.019, 0.004
"""The sole's ends in front of and behind the ankle."""
HIP_M = THIGH_M + SHIN_M + SOLE_M

CYCLE_S, CYCLES, KEYS_A_CYCLE = 1.0, 3, 24
STRIDE_DEG = 23.0
RADIUS_M = 4 * (THIGH_M + SHIN_M) * np.sin(np.radians(STRIDE_DEG)) * CYCLES / (2 * np.pi)
"""Of the circle.

Two steps per cycle, each as long as the legs reach from front to back, so that feet hardly slide.
"""

CENTRE_M = (0.32, 0.0)
"""Of the circle on the demo's table: clear of ball, book and mug, its shadow on the marker sheet."""

CLOTHES = {"shirt": (0.03, 0.33, 0.30), "trousers": (0.04, 0.09, 0.28), "skin": (0.62, 0.36, 0.24)}
JOINTS: dict[str, tuple[str | None, tuple[float, float, float]]] = {
    "path": (None, (0, 0, 0)),
    "hips": ("path", (0, HIP_M, 0)),
    "chest": ("hips", (0, HIP_M + 0.025, 0)),
    "head": ("chest", (0, HIP_M + 0.066, 0)),
    **{
        f"{part}_{side}": (None if parent is None else parent.format(side=side), (sign * x, y, z))
        for side, sign in (("left", 1), ("right", -1))
        for part, parent, x, y, z in (
            ("thigh", "hips", 0.011, HIP_M, 0.0),
            ("shin", "thigh_{side}", 0.011, HIP_M - THIGH_M, 0.0),
            ("foot", "shin_{side}", 0.011, SOLE_M, 0.0),
            ("arm", "chest", 0.026, HIP_M + 0.051, 0.0),
            ("forearm", "arm_{side}", 0.030, HIP_M + 0.021, 0.0),
        )
    },
}
NAMES = tuple(JOINTS)


@dataclass(frozen=True, eq=False)
class Limb:
    """A round limb: vertices, outward normals, triangles, and the weight of every joint in each vertex."""

    positions: Float32[np.ndarray, "n 3"]
    normals: Float32[np.ndarray, "n 3"]
    triangles: Int32[np.ndarray, "m 3"]
    weights: Float64[np.ndarray, "n j"]


def limb(joints: list[str], end: tuple[float, float, float], radii: tuple[float, float], rings: int) -> Limb:
    """Returns a limb from the first joint over the others to `end`, tapering towards it, round at both ends."""
    stations = np.array([*(JOINTS[name][1] for name in joints), end], float)
    lengths = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(stations, axis=0), axis=1))])
    cap = np.radians(np.linspace(-90, 0, 5))
    between = np.linspace(0, 1, rings)[1:-1]
    first, last = (radius * np.stack([np.sin(cap), np.cos(cap)]) for radius in radii)
    along = np.concatenate([first[0], lengths[-1] * between, lengths[-1] - last[0, ::-1]])
    radius = np.concatenate([first[1], np.interp(between, [0, 1], radii), last[1, ::-1]])
    direction = (stations[-1] - stations[0]) / np.linalg.norm(stations[-1] - stations[0])
    centre = np.stack([np.interp(along, lengths, stations[:, axis]) for axis in range(3)], axis=1)
    centre += direction * (along - np.clip(along, 0, lengths[-1]))[:, None]
    across = np.cross(direction, [0, 0, 1] if abs(direction[2]) < 0.9 else [1, 0, 0])
    across /= np.linalg.norm(across)
    angle = np.linspace(0, 2 * np.pi, SIDES, endpoint=False)[:, None]
    circle = np.cos(angle) * across + np.sin(angle) * np.cross(direction, across)
    positions = (centre[:, None] + radius[:, None, None] * circle).reshape(-1, 3).astype(np.float32)
    triangles = _tube_triangles(len(along))
    triangles = triangles[
        face_normals(positions, triangles)[1]
    ]  # without those that the poles degenerate to lines
    source, triangles, normals = smooth_normals(positions, triangles, crease_deg=180)
    weights = np.repeat(_joint_weights(joints, along, lengths), SIDES, axis=0)
    return Limb(positions[source], normals, triangles, weights[source])


def _tube_triangles(rings: int) -> Int32[np.ndarray, "m 3"]:
    ring, side = np.divmod(np.arange((rings - 1) * SIDES), SIDES)
    a, b = ring * SIDES + side, ring * SIDES + (side + 1) % SIDES
    c, d = b + SIDES, a + SIDES
    return np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(np.int32)


def _joint_weights(
    joints: list[str], along: Float64[np.ndarray, " r"], lengths: Float64[np.ndarray, " s"]
) -> Float64[np.ndarray, "r j"]:
    """Returns the weights of the joints: each bone its own stretch, both of them around a joint."""
    weights = np.zeros((len(along), len(NAMES)))
    above = np.ones(len(along))
    for number, name in enumerate(joints):
        below = np.clip((along - lengths[number + 1]) / (2 * BLEND_M) + 0.5, 0, 1)
        below = below * (number + 1 < len(joints))
        weights[:, NAMES.index(name)] = above * (1 - below)
        above = above * below
    return weights


def limbs() -> dict[str, list[Limb]]:
    """Returns the figure's parts by what covers them."""
    top = JOINTS["chest"][1][1]
    found: dict[str, list[Limb]] = {
        "shirt": [limb(["hips", "chest"], (0, top + 0.027, 0), (0.017, 0.021), 9)],
        "trousers": [limb(["hips"], (0, HIP_M + 0.010, 0), (0.0175, 0.0178), 4)],
        "skin": [
            limb(["chest"], (0, top + 0.045, 0), (0.007, 0.007), 4),
            limb(["head"], (0, JOINTS["head"][1][1] + 0.012, 0), (0.0145, 0.0155), 4),
        ],
    }
    for side, sign in (("left", 1), ("right", -1)):
        x, arm_x = 0.011 * sign, 0.033 * sign
        ankle = (x, SOLE_M + 0.004, 0.0)
        found["trousers"].append(limb([f"thigh_{side}", f"shin_{side}"], ankle, (0.0115, 0.0065), 13))
        found["shirt"].append(
            limb([f"arm_{side}", f"forearm_{side}"], (arm_x, HIP_M - 0.004, 0), (0.0085, 0.006), 11)
        )
        found["skin"].append(limb([f"forearm_{side}"], (arm_x, HIP_M - 0.011, 0), (0.0055, 0.0065), 4))
        found["skin"].append(limb([f"foot_{side}"], (x, SOLE_M - 0.001, TOE_M - 0.006), (0.006, 0.006), 5))
    return found


def leg_angles(phase: Float64[np.ndarray, " k"]) -> Float64[np.ndarray, "3 k"]:
    """Returns thigh (forward), knee (bent) and foot (toes up from a right angle with the shin), radians.

    The thigh swings evenly; the knee bends while it swings forward, so that the foot clears the ground.
    """
    thigh = np.radians(STRIDE_DEG) * np.sin(phase)
    knee = np.radians(6 + 48 * np.maximum(np.cos(phase - 0.3), 0) ** 2)
    return np.stack([thigh, knee, 0.8 * (knee - thigh)])


def hip_height(phase: Float64[np.ndarray, " k"]) -> Float64[np.ndarray, " k"]:
    """Returns the height of the hips, m, at which the lowest end of a sole touches the ground."""
    depths = []
    for shift in (0, np.pi):
        thigh, knee, foot = leg_angles(phase + shift)
        shin, tilt = thigh - knee, thigh - knee + foot
        ankle = THIGH_M * np.cos(thigh) + SHIN_M * np.cos(shin) + SOLE_M * np.cos(tilt)
        depths += [ankle + HEEL_M * np.sin(tilt), ankle - TOE_M * np.sin(tilt)]
    return np.asarray(np.max(depths, axis=0))


def motion(time_s: Float64[np.ndarray, " k"]) -> dict[str, Float64[np.ndarray, "k 4"]]:
    """Returns the rotations (quaternions x y z w) of the joints that walking moves."""
    phase = 2 * np.pi * time_s / CYCLE_S
    rotations = {
        "chest": _about((0, 1, 0), 0.12 * np.sin(phase)),
        "hips": _about((0, 1, 0), -0.08 * np.sin(phase)),
    }
    for side, shift in (("left", 0), ("right", np.pi)):
        thigh, knee, foot = leg_angles(phase + shift)
        arm = np.radians(20) * np.sin(phase + shift + np.pi)
        rotations[f"thigh_{side}"] = _about((1, 0, 0), -thigh)
        rotations[f"shin_{side}"] = _about((1, 0, 0), knee)
        rotations[f"foot_{side}"] = _about((1, 0, 0), -foot)
        rotations[f"arm_{side}"] = _about((1, 0, 0), -arm)
        rotations[f"forearm_{side}"] = _about((1, 0, 0), -np.radians(22) - 0.5 * np.maximum(arm, 0))
    return rotations


def _about(axis: tuple[float, float, float], angle: Float64[np.ndarray, " k"]) -> Float64[np.ndarray, "k 4"]:
    return np.column_stack([np.sin(angle / 2)[:, None] * np.array(axis), np.cos(angle / 2)])


def _add_mesh(glb: GlbBuilder) -> int:
    """Adds one primitive per material, on the figure's joints."""
    primitives = []
    for name, parts in limbs().items():
        material = {"baseColorFactor": [*CLOTHES[name], 1], "metallicFactor": 0, "roughnessFactor": 0.6}
        starts = np.cumsum([0, *(len(part.positions) for part in parts[:-1])])
        triangles = [part.triangles + start for part, start in zip(parts, starts, strict=True)]
        weights = np.concatenate([part.weights for part in parts])
        joints = np.argsort(-weights, axis=1, kind="stable")[:, :4]
        attributes = {
            "POSITION": glb.floats(np.concatenate([part.positions for part in parts])),
            "NORMAL": glb.floats(np.concatenate([part.normals for part in parts])),
            "JOINTS_0": glb.array(joints.astype(np.uint8)),
            "WEIGHTS_0": glb.floats(np.take_along_axis(weights, joints, axis=1)),
        }
        primitives.append(
            {
                "attributes": attributes,
                "indices": glb.array(np.concatenate(triangles).astype(np.uint16).ravel()),
                "material": glb.add("materials", {"name": name, "pbrMetallicRoughness": material}),
            }
        )
    return glb.add("meshes", {"primitives": primitives})


def _add_joints(glb: GlbBuilder) -> int:
    """Adds the nodes of the joints, in the order of `NAMES` from node 0 on, and the skin."""
    matrices = []
    for name, (parent, place) in JOINTS.items():
        origin = np.array((0, 0, 0) if parent is None else JOINTS[parent][1])
        children = [NAMES.index(other) for other, (above, _) in JOINTS.items() if above == name]
        node = {"name": name, "translation": (np.array(place) - origin).tolist()}
        glb.add("nodes", {**node, "children": children} if children else node)
        matrices.append(
            np.block([[np.eye(3), -np.reshape(place, (3, 1))], [np.zeros((1, 3)), np.ones((1, 1))]]).T
        )
    bind = glb.floats(np.array(matrices).reshape(-1, 16))
    return glb.add("skins", {"joints": list(range(len(NAMES))), "inverseBindMatrices": bind})


def _add_clip(glb: GlbBuilder, name: str, cycles: int, radius_m: float) -> None:
    """Adds some cycles of walking, once around a circle if it has a radius."""
    time_s = np.linspace(0, cycles * CYCLE_S, cycles * KEYS_A_CYCLE + 1)
    times = glb.floats(time_s)
    clip: dict[str, Any] = {"name": name}
    for joint, rotations in motion(time_s).items():
        glb.track(clip, NAMES.index(joint), "rotation", times, rotations)
    height = hip_height(2 * np.pi * time_s / CYCLE_S)
    hips = np.column_stack([np.full(len(time_s), -radius_m), height, np.zeros(len(time_s))])
    glb.track(clip, NAMES.index("hips"), "translation", times, hips)
    if radius_m:
        turn = _about((0, 1, 0), 2 * np.pi * time_s / time_s[-1])
        glb.track(clip, NAMES.index("path"), "rotation", times, turn)
    glb.add("animations", clip)


def build() -> GlbBuilder:
    """Returns the figure: y up, facing +z, its feet on y = 0."""
    glb = GlbBuilder()
    skin = _add_joints(glb)
    body = glb.add("nodes", {"name": "body", "mesh": _add_mesh(glb), "skin": skin})
    glb.document["scenes"] = [{"nodes": [0, body]}]
    glb.document["scene"] = 0
    _add_clip(glb, "round", CYCLES, RADIUS_M)
    _add_clip(glb, "walk", 1, 0.0)
    return glb


def scene_document() -> dict[str, Any]:
    """Returns the demo's room with the figure in place of the knot."""
    room = scene_demo.scene_document()
    figure = {
        "id": "figure",
        "asset": "figure.glb",
        "pose": {"translation_m": [*CENTRE_M, scene_demo.TABLE_Z_M]},
        "rigid": False,
        "animation": {"clip": "round"},
    }
    return {**room, "name": "walking figure", "objects": [figure]}


def main(out: Annotated[Path, typer.Option(help="Folder for figure.glb and figure.json.")]) -> None:
    """Writes the figure and its scene."""
    out.mkdir(parents=True, exist_ok=True)
    size = build().write(out / "figure.glb").stat().st_size
    (out / "figure.json").write_text(json.dumps(scene_document(), indent=2) + "\n")
    print(f"{out / 'figure.glb'}: {size / 1000:.0f} kB")


if __name__ == "__main__":
    typer.run(main)
