"""Animation clips of a glTF document, sampled at a time (glTF 2.0, section 3.11 and appendix C)."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
from jaxtyping import Float64, Int64

from deltalight.render_server.scene.gltf_document import GltfDocument, GltfFaultError, NodeMotion, NodeTree

MovedProperty = Literal["translation", "rotation", "scale", "weights"]
Interpolation = Literal["STEP", "LINEAR", "CUBICSPLINE"]
WIDTHS = {"translation": 3, "rotation": 4, "scale": 3}
# Below this sine, chord and arc between two quaternions agree in float32, and the quotient of sines is inexact.
MIN_SINE = 1e-4


@dataclass(frozen=True, eq=False)
class Track:
    """Keyframes of one property of several nodes at the same times (k >= 1, s).

    A key of a cubic track is in-tangent, value, out-tangent (p = 3), of another the value alone (p = 1).
    """

    path: MovedProperty
    interpolation: Interpolation
    times: Float64[np.ndarray, " k"]
    keys: Float64[np.ndarray, "k p c w"]
    nodes: Int64[np.ndarray, " c"]

    def at(self, time_s: float) -> Float64[np.ndarray, "c w"]:
        """Samples the values at a time, clamped to the first and the last key."""
        after = int(np.searchsorted(self.times, time_s, side="right"))
        value = self.keys.shape[1] // 2
        if after in (0, len(self.times)):
            found = self.keys[max(after - 1, 0), value]
        else:
            found = self._between(after - 1, time_s)
        return unit(found) if self.path == "rotation" else found

    def _between(self, index: int, time_s: float) -> Float64[np.ndarray, "c w"]:
        span = self.times[index + 1] - self.times[index]
        fraction = float((time_s - self.times[index]) / span)
        before, after = self.keys[index], self.keys[index + 1]
        if self.interpolation == "STEP":
            return np.asarray(before[0])
        if self.interpolation == "CUBICSPLINE":
            return _hermite(before, after, float(span), fraction)
        if self.path == "rotation":
            return slerp(before[0], after[0], fraction)
        return np.asarray(before[0] + fraction * (after[0] - before[0]))


@dataclass(frozen=True, eq=False)
class Clip:
    """Tracks that play together, up to the last key."""

    name: str
    tracks: tuple[Track, ...]

    @cached_property
    def duration_s(self) -> float:
        """Time of the last key."""
        return max((float(track.times[-1]) for track in self.tracks), default=0.0)

    @cached_property
    def key_times(self) -> Float64[np.ndarray, " k"]:
        """All distinct key times and 0, s."""
        return np.unique(np.concatenate([np.zeros(1), *(track.times for track in self.tracks)]))

    def motion(self, rest: NodeMotion, time_s: float) -> NodeMotion:
        """Returns the nodes' transforms at a time; properties without a track keep the rest pose."""
        motion = rest.copy()
        for track in self.tracks:
            values = track.at(time_s)
            if track.path == "weights":
                for node, weights in zip(track.nodes, values, strict=True):
                    motion.weights[node][:] = weights
            else:
                getattr(motion, track.path)[track.nodes] = values
        return motion


def unit(quaternions: Float64[np.ndarray, "c 4"]) -> Float64[np.ndarray, "c 4"]:
    """Normalizes quaternions."""
    lengths = np.linalg.norm(quaternions, axis=1, keepdims=True)
    return np.asarray(quaternions / np.maximum(lengths, 1e-30))


def slerp(
    first: Float64[np.ndarray, "c 4"], second: Float64[np.ndarray, "c 4"], fraction: float
) -> Float64[np.ndarray, "c 4"]:
    """Interpolates unit quaternions along the shorter arc (Shoemake 1985)."""
    cosine = np.einsum("cw,cw->c", first, second)[:, None]
    second = np.where(cosine < 0, -second, second)
    angle = np.arccos(np.clip(np.abs(cosine), 0, 1))
    sine = np.sin(angle)
    along = np.maximum(sine, MIN_SINE)
    is_near = sine < MIN_SINE
    one = np.where(is_near, 1 - fraction, np.sin((1 - fraction) * angle) / along)
    other = np.where(is_near, fraction, np.sin(fraction * angle) / along)
    return np.asarray(one * first + other * second)


def _hermite(
    before: Float64[np.ndarray, "3 c w"], after: Float64[np.ndarray, "3 c w"], span_s: float, fraction: float
) -> Float64[np.ndarray, "c w"]:
    """Evaluates a cubic Hermite spline (appendix C.5); tangents are per second."""
    square, cube = fraction**2, fraction**3
    return np.asarray(
        (2 * cube - 3 * square + 1) * before[1]
        + span_s * (cube - 2 * square + fraction) * before[2]
        + (3 * square - 2 * cube) * after[1]
        + span_s * (cube - square) * after[0]
    )


def read_clips(gltf: GltfDocument, nodes: NodeTree) -> tuple[Clip, ...]:
    """Reads all clips of a document.

    Raises:
        GltfFaultError: a channel without its sampler, keys that do not fit, times that do not rise, a node that does
            not exist or whose place is a matrix.
    """
    clips: dict[str, Clip] = {}
    for index, animation in enumerate(gltf.entries("animations")):
        name = str(animation.get("name") or f"clip {index}")
        if name in clips:
            name = f"{name} ({index})"
        try:
            clips[name] = Clip(name, _tracks(gltf, nodes, animation))
        except GltfFaultError as fault:
            raise GltfFaultError(f"in its animation `{name}`, {fault}") from fault
    return tuple(clips.values())


def _tracks(gltf: GltfDocument, nodes: NodeTree, animation: dict[str, Any]) -> tuple[Track, ...]:
    """Groups channels of the same times, property and width into tracks, which are sampled at once."""
    together: dict[tuple[Any, ...], list[tuple[int, np.ndarray]]] = defaultdict(list)
    for number, channel in enumerate(animation.get("channels", [])):
        path, node = channel["target"].get("path"), channel["target"].get("node")
        if node is None or path not in (*WIDTHS, "weights"):
            continue  # of an extension; the specification has such channels ignored
        sampler = _sampler(animation, number, channel)
        _check_target(nodes, node, path)
        width = WIDTHS.get(path, 0) or len(nodes.rest.weights[node])
        times = _times(gltf, sampler)
        keys = _keys(gltf, sampler, len(times), width)
        if path == "rotation" and keys.shape[1] == 1:
            keys = unit(keys[:, 0])[:, None]
        together[sampler["input"], sampler.get("interpolation", "LINEAR"), path, width].append((node, keys))
    return tuple(
        Track(path, how, _times(gltf, {"input": times}), *_stacked(channels))
        for (times, how, path, _), channels in together.items()
    )


def _stacked(channels: Sequence[tuple[int, np.ndarray]]) -> tuple[np.ndarray, Int64[np.ndarray, " c"]]:
    return np.stack([keys for _, keys in channels], axis=2), np.array([node for node, _ in channels])


def _sampler(animation: dict[str, Any], number: int, channel: dict[str, Any]) -> dict[str, Any]:
    samplers = animation.get("samplers", [])
    index = channel.get("sampler")
    if type(index) is not int or not 0 <= index < len(samplers):
        raise GltfFaultError(f"channel {number} names a sampler that does not exist")
    sampler: dict[str, Any] = samplers[index]
    how = sampler.get("interpolation", "LINEAR")
    if how not in ("STEP", "LINEAR", "CUBICSPLINE"):
        raise GltfFaultError(f"sampler {index} wants the interpolation {how!r:.60}, which does not exist")
    return sampler


def _check_target(nodes: NodeTree, node: int, path: str) -> None:
    if type(node) is not int or not 0 <= node < len(nodes.parents):
        raise GltfFaultError(f"a channel moves node {node}, which does not exist")
    if path == "weights" and not len(nodes.rest.weights[node]):
        raise GltfFaultError(f"a channel moves weights of node {node}, which has no morph targets")
    if path != "weights" and nodes.has_matrix[node]:
        raise GltfFaultError(f"a channel moves node {node}, whose place is given as a matrix")


def _times(gltf: GltfDocument, sampler: dict[str, Any]) -> Float64[np.ndarray, " k"]:
    times = gltf.floats(sampler["input"], 1)[:, 0].astype(np.float64)
    if not len(times) or times[0] < 0 or (np.diff(times) <= 0).any():
        raise GltfFaultError("the times of a sampler's keys do not rise from 0 on")
    return times


def _keys(
    gltf: GltfDocument, sampler: dict[str, Any], count: int, width: int
) -> Float64[np.ndarray, "k p w"]:
    parts = 3 if sampler.get("interpolation") == "CUBICSPLINE" else 1
    values = gltf.array(sampler["output"]).astype(np.float64)
    if values.size != count * parts * width:
        raise GltfFaultError(f"a sampler has {values.size} numbers where {count * parts * width} belong")
    if not np.isfinite(values).all():
        raise GltfFaultError("a sampler holds numbers that are not finite")
    return values.reshape(count, parts, width)
