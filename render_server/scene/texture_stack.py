"""Approximated bidirectional texture functions (ABTF; Kautz et al. 2004, [D] 4.3.3): docs/method.md 6.9."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float16, Float32, Float64

from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import decode_lut
from deltalight.render_server.scene.texture_folder import averaged, finite_array, read_codes, read_info

STACK_TYPE = "abtf"
LAYERS = 16  # that are kept
MOST_TEXELS_EDGE = 384  # that are kept
BRIGHTEST = 64.0  # of a texel: a mirror of a lamp would be brighter, and is no texture
_FEWEST_PICTURES, _MOST_PICTURES = 2, 64
_ADVICE = (
    "it holds type: abtf, `pictures` (2 to 64 names of files) and perhaps `angles_deg` "
    "(one of each, 0 to below 90), `white` (above 0), `f0` (0 to 1) and `roughness` (0 to 1)"
)


@dataclass(frozen=True, eq=False)
class TextureStack:
    """A texture under lights at even steps of the cosine 0..1 between light and normal, and the coat over it.

    `layers` is the radiance relative to that of a white Lambertian which the light meets head-on: times the
    irradiance across the light's beam / pi. Row 0 is the top. `f0` (0: none) and `roughness` are a `Material`'s.
    """

    layers: Float16[np.ndarray, "k h w 3"]
    f0: float = 0.0
    roughness: float = 1.0

    @property
    def planes(self) -> Float16[np.ndarray, "k h w 3"]:
        """What the GPU holds as textures that follow each other."""
        return self.layers

    def under(self, light: Float64[np.ndarray, "3"]) -> Float32[np.ndarray, "h w 3"]:
        """Returns what a lamp in a unit direction (z: normal) shows, relative to that white; coat left out."""
        layers = [layer.astype(np.float32) for layer in self.layers]
        return _between(layers, np.linspace(0, 1, len(layers)), float(np.clip(light[2], 0, 1)))

    @cached_property
    def albedo(self) -> Float16[np.ndarray, "h w 3"]:
        """What texels reflect of light from everywhere, coat left out: twice the mean over the cosine, up to 1."""
        inner = self.layers[1:-1].sum(axis=0, dtype=np.float32)
        ends = self.layers[0].astype(np.float32) + self.layers[-1]
        return np.asarray(np.minimum(2 * (inner + 0.5 * ends) / (len(self.layers) - 1), 1), np.float16)


def stack_of(
    pictures: Float32[np.ndarray, "n h w 3"], cosines: Float64[np.ndarray, " n"]
) -> Float16[np.ndarray, "k h w 3"]:
    """Returns LAYERS layers at even steps of the cosine, between pictures at `cosines` (above 0, distinct).

    Beyond the steepest light radiance grows with the cosine as a Lambertian's; below the lowest it falls to 0 at the
    horizon.
    """
    order = np.argsort(cosines)
    places = np.concatenate([[0.0], cosines[order]])
    known = [np.zeros_like(pictures[0]), *pictures[order]]
    if places[-1] < 1:
        known.append(known[-1] / np.float32(places[-1]))
        places = np.append(places, 1.0)
    layers = [_between(known, places, cosine) for cosine in np.linspace(0, 1, LAYERS)]
    return np.minimum(layers, BRIGHTEST).astype(np.float16)


def _between(
    known: Sequence[Float32[np.ndarray, "h w 3"]], places: Float64[np.ndarray, " n"], at: float
) -> Float32[np.ndarray, "h w 3"]:
    low = int(np.clip(np.searchsorted(places, at, "right") - 1, 0, len(places) - 2))
    part = np.float32((at - places[low]) / (places[low + 1] - places[low]))
    return np.asarray((1 - part) * known[low] + part * known[low + 1])


def cosines_of(pictures: Float32[np.ndarray, "n h w 3"]) -> Float64[np.ndarray, " n"]:
    """Returns cosines that nobody noted: the pictures' means, the brightest taken for head-on ([D] 4.3.3).

    Raises:
        ValueError: pictures are black, or two are equally bright.
    """
    means = pictures.mean(axis=(1, 2, 3), dtype=np.float64)
    if means.min() <= 0 or len(np.unique(means)) < len(means):
        raise ValueError
    return np.asarray(means / means.max())


def read_texture_stack(folder: Path) -> TextureStack:
    """Reads an ABTF: `info.json` and the sRGB pictures that it names, of one place under lights of several angles.

    Raises:
        DeltalightError: a file is missing or damaged, or the description makes no sense.
    """
    info = read_info(folder, "an ABTF")
    try:
        names, angles, white, coat = _described(info)
    except (KeyError, TypeError, ValueError) as error:
        raise DeltalightError(f"{folder}/info.json describes no ABTF: {_ADVICE}.") from error
    decode = decode_lut(None)[:, 0]
    each = [averaged(decode[read_codes(folder / name)], MOST_TEXELS_EDGE) for name in names]
    if len({picture.shape for picture in each}) > 1:
        raise DeltalightError(f"the pictures of {folder} have several sizes; export them in one.")
    pictures = np.stack(each) / np.float32(white)
    try:
        cosines = cosines_of(pictures) if angles is None else np.cos(np.radians(angles))
    except ValueError as error:
        raise DeltalightError(
            f"{folder}: pictures that are black or equally bright do not show their light's angle; give `angles_deg`."
        ) from error
    return TextureStack(stack_of(pictures, cosines), *coat)


def _described(
    info: dict[str, Any],
) -> tuple[list[str], Float64[np.ndarray, " n"] | None, float, tuple[float, float]]:
    """Returns pictures, angles (degrees), radiance of white, F0 and roughness.

    Raises:
        KeyError, TypeError, ValueError: the description is wrong.
    """
    names = [str(name) for name in info["pictures"]]
    if info["type"] != STACK_TYPE or not _FEWEST_PICTURES <= len(names) <= _MOST_PICTURES:
        raise ValueError
    if any(Path(name).name != name for name in names):  # files of the folder alone
        raise ValueError
    angles = None if info.get("angles_deg") is None else finite_array(info["angles_deg"])
    if angles is not None and (
        angles.shape != (len(names),)
        or angles.min() < 0
        or angles.max() >= 90
        or len(np.unique(angles)) < len(angles)
    ):
        raise ValueError
    white, f0, roughness = (
        float(finite_array(info.get(key, default)))
        for key, default in (("white", 1), ("f0", 0), ("roughness", 1))
    )
    if white <= 0 or not 0 <= f0 <= 1 or not 0 <= roughness <= 1:
        raise ValueError
    return names, angles, white, (f0, roughness)
